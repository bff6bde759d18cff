"""Several things at a time: compiled programs, and the compiler itself, run beside Python."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from typing import TypeVar

X = TypeVar("X")
Y = TypeVar("Y")


def cores() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def each(compute: Callable[[X], Y], of: Iterable[X]) -> Iterator[Y]:
    """What is computed of each, in order, a core's thread each; as `map`, one after another.

    An error is raised in its place, and what has not begun is left.
    """
    with ThreadPoolExecutor(cores()) as pool:
        yield from pool.map(compute, of)


def together(
    jobs: Iterable[Callable[[], Y]], at_once: int = 1, stop: Callable[[], None] = lambda: None
) -> list[Y]:
    """What jobs return, so many of them at once: long ones, which can be asked to stop.

    The first error, or Ctrl-C, stops the others: what runs is asked to, what has not begun is left,
    and when all is still it is raised. One at a time, they run in the caller's own thread.
    """
    if at_once == 1:
        return [job() for job in jobs]
    with ThreadPoolExecutor(at_once) as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for future in wait(futures, return_when=FIRST_EXCEPTION).done:
                future.result()
            return [future.result() for future in futures]
        except BaseException:
            for future in futures:
                future.cancel()
            stop()
            raise
