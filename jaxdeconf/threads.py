"""Several things at a time: compiled programs, and the compiler itself, run beside Python."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
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
