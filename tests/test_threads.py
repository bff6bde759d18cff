"""Long work side by side: how much of it at once, and what stops the rest."""

import threading
import time
from functools import partial

import pytest

from jaxdeconf import threads


def jobs(compute, count):
    return [partial(compute, x) for x in range(count)]


@pytest.mark.parametrize("at_once", [1, 2, 3])
def test_so_many_go_on_at_once_and_come_back_in_order(at_once):
    going, most, lock = [0], [0], threading.Lock()

    def compute(x):
        with lock:
            going[0] += 1
            most[0] = max(most[0], going[0])
        time.sleep(0.05)
        with lock:
            going[0] -= 1
        return x * x

    assert threads.together(jobs(compute, 6), at_once, pytest.fail) == [0, 1, 4, 9, 16, 25]
    assert most[0] == at_once


@pytest.mark.parametrize("error", [FloatingPointError, KeyboardInterrupt])
def test_the_first_error_stops_the_others_and_is_raised(error):
    """Also where it is not the first in order: that one is asked to stop, and says so itself."""
    stop, begun, ended = threading.Event(), [], []

    def compute(x):
        begun.append(x)
        if x == 1:
            raise error("loss is nan")
        assert stop.wait(10.0)
        ended.append(x)
        raise RuntimeError("stopped as asked")

    with pytest.raises(error, match="loss is nan"):
        threads.together(jobs(compute, 4), 2, stop.set)
    assert ended == begun[:1] == [0]
    assert 3 not in begun
