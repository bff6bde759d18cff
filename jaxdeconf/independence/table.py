"""Every column of x against every column of y, each pair counted in the cheapest way there is.

Shapes: N samples, S columns of x, P columns of y, V of either.
"""

from collections.abc import Callable
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxdeconf import threads
from jaxdeconf.independence.groups import from_groups, groups_of
from jaxdeconf.independence.levels import few_levels, from_cells, from_levels, levels_of
from jaxdeconf.independence.pairs import SMALL, compares, from_ranks, from_values
from jaxdeconf.independence.ranks import (
    Ranks,
    both_ranked,
    columns,
    largest_group,
    rank_on_device,
)
from jaxdeconf.independence.statistic import Statistic

PART = 2**19  # samples, of all pairs, for which a thread is worth its start
# How a variable is tied: in few levels; in a group larger than `SMALL`; by chance, or not.
_LEVELS, _GROUPS, _HARDLY = range(3)


def all_pairs(x: ArrayLike, y: ArrayLike, statistic: Statistic) -> Array:
    """30 times the statistic for each pair; shapes and errors as `hoeffding_d`."""
    xs, ys = both_columns(x, y)
    shape, dtype = np.shape(x)[1:] + np.shape(y)[1:], jnp.result_type(float)
    platform = jax.default_backend()
    with jax.enable_x64(True):
        if is_traced(xs, ys) or compares(platform, xs.shape[1]):
            found = from_values(jnp.asarray(xs), jnp.asarray(ys), statistic, platform)
        elif platform == "cpu":
            found = counted(*both_ranked(np.asarray(xs), np.asarray(ys)), statistic)
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
    of_x, of_y = _ties(x), _ties(y)
    general = min(of_x.min(), of_y.min()) == _HARDLY
    if statistic.weighted or general or compares(jax.default_backend(), x.rank.shape[1]):
        return in_parts(partial(_general, statistic=statistic), x, y)
    result = np.empty((len(of_x), len(of_y)))
    for in_x, in_y in product(np.unique(of_x), np.unique(of_y)):
        rows, cols = of_x == in_x, of_y == in_y
        count = partial(_counted, ties=(in_x, in_y), statistic=statistic)
        result[np.ix_(rows, cols)] = in_parts(count, chosen(x, rows), chosen(y, cols))
    return result


def _ties(ranks: Ranks) -> np.ndarray:
    """[V] which of these each variable, ranked on the host, is."""
    if ranks.first is None or ranks.last is None:
        return np.full(len(ranks.rank), _HARDLY)
    grouped = (np.asarray(ranks.last) - ranks.first >= SMALL).any(axis=1)
    return np.where(few_levels(ranks), _LEVELS, np.where(grouped, _GROUPS, _HARDLY))


def in_parts(count: Callable[[Ranks, Ranks], Array], x: Ranks, y: Ranks) -> Array | np.ndarray:
    """[S, P] `count` of x and parts of y, or of parts of x and y, in a thread for each core."""
    rows, (cols, n) = len(x.rank), y.rank.shape
    parts = min(max(rows, cols), rows * cols * n // PART)
    if parts < 2 or jax.default_backend() != "cpu":
        return count(x, y)
    if rows > cols:
        return in_parts(lambda y, x: count(x, y).T, y, x).T
    size = -(-cols // min(threads.cores(), parts))
    starts = [min(start, cols - size) for start in range(0, cols, size)]  # one size, one program
    result = np.empty((rows, cols))

    def part(start: int) -> None:
        at = slice(start, start + size)
        with jax.enable_x64(True):  # which a thread does not inherit
            result[:, at] = count(x, chosen(y, at))

    list(threads.each(part, starts))
    return result


def _counted(x: Ranks, y: Ranks, ties: tuple[int, int], statistic: Statistic) -> Array:
    """The same, where all variables of x, and of y, are tied in the same way."""
    if ties[0] > ties[1]:  # D does not change where x and y change places
        return _counted(y, x, (ties[1], ties[0]), statistic).T
    if ties == (_LEVELS, _LEVELS):
        return from_cells(levels_of(x), levels_of(y), statistic)
    if ties[0] == _LEVELS:
        return from_levels(levels_of(x), y, statistic)
    groups = groups_of(x) if ties == (_GROUPS, _HARDLY) and y.first is None else None
    if groups is None:
        return _general(x, y, statistic)
    return from_groups(y, groups, statistic, jax.default_backend()).T


def _general(x: Ranks, y: Ranks, statistic: Statistic) -> Array:
    """The same of any variables; chance ties, as float32 has them, cost less than others."""
    platform = jax.default_backend()
    largest = max(largest_group(x), largest_group(y))
    small = 1 < largest <= SMALL and not compares(platform, x.rank.shape[1])
    return from_ranks(x, y, statistic, platform, small)


def chosen(ranks: Ranks, which: np.ndarray | slice) -> Ranks:
    """The variables `which`, [V] bool or a slice."""
    if isinstance(which, np.ndarray) and which.all():
        which = slice(None)  # copies nothing
    order, rank = ranks.order[which], ranks.rank[which]
    if ranks.first is None or ranks.last is None:
        return Ranks(order, rank, None, None)
    first, last = ranks.first[which], ranks.last[which]
    tied = bool((first != last).any())
    return Ranks(order, rank, first if tied else None, last if tied else None)
