"""The command line of a sweep: where it goes. Whole sweeps are in tests/sweep/test_sweep.py."""

import jax
import pytest

from jaxdeconf.commands import sweep
from jaxdeconf.commands.main import main
from jaxdeconf.pipeline.results import Row
from jaxdeconf.presets import PRESETS
from jaxdeconf.sweep.log import Log, read_sweep, write_sweep


def words(out, *more):
    return ["--preset", "smoke", "--out", str(out), "--resume-if-exists", *more]


def test_one_line_starts_or_goes_on(tmp_path):
    grid = ("--seeds", "2", "--grid", "mask.threshold=1e-3,1e-2")
    asked, begun = sweep.read(words(tmp_path, *grid), PRESETS)
    assert asked.held is None
    write_sweep(tmp_path, begun)
    assert sweep.read(words(tmp_path), PRESETS)[0].held is None  # nothing has been saved
    Log(tmp_path).append([Row(0, {"seed": 0}, [])])
    for same in ([], grid, grid[:2]):
        asked, again = sweep.read(words(tmp_path, *same), PRESETS)
        assert (asked.held, again) == (tmp_path, begun)
    for other in (["--seeds", "3"], ["--grid", "mask.threshold=1e-3"], ["--clone.epochs", "9"]):
        with pytest.raises(RuntimeError, match=r"sweep.json: holds another sweep"):
            sweep.read(words(tmp_path, *other), PRESETS)


def test_a_start_that_saves_nothing_leaves_no_claim(tmp_path, capsys, monkeypatch):
    """The same --out takes another grid."""

    def fail(*_):
        raise MemoryError

    monkeypatch.setattr("jaxdeconf.sweep.sweep.sweep", fail)
    monkeypatch.setattr(jax.config, "update", lambda *_: None)  # JAX has its devices by now
    out = tmp_path / "sweep"
    for seeds in ("1", "2"):
        assert main(["sweep", "--preset", "smoke", "--out", str(out), "--seeds", seeds]) == 1
        assert "not enough memory" in capsys.readouterr().err
        assert read_sweep(out).seeds == int(seeds)
        assert [path.name for path in out.iterdir()] == ["sweep.json"]
