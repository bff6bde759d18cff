"""`jaxdeconf theory` from flags to a report, as small as it goes."""

import json
import math

import pytest

from jaxdeconf.commands import report
from jaxdeconf.commands import theory as command
from jaxdeconf.pipeline import results
from jaxdeconf.pipeline.theory import Theory, TheoryConfig
from jaxdeconf.report.theory import CLAIMS, summary

SMALL = (
    *("--claims.trajectories", "60", "--claims.systems", "30"),
    *("--claims.broken-systems", "20", "--claims.null-systems", "20", "--no-on-pixels"),
)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    directory = tmp_path_factory.mktemp("theory") / "out"
    assert command.main([*SMALL, "--out", str(directory)]) == 0
    return directory


def test_the_results_hold_each_claim_s_rates_and_counts(done):
    held = json.loads((done / "results.json").read_text())
    for claim in set(CLAIMS) - {"pixels"}:
        assert held[claim], claim
        for row in held[claim]:
            assert row["n"] == 0 or row["rate"] == row["events"] / row["n"]
            low, high = row["interval"]
            assert 0 <= low <= high <= 1
    assert held["config"]["claims"]["trajectories"] == [60]


def test_they_come_back_as_they_were(done):
    found, _ = results.load(done, Theory)
    row = found.conservative[0]
    assert row.case == "edges of 0.3"
    assert isinstance(row.interval, tuple)
    assert math.isnan(found.peak_memory_mb) or found.peak_memory_mb > 0
    assert "edges of 0.3, N = 60" in summary(found, done)


def test_the_report_has_every_claim_and_its_figure(done):
    page = (done / "report.html").read_text()
    for claim in set(CLAIMS) - {"pixels"}:
        assert CLAIMS[claim] in page
    drawn = {file.name for file in (done / "figures").iterdir()}
    assert drawn == {"conservative.png", "intervention.png", "threshold.png"}


def test_the_report_is_drawn_again(done, capsys):
    drawn, written = done / "figures" / "threshold.png", (done / "report.html").read_text()
    before = drawn.stat().st_mtime_ns
    (done / "report.html").unlink()
    assert report.main([str(done)]) == 0
    assert capsys.readouterr().out == f"report: {done / 'report.html'}\n"
    assert (done / "report.html").read_text() == written
    assert drawn.stat().st_mtime_ns > before


def test_it_goes_on_where_it_stopped(done, capsys):
    before = (done / "checkpoints" / "systems").stat().st_mtime_ns
    numbers = (done / "results.json").read_text()
    (done / "results.json").unlink()
    assert command.main(["--resume", str(done)]) == 0
    assert (done / "checkpoints" / "systems").stat().st_mtime_ns == before
    old, new = (json.loads(text) for text in (numbers, (done / "results.json").read_text()))
    for part in ("peak_memory_mb", "seconds"):
        old.pop(part), new.pop(part)
    assert old == new


def test_another_seed_is_refused_where_one_was_begun(done, capsys):
    assert command.main(["--resume", str(done), "--seed", "1"]) == 2
    assert "--seed was 0, is 1" in capsys.readouterr().err


def test_a_wrong_flag_exits_with_2_and_one_line(capsys):
    assert command.main(["--claims.alpha", "2"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "alpha: expected a number in (0, 1), got 2.0" in said


def test_a_seed_is_a_seed():
    with pytest.raises(ValueError, match="seed: expected an integer >= 0, got -1"):
        TheoryConfig(seed=-1)
