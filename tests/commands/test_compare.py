"""The command line of a comparison: which methods, on what, and where it goes on."""

import pytest

from jaxdeconf.commands import compare, report
from jaxdeconf.methods import METHODS, named_by
from jaxdeconf.pipeline.results import Row
from jaxdeconf.presets import PRESETS
from jaxdeconf.sweep.grid import Axis
from jaxdeconf.sweep.log import Log, write_sweep


def read(*words):
    return compare.read(["--preset", "smoke", *words], PRESETS)


def methods_of(sweep):
    return [point.config.methods for point in sweep.points]


def test_a_point_is_a_method_and_a_seed():
    _, sweep = read("--methods", "BcVanilla", "Palr", "--seeds", "2")
    assert methods_of(sweep) == [("BcVanilla",), ("Palr",)] * 2
    assert [point.config.seed for point in sweep.points] == [0, 0, 1, 1]


@pytest.mark.parametrize("kind", ["all", "fair", "oracle", "control"])
def test_a_kind_stands_for_its_methods(kind):
    _, sweep = read("--methods", kind, "--seeds", "1")
    names = [name for (name,) in methods_of(sweep)]
    assert names == list(named_by(kind))
    wanted = {name for name, row in METHODS.items() if kind in ("all", row.kind)}
    assert set(names) == wanted


def test_all_are_compared_where_none_is_named():
    assert methods_of(read()[1]) == [(name,) for name in METHODS]


def test_nuisances_are_an_axis():
    _, sweep = read("--methods", "Masked", "--nuisance", "previous_action", "filtered")
    shown = [point.config.collect.nuisance for point in sweep.points]
    assert shown == ["previous_action", "filtered"]


def test_it_goes_on_with_what_was_asked(tmp_path):
    words = ["--methods", "BcVanilla", "Dart", "--nuisance", "filtered", "--out", str(tmp_path)]
    _, begun = read(*words)
    write_sweep(tmp_path, begun)
    Log(tmp_path).append([Row(0, {"seed": 0}, [])])
    for same in (["--resume", str(tmp_path)], [*words, "--resume-if-exists"]):
        asked, again = compare.read(same, PRESETS)
        assert (asked.held, again) == (tmp_path, begun)
    with pytest.raises(RuntimeError, match=r"sweep.json: holds another sweep"):
        compare.read(["--resume", str(tmp_path), "--methods", "Masked"], PRESETS)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--methods", "Nobody"], "methods: expected one of BcVanilla, "),
        (["--nuisance", "brake_light"], "nuisance"),
        (["--system", "cart"], "--system: expected one of cartpole, reacher, got 'cart'"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(words, said, capsys):
    assert compare.main(["--preset", "smoke", *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_its_report_is_drawn_again(tmp_path, capsys):
    _, sweep = read("--methods", "BcVanilla", "--seeds", "1")
    assert sweep.axes == (Axis("methods", (("BcVanilla",),)),)
    write_sweep(tmp_path, sweep)
    assert report.main([str(tmp_path)]) == 0
    assert "report: " in capsys.readouterr().out
    assert "1 of 1 are not done" in (tmp_path / "report.html").read_text()
