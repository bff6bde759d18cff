"""Counts for columns with groups of ties, as saturated ones have, against columns without: in one.

Where x has no ties, those of y may be put in the order of x: a sample's place among them is then
how many of its group come earlier in x, which are all counted below it, and as ties count half.

Shapes: S variables of x, P of y, V, N samples, C pairs in a chunk; layout as in `counts`.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.independence.counts import (
    count_below,
    count_earlier,
    cumulative,
    histogram,
    scatter,
    take,
    tiled,
)
from jaxdeconf.independence.levels import MOST, size_above
from jaxdeconf.independence.pairs import arrange, of_each_pair, plan, positions, read, total
from jaxdeconf.independence.ranks import Ranks
from jaxdeconf.independence.statistic import Below, Statistic


class Groups(NamedTuple):
    """V variables with G - 1 groups of ties at most."""

    first: Array | np.ndarray  # [V, N] int32: of each sample, the first rank of its group
    number: Array | np.ndarray  # [V, N] uint8: of its group, from 1; 0 without ties
    others: Array | np.ndarray  # [V, G] int32: of each group, how many samples a sample is tied to


def groups_of(ranks: Ranks) -> Groups | None:
    """The groups of variables ranked on the host; None where one has too many."""
    first, last, rank = (np.asarray(v) for v in (ranks.first, ranks.last, ranks.rank))
    starts = (first < last) & (first == np.arange(first.shape[1], dtype=np.int32))
    number = np.cumsum(starts, axis=1, dtype=np.int32) * (first < last)
    size = size_above(int(number.max()), 4)
    if size > MOST:
        return None
    others = np.zeros((len(first), size), np.int32)
    row, start = np.nonzero(starts)
    others[row, number[row, start]] = (last - first)[row, start]
    number = np.take_along_axis(number.astype(np.uint8), rank, axis=1)
    return Groups(np.take_along_axis(first, rank, axis=1), number, others)


@partial(jax.jit, static_argnames=("statistic", "platform"))
def from_groups(x: Ranks, y: Groups, statistic: Statistic, platform: str) -> Array:
    """[S, P] float64, as `pairs.from_ranks`, of x without ties and a statistic without weights."""
    (rows, n), (cols, size) = x.rank.shape, y.others.shape
    grid = plan(n, rows * cols, platform)
    order = arrange(x, grid).order
    padding = (0, 0), (0, grid.size - n)
    rest = jnp.arange(grid.size, dtype=jnp.int32)
    first = jnp.where(rest < n, jnp.pad(jnp.asarray(y.first), padding), rest)
    number = jnp.pad(jnp.asarray(y.number), padding)
    pair, block = grid.block_numbers()
    position = positions(grid)
    of_groups = partial(histogram, size=size, unroll=grid.unroll)
    count_equal = partial(count_earlier, compare=jnp.equal, unroll=grid.unroll)

    def values(row: Array, col: Array) -> Array:
        in_y, own = (read(of, order, col, row, grid) for of in (first, number))
        before = cumulative(tiled(of_groups, own), grid, grid.blocks)[0]
        others = jnp.asarray(y.others)[col]

        # One tile after the other, which keeps XLA on CPU from repeating it in every user.
        def tied(tile: tuple[Array, ...]) -> tuple[Array, Array]:
            pair, block, own = tile
            cell = own.astype(jnp.int32) * grid.blocks + block
            earlier = take(before, cell * grid.pairs + pair) + count_equal(own)
            return jnp.where(own > 0, earlier, 0), take(others, pair * size + own)

        earlier, tied_to = tiled(tied, (pair, block, own))
        p = in_y + earlier
        digits = (position // grid.blocks).astype(jnp.uint8)
        both, _ = count_below(p, scatter(grid.place(pair, p), digits), grid)
        in_y = in_y + 0.5 * tied_to
        below = Below(position.astype(float), in_y, both - 0.5 * earlier, *3 * (jnp.zeros(()),))
        return statistic.value(below, n, partial(total, n=n, grid=grid))

    return of_each_pair(values, (rows, cols), n, grid.pairs)
