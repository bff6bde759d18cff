"""Counts for columns of few values: a pass or two where the general way takes four.

With x on k levels (k <= 256) and the samples in y-order, the samples below sample i in both are
those earlier and on a lower level; one on the same level counts half. As in `counts`, earlier
blocks are read from a histogram with two prefix sums and the sample's own block is compared whole,
but no ranks within a level are left to count. Where y is tied, the mean over the two orders of its
ties counts half of them.

Shapes: V variables, S of x, P of y, N samples, k levels, C pairs in a chunk; layout as in `counts`.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.independence.counts import (
    Grid,
    cumulative,
    histogram,
    over_rows,
    take,
    tiled,
)
from jaxdeconf.independence.pairs import arrange, of_each_pair, positions, read, total
from jaxdeconf.independence.ranks import Ranks
from jaxdeconf.independence.statistic import Below, Statistic

MOST = 256  # of levels: a level is a byte
CELLS = 2**15  # of the tables that are made at once; they stay in the cache


class Levels(NamedTuple):
    """V variables of few values."""

    level: Array | np.ndarray  # [V, N] uint8 of each sample
    midrank: Array | np.ndarray  # [V, k] float64: midrank - 1 of each level


def few_levels(ranks: Ranks) -> np.ndarray:
    """[V] bool: whether a variable ranked on the host has at most `MOST` values."""
    if ranks.first is None:
        return np.zeros(len(ranks.rank), bool)
    return (np.asarray(ranks.first) == np.arange(ranks.rank.shape[1])).sum(axis=1) <= MOST


def levels_of(ranks: Ranks) -> Levels:
    """The levels of variables that have few, ranked on the host."""
    first, last = np.asarray(ranks.first), np.asarray(ranks.last)
    starts = first == np.arange(first.shape[1], dtype=np.int32)
    at_rank = np.cumsum(starts, axis=1, dtype=np.uint8) - np.uint8(1)  # of 256, from 0 to 0 to 255
    level = np.take_along_axis(at_rank, np.asarray(ranks.rank), axis=1)
    midrank = np.zeros((len(first), size_above(int(at_rank.max()), 16)))
    row, start = np.nonzero(starts)
    midrank[row, at_rank[row, start]] = (start + last[row, start]) / 2
    return Levels(level, midrank)


def size_above(most: int, size: int) -> int:
    """The least of `size`, 4 `size`, 16 `size`, ... above `most`: few programs are compiled."""
    while size <= most:
        size *= 4
    return size


def plan(n: int, pairs: int, size: int) -> Grid:
    """The grid for n samples on `size` levels and up to `pairs` pairs at once.

    The more levels, the more a table of a block costs, and the larger blocks should be: up to what
    a byte counts twice.
    """
    base = {16: 32, 64: 64}.get(size, 120)
    blocks = 2 * max(1, -(-n // (2 * base)))
    if pairs == 1:
        return Grid(base, blocks, 1, blocks // 2)
    width = min(pairs // 2, max(1, 512 // blocks))
    tiles = min(4, -(-pairs // width))
    return Grid(base, blocks, width * tiles, width * blocks)


@partial(jax.jit, static_argnames="statistic")
def from_levels(x: Levels, y: Ranks, statistic: Statistic) -> Array:
    """[S, P] float64, as `pairs.from_ranks`, of a statistic that reads no weights nor ties."""
    (rows, n), cols, size = x.level.shape, y.rank.shape[0], x.midrank.shape[1]
    grid = plan(n, rows * cols, size)
    level = jnp.pad(jnp.asarray(x.level), ((0, 0), (0, grid.size - n)))
    midrank, views = jnp.asarray(x.midrank), arrange(y, grid)
    pair, _ = grid.block_numbers()
    position = positions(grid)

    def values(row: Array, col: Array) -> Array:
        in_y = position.astype(float)
        own = grid.place(pair, position)[None]
        if views.first is not None and views.last is not None:
            ends = grid.tile(views.first[col]) + grid.tile(views.last[col])
            in_y = 0.5 * ends
            own = jnp.concatenate([own, grid.place(pair, ends - position)[None]])

        def count(order: Array) -> tuple[Array, Array]:
            digits = read(level, views.order, row, views.under(order, col), grid)
            return take(count_lower(digits, size, grid), own[order]), digits

        # Mapped even where there is one order, which keeps XLA on CPU from counting for each user.
        twice, digits = jax.lax.map(count, jnp.arange(views.orders))
        both = (0.5 / views.orders) * twice.sum(axis=0)
        in_x = take(midrank[row], pair * size + digits[0])
        below = Below(in_x, in_y, both, *3 * (jnp.zeros(()),))
        return statistic.value(below, n, partial(total, n=n, grid=grid))

    return of_each_pair(values, (rows, cols), n, grid.pairs)


@partial(jax.jit, static_argnames="statistic")
def from_cells(x: Levels, y: Levels, statistic: Statistic) -> Array:
    """As `from_levels` where y has few levels, too: from the table of how often they meet."""
    (rows, n), cols = x.level.shape, y.level.shape[0]
    size_x, size_y = x.midrank.shape[1], y.midrank.shape[1]
    chunk = min(rows * cols, max(4, CELLS // (size_x * size_y)))
    pair = jnp.arange(chunk, dtype=jnp.int32)[:, None]
    width = size_y + 1  # odd: columns a power of two apart would share few places of the cache

    def values(row: Array, col: Array) -> Array:
        on_x = jnp.asarray(x.level)[row].astype(jnp.int32)
        on_y = jnp.asarray(y.level)[col].astype(jnp.int32)
        met = jnp.zeros(size_x * width * chunk, jnp.int32)
        met = met.at[(on_x * width + on_y) * chunk + pair].add(1, mode="promise_in_bounds")
        lower = _twice_below(met.reshape(size_x, width, chunk), 0)
        lower = _twice_below(lower, 1)  # [width, size_x, chunk]
        both = take(lower, (on_y * size_x + on_x) * chunk + pair) / 4.0 - 0.25  # but for itself
        in_x = take(jnp.asarray(x.midrank)[row], pair * size_x + on_x)
        in_y = take(jnp.asarray(y.midrank)[col], pair * size_y + on_y)
        below = Below(in_x, in_y, both, *3 * (jnp.zeros(()),))
        return statistic.value(below, n, lambda terms: terms.sum(axis=1))

    return of_each_pair(values, (rows, cols), n, chunk)


def _twice_below(table: Array, axis: int) -> Array:
    """Twice the sums of the cells before, and the cell itself once; the axis comes to the front."""

    def add(before: Array, at: Array) -> tuple[Array, Array]:
        cells = jax.lax.dynamic_index_in_dim(table, at, axis, keepdims=False)
        return before + 2 * cells, before + cells

    none = jnp.zeros_like(jax.lax.index_in_dim(table, 0, axis, keepdims=False))
    return jax.lax.scan(add, none, jnp.arange(table.shape[axis]))[1]


def count_lower(level: Array, size: int, grid: Grid) -> Array:
    """[T, K, W] int32: twice the earlier samples on lower levels and those on the same, once.

    Args:
      level: [T, K, W] uint8 in y-order.
      size: number of levels.
      grid: the layout.
    """
    pair, block = grid.block_numbers()
    equal, less = cumulative(
        tiled(partial(histogram, size=size, unroll=grid.unroll), level), grid, grid.blocks
    )
    cell = (level.astype(jnp.int32) * grid.blocks + block) * grid.pairs + pair
    return take(2 * less + equal, cell) + tiled(partial(_count_lower, unroll=grid.unroll), level)


def _count_lower(block: Array, unroll: bool) -> Array:
    """[K, W] uint8: earlier rows that are less than the row, and those at most it."""
    row = jnp.arange(block.shape[0], dtype=jnp.uint8)[:, None]

    def term(k: Array | int, one: Array) -> Array:
        both = (one < block).astype(jnp.uint8) + (one <= block).astype(jnp.uint8)
        return jnp.where(row > k, both, 0)

    return over_rows(term, block, unroll=unroll)
