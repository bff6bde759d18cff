"""What a rank statistic of a pair is: a function of what lies below each sample."""

from collections.abc import Callable
from typing import NamedTuple

from jax import Array

Total = Callable[[Array], Array]  # sums over the samples of each pair


class Below(NamedTuple):
    """What lies below each sample, float64, samples tied with it counted half."""

    x: Array  # samples below in x: the midrank - 1
    y: Array
    both: Array
    y_of_both: Array  # sum of `y` over the samples below in both
    tied_x: Array  # half the number of other samples tied with it in x
    tied_y: Array


class Statistic(NamedTuple):
    """A statistic of a pair, times N (N-1) ... (N-4)."""

    value: Callable[[Below, int, Total], Array]
    weighted: bool  # it reads `y_of_both`


def scaled(totals: Array, n: int) -> Array:
    """30 times the statistic of n samples, of its `value`."""
    return 30.0 / (float(n) * (n - 1.0) * (n - 2.0) * (n - 3.0) * (n - 4.0)) * totals
