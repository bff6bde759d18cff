"""Every column of x against every column of y, each pair counted in the cheapest way there is.

Shapes: N samples, S columns of x, P columns of y, V of either.
"""

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxdeconf.independence.levels import (
    CELLS,
    few_levels,
    from_cells,
    from_levels,
    levels_of,
)
from jaxdeconf.independence.pairs import SMALL, compares, from_ranks, from_values
from jaxdeconf.independence.ranks import (
    Ranks,
    columns,
    largest_group,
    rank_on_device,
    rank_on_host,
)
from jaxdeconf.independence.statistic import Statistic


def all_pairs(x: ArrayLike, y: ArrayLike, statistic: Statistic) -> Array:
    """30 times the statistic for each pair; shapes and errors as `hoeffding_d`."""
    xs, ys = both_columns(x, y)
    shape, dtype = np.shape(x)[1:] + np.shape(y)[1:], jnp.result_type(float)
    platform = jax.default_backend()
    with jax.enable_x64(True):
        if is_traced(xs, ys) or compares(platform, xs.shape[1]):
            found = from_values(jnp.asarray(xs), jnp.asarray(ys), statistic, platform)
        elif platform == "cpu":
            found = counted(rank_on_host(np.asarray(xs)), rank_on_host(np.asarray(ys)), statistic)
        else:
            found = _general(_ranked(xs), _ranked(ys), statistic)
        return formed(found, dtype, shape)


def _ranked(values: Array | np.ndarray) -> Ranks:
    """On the device; the counts of tied columns, the larger program, are compiled only for them."""
    ranks, tied = jax.jit(rank_on_device)(jnp.asarray(values))
    return ranks if tied > 1 else ranks._replace(first=None, last=None)


@partial(jax.jit, static_argnames=("dtype", "shape"))  # one call instead of two, of 0.1 ms each
def formed(found: Array, dtype: jnp.dtype, shape: tuple[int, ...]) -> Array:
    """A table of statistics as it is returned."""
    return found.astype(dtype).reshape(shape)


def both_columns(x: ArrayLike, y: ArrayLike) -> tuple[Array | np.ndarray, Array | np.ndarray]:
    """x [S, N] and y [P, N], of as many samples each."""
    xs, ys = columns("x", x), columns("y", y)
    if xs.shape[1] != ys.shape[1]:
        raise ValueError(f"y: expected {xs.shape[1]} samples, as x has, got {ys.shape[1]}")
    return xs, ys


def is_traced(*arrays: Array | np.ndarray) -> bool:
    """Whether one of them has no values yet."""
    return any(isinstance(array, Tracer) for array in arrays)


def counted(x: Ranks, y: Ranks, statistic: Statistic) -> Array | np.ndarray:
    """[S, P] float64, as `all_pairs`, of variables ranked on the host; under 64-bit types."""
    few_x, few_y = few_levels(x), few_levels(y)
    levelled = few_x.any() or few_y.any()
    if statistic.weighted or not levelled or compares(jax.default_backend(), x.rank.shape[1]):
        return _general(x, y, statistic)
    result = np.empty((len(few_x), len(few_y)))
    for few_in_x, few_in_y in product((True, False), repeat=2):
        rows, cols = few_x == few_in_x, few_y == few_in_y
        if rows.any() and cols.any():
            some = _counted(chosen(x, rows), chosen(y, cols), few_in_x, few_in_y, statistic)
            result[np.ix_(rows, cols)] = some
    return result


def _counted(x: Ranks, y: Ranks, few_x: bool, few_y: bool, statistic: Statistic) -> Array:
    """The same, where all variables of x, and of y, have few levels or none has."""
    if not (few_x or few_y):
        return _general(x, y, statistic)
    if not few_x:  # D does not change where x and y change places
        return from_levels(levels_of(y), x, statistic).T
    levels_x = levels_of(x)
    if few_y:
        levels_y = levels_of(y)
        if levels_x.midrank.shape[1] * levels_y.midrank.shape[1] <= CELLS:
            return from_cells(levels_x, levels_y, statistic)
    return from_levels(levels_x, y, statistic)


def _general(x: Ranks, y: Ranks, statistic: Statistic) -> Array:
    """The same of any variables; chance ties, as float32 has them, cost less than others."""
    platform = jax.default_backend()
    largest = max(largest_group(x), largest_group(y))
    small = 1 < largest <= SMALL and not compares(platform, x.rank.shape[1])
    return from_ranks(x, y, statistic, platform, small)


def chosen(ranks: Ranks, which: np.ndarray) -> Ranks:
    """The variables [V] bool `which`."""
    order, rank = ranks.order[which], ranks.rank[which]
    if ranks.first is None or ranks.last is None:
        return Ranks(order, rank, None, None)
    first, last = ranks.first[which], ranks.last[which]
    tied = bool((first != last).any())
    return Ranks(order, rank, first if tied else None, last if tied else None)
