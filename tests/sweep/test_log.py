"""The rows of a sweep on disk."""

import json
import math

import numpy as np
import pytest

from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.plain import to_plain
from jaxdeconf.pipeline.results import Judged, JudgedExpert, Losses, Row
from jaxdeconf.pipeline.store import StoreError, WriteError
from jaxdeconf.sweep.grid import Axis
from jaxdeconf.sweep.log import Log, Sweep, read_sweep, require_same, write_sweep
from jaxdeconf.version import __version__

AXES = Axis("disentangle.network.channels", ((4, 8), (8, 16))), Axis("mask.alpha", (None, 0.1))
SWEEP = Sweep(Config(methods=("Masked",)), AXES, 2)


def row(point):
    return Row(point, {"seed": point}, [])


def test_a_sweep_is_read_as_it_was_written(tmp_path):
    write_sweep(tmp_path, SWEEP)
    assert read_sweep(tmp_path) == SWEEP
    require_same(tmp_path, SWEEP)
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.json"]


def test_the_first_of_many_writers_wins(tmp_path):
    write_sweep(tmp_path, SWEEP)
    write_sweep(tmp_path, Sweep(Config()))
    assert read_sweep(tmp_path) == SWEEP
    with pytest.raises(StoreError, match="holds another sweep"):
        require_same(tmp_path, Sweep(Config()))


def test_rows_of_all_shards_are_read_by_point(tmp_path):
    Log(tmp_path, (2, 2)).append([row(3), row(2)])
    Log(tmp_path, (1, 2)).append([row(0)])
    Log(tmp_path).append([row(1)])
    assert Log(tmp_path, (1, 2)).rows() == [row(point) for point in range(4)]


def test_a_row_is_read_as_it_was_written_but_what_is_not_finite_is_nan(tmp_path):
    judged = Judged(Losses(math.inf, math.nan), 0.5, 0.1, 0.2, 0.3, 0.7, 0.4, 0.01)
    expert = JudgedExpert(1.0, 1.0, 0.0, 0.0)
    mask = np.array([True, False])
    whole = Row(
        *(3, {"seed": 0, "disentangle.network.channels": (4, 8)}, ["Masked"]),
        *({"Masked": judged}, 1e-3, mask, ~mask, np.array([0.9, math.nan]), 1.0, None, expert),
    )
    Log(tmp_path).append([whole])
    (found,) = Log(tmp_path).rows()
    assert found.values == whole.values
    assert math.isnan(found.policies["Masked"].rollout_loss.mean)
    assert found.policies["Masked"][1:] == judged[1:]
    np.testing.assert_array_equal(found.nuisance_share, whole.nuisance_share)
    assert (found.mask == mask).all()
    assert found.mask.dtype == bool
    assert (found.precision, found.recall, found.expert) == (1.0, None, expert)


def test_a_half_written_line_is_no_row_and_is_cut_off(tmp_path):
    log = Log(tmp_path)
    log.append([row(0), row(1)])
    whole = (tmp_path / "sweep.jsonl").read_bytes()
    (tmp_path / "sweep.jsonl").write_bytes(whole + b'{"point": 2, "val')
    assert log.rows() == [row(0), row(1)]
    log.mend()
    assert (tmp_path / "sweep.jsonl").read_bytes() == whole
    log.append([row(2)])
    assert log.rows() == [row(0), row(1), row(2)]


@pytest.mark.parametrize("line", ["{", "[]", '{"values": {}}', "7"])
def test_a_damaged_row_is_named(tmp_path, line):
    (tmp_path / "sweep.jsonl").write_text(json.dumps(to_plain(row(0))) + "\n" + line + "\n")
    with pytest.raises(StoreError, match=r"sweep\.jsonl: line 2 is no row of a sweep"):
        Log(tmp_path).rows()


@pytest.mark.parametrize("text", ["", "[]", json.dumps({"jaxdeconf": __version__})])
def test_a_damaged_plan_is_named(tmp_path, text):
    (tmp_path / "sweep.json").write_text(text)
    with pytest.raises(StoreError, match=r"sweep\.json: not a sweep of jaxdeconf"):
        read_sweep(tmp_path)


def test_a_disk_that_takes_no_row_is_named(tmp_path):
    with pytest.raises(WriteError, match=r"go on with --resume"):
        Log(tmp_path / "gone").append([row(0)])


def test_a_sweep_of_the_version_before_is_refused(tmp_path):
    (tmp_path / "sweep.json").write_text('{"jaxdeconf": "0.1.0", "axes": {}}')
    with pytest.raises(StoreError, match=r"a sweep of jaxdeconf 0\.1\.0, not of this version"):
        read_sweep(tmp_path)


def test_a_bad_sweep_names_the_field():
    with pytest.raises(ValueError, match="seeds: expected "):
        Sweep(Config(), seeds=0)
    with pytest.raises(ValueError, match=r"points of the grid: expected .* <= 100000, got 1000000"):
        Sweep(Config(), seeds=1_000_000)
