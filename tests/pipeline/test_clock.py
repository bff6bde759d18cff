"""Seconds by stage against what can be counted by hand."""

import pytest

from jaxdeconf.pipeline import clock
from jaxdeconf.pipeline.clock import Clock


@pytest.fixture
def now(monkeypatch):
    """The time, in a list, to be set."""
    time = [100.0]
    monkeypatch.setattr(clock.time, "perf_counter", lambda: time[0])
    return time


def test_stages_side_by_side_share_the_time_that_passes(now):
    kept = Clock()
    with kept.running("collect"):
        now[0] += 4.0
    now[0] += 1.0  # nobody's
    with kept.running("first"):
        now[0] += 2.0
        with kept.running("second", before=10.0):
            now[0] += 6.0
            assert kept.read("second") == pytest.approx(13.0)
        now[0] += 1.0
    assert kept.seconds == pytest.approx({"collect": 4.0, "first": 6.0, "second": 13.0})
    assert sum(kept.seconds.values()) == pytest.approx(now[0] - 100.0 - 1.0 + 10.0)


def test_a_stage_that_fails_takes_no_more_time(now):
    kept = Clock()

    def fail():
        with kept.running("first"):
            now[0] += 1.0
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    with kept.running("second"):
        now[0] += 2.0
    assert kept.seconds == pytest.approx({"first": 1.0, "second": 2.0})
