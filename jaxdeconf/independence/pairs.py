"""Rank statistics of pairs of ranked variables, in one jitted call.

Shapes: N samples, S columns of x, P columns of y, C pairs in a chunk, K and B as in `counts`.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.independence import dense
from jaxdeconf.independence.counts import Grid, count_below, plan, take
from jaxdeconf.independence.ranks import Ranks, integer_key, rank_on_device, reverse_ties
from jaxdeconf.independence.statistic import Below, Statistic, scaled

# Samples of a tie group, at most, that meet each other one by one: cheaper than three more counts.
SMALL = 8


def compares(platform: str, n: int) -> bool:
    """Whether n samples are compared with one another, and not counted: see `dense`."""
    return platform != "cpu" and n <= dense.MOST


@partial(jax.jit, static_argnames=("statistic", "platform"))
def from_values(x: Array, y: Array, statistic: Statistic, platform: str) -> Array:
    """[S, P] float64 of x [S, N] and y [P, N], ranked, or compared, on the device."""
    if compares(platform, x.shape[1]):
        of_x, of_y = (dense.compared(integer_key(v)) for v in (x, y))
        result = dense.from_columns(of_x, of_y, statistic)
    else:
        (ranks_x, tied_x), (ranks_y, tied_y) = rank_on_device(x), rank_on_device(y)
        result = jax.lax.cond(
            jnp.maximum(tied_x, tied_y) > SMALL,
            partial(from_ranks, ranks_x, ranks_y, statistic, platform),
            partial(from_ranks, ranks_x, ranks_y, statistic, platform, small=True),
        )
    missing = jnp.isnan(x).any(axis=1)[:, None] | jnp.isnan(y).any(axis=1)[None, :]
    return jnp.where(missing, jnp.nan, result)


@partial(jax.jit, static_argnames=("statistic", "platform", "small"))
def from_ranks(
    x: Ranks, y: Ranks, statistic: Statistic, platform: str, small: bool = False
) -> Array:
    """[S, P] float64: 30 times the statistic of each pair of S and P variables.

    Args:
      x, y: the variables.
      statistic: which.
      platform: the program's.
      small: whether ties are few, groups of at most `SMALL` samples.
    """
    (rows, n), cols = x.rank.shape, y.rank.shape[0]
    if compares(platform, n):
        return dense.from_columns(dense.ranked(x), dense.ranked(y), statistic)
    grid = plan(n, rows * cols, platform)
    views_x, views_y = arrange(x, grid, not small), arrange(y, grid, not small)

    def values(row: Array, col: Array) -> Array:
        below = _below(views_x, views_y, row, col, grid, statistic.weighted)
        return statistic.value(below, n, partial(total, n=n, grid=grid))

    return of_each_pair(values, (rows, cols), n, grid.pairs)


def total(terms: Array, n: int, grid: Grid) -> Array:
    """[C] sums over the samples, not the padding, of each pair."""
    return grid.total(jnp.where(positions(grid) < n, terms, 0.0))


def of_each_pair(
    values: Callable[[Array, Array], Array], shape: tuple[int, int], n: int, chunk: int
) -> Array:
    """[S, P] 30 times the statistic by its `values` [C] of pairs `row`, `col`, C at once."""
    rows, cols = shape
    chunks = -(-rows * cols // chunk)
    pairs = jnp.arange(chunks * chunk, dtype=jnp.int32) % (rows * cols)
    total = jax.lax.map(lambda pair: values(pair // cols, pair % cols), pairs.reshape(-1, chunk))
    total = total.reshape(-1)[: rows * cols]
    return scaled(total, n).reshape(shape)


def positions(grid: Grid) -> Array:
    """[T, K, W] the position in its pair's sequence that is kept at each place."""
    position = in_blocks(jnp.arange(grid.size, dtype=jnp.int32), grid)
    return grid.tile(jnp.broadcast_to(position, (grid.pairs, *position.shape[1:])))


class Views(NamedTuple):
    """V variables padded to the grid, under O orders of their ties (one where there are none).

    See `Ranks`. `first` and `last` are those of the first order.
    """

    order: Array  # [O V, K, B]
    rank: Array  # [O V, size]
    digit: Array  # [O V, size] uint8: first digit of the rank
    first: Array | None  # [V, K, B]
    last: Array | None

    @property
    def orders(self) -> int:
        """O."""
        return 1 if self.first is None else len(self.order) // len(self.first)

    def under(self, order: Array, variable: Array) -> Array:
        """Where the variable stands under an order; a slice of an order would be copied."""
        return order * (len(self.rank) // self.orders) + variable


def arrange(ranks: Ranks, grid: Grid, both_orders: bool = True) -> Views:
    """Pads with samples above all others in both variables, which count for nobody."""
    variables, n = ranks.rank.shape
    rest = jnp.arange(n, grid.size, dtype=jnp.int32)
    rest = jnp.broadcast_to(rest, (variables, grid.size - n))
    ranks = jax.tree.map(lambda part: jnp.concatenate([part, rest], axis=1), ranks)
    one = ranks.first is None or not both_orders
    orders = [ranks] if one else [ranks, reverse_ties(ranks)]
    rank = jnp.concatenate([jnp.asarray(view.rank) for view in orders])
    return Views(
        order=jnp.concatenate([in_blocks(view.order, grid) for view in orders]),
        rank=rank,
        digit=(rank // grid.blocks).astype(jnp.uint8),
        first=None if ranks.first is None else in_blocks(ranks.first, grid),
        last=None if ranks.last is None else in_blocks(ranks.last, grid),
    )


def in_blocks(sequences: Array | np.ndarray, grid: Grid) -> Array:
    """[V, size] -> [V, K, B]."""
    return jnp.asarray(sequences).reshape(-1, grid.blocks, grid.base).swapaxes(1, 2)


def _below(xs: Views, ys: Views, row: Array, col: Array, grid: Grid, weighted: bool) -> Below:
    """`Below` [T, K, W] of the pairs `row`, `col` [C] in x-order."""
    pair, _ = grid.block_numbers()
    position = positions(grid)
    p = read(ys.rank, xs.order, col, row, grid)
    first_x = last_x = position
    if xs.first is not None and xs.last is not None:
        first_x, last_x = grid.tile(xs.first[row]), grid.tile(xs.last[row])
    first_y = last_y = p
    tied = _any_tied(xs, row) | _any_tied(ys, col)
    if ys.first is not None and ys.last is not None:
        ends = ys.first[col], ys.last[col]

        def in_order() -> tuple[Array, Array]:
            place = grid.place(pair, p)
            first, last = (take(grid.tile(end), place) for end in ends)
            return first, last

        first_y, last_y = jax.lax.cond(tied, in_order, lambda: (p, p))
    weights = first_y + last_y if weighted else None
    if xs.orders * ys.orders == 1:
        digits = read(xs.digit, ys.order, row, col, grid)
        both, y_of_both = count_below(p, digits, grid, weights)
        if xs.first is not None or ys.first is not None:

            def corrected() -> tuple[Array, Array]:
                opposite = read(xs.rank, ys.order, row, col, grid)
                groups = _Groups(position, p, first_x, last_x, first_y, last_y, opposite)
                counts, weight = _corrections(groups, weights, grid)
                return both + counts, y_of_both + weight

            plain = both.astype(jnp.float64), y_of_both.astype(jnp.float64)
            both, y_of_both = jax.lax.cond(tied, corrected, lambda: plain)
    else:
        # Reversing the ties takes a sample to its mirror image in the group, and back.
        own = grid.place(pair, position), grid.place(pair, first_x + last_x - position)
        both, y_of_both = _tied_counts(xs, ys, row, col, grid, jnp.stack(own), weights)
    half, mean = jnp.float64(0.5), jnp.float64(1 / (xs.orders * ys.orders))
    return Below(
        x=half * (first_x + last_x),
        y=half * (first_y + last_y),
        both=mean * both,
        y_of_both=half * mean * y_of_both,
        tied_x=half * (last_x - first_x),
        tied_y=half * (last_y - first_y),
    )


def _any_tied(views: Views, variables: Array) -> Array:
    """[] bool: whether one of the variables [C] has ties."""
    if views.first is None or views.last is None:
        return jnp.array(False)
    return (views.first[variables] != views.last[variables]).any()


class _Groups(NamedTuple):
    """Of each sample [T, K, W], in x-order: where it stands, and from where to where its ties."""

    x: Array
    y: Array
    first_x: Array
    last_x: Array
    first_y: Array
    last_y: Array
    opposite: Array  # in y-order: where the sample stands in x


def _corrections(of: _Groups, weights: Array | None, grid: Grid) -> tuple[Array, Array]:
    """What midranks add to the counts and weights under one order of the ties.

    A sample tied in one variable counts half where it is below in the other, one tied in both a
    quarter; under an order it counted in full or not at all. Groups are small: it meets each of its
    own, one after the other.
    """
    pair, _ = grid.block_numbers()

    def next_in(first: Array, last: Array, own: Array, k: Array) -> tuple[Array, Array]:
        """The k-th after a sample in its group, around; and whether there is one."""
        size = last - first + 1
        there = k < size
        other = jnp.where(own + k > last, own + k - size, own + k)
        return jnp.where(there, other, own), there

    def in_x(k: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        x, there = next_in(of.first_x, of.last_x, of.x, k)
        place = grid.place(pair, x)
        y = take(of.y, place)
        tied = (of.first_y <= y) & (y <= of.last_y)
        share = jnp.where(tied, 0.25, jnp.where(y < of.y, 0.5, 0.0)) - ((y < of.y) & (x < of.x))
        return add(sums, jnp.where(there, share, 0.0), lambda weight: take(weight, place))

    def in_y(k: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        y, there = next_in(of.first_y, of.last_y, of.y, k)
        x = take(of.opposite, grid.place(pair, y))
        there = there & ((x < of.first_x) | (of.last_x < x))  # else it was met in x
        share = jnp.where(x < of.x, 0.5, 0.0) - ((x < of.x) & (y < of.y))
        return add(sums, jnp.where(there, share, 0.0), lambda weight: weight)

    def add(sums: tuple[Array, Array], share: Array, of_other: Callable[[Array], Array]):
        counts, weighed = sums
        return counts + share, weighed if weights is None else weighed + share * of_other(weights)

    zeros = jnp.zeros(of.y.shape, jnp.float64)
    sums = zeros, zeros
    most_x, most_y = (of.last_x - of.first_x).max() + 1, (of.last_y - of.first_y).max() + 1
    return jax.lax.fori_loop(1, most_y, in_y, jax.lax.fori_loop(1, most_x, in_x, sums))


def _tied_counts(
    xs: Views,
    ys: Views,
    row: Array,
    col: Array,
    grid: Grid,
    own: Array,
    weights: Array | None,
) -> tuple[Array, Array]:
    """Counts and weights summed over the orders of ties in x, times those in y.

    Their mean is the midrank's count: a sample tied in one variable counts half, in both a quarter.
    `own` [2, T, K, W] is where a sample is kept under each order in x.
    """

    def count(orders: Array) -> tuple[Array, Array]:
        in_x, in_y = orders
        at_x, at_y = xs.under(in_x, row), ys.under(in_y, col)
        found, weight = count_below(
            read(ys.rank, xs.order, at_y, at_x, grid),
            read(xs.digit, ys.order, at_x, at_y, grid),
            grid,
            None if weights is None else take(weights, own[in_x]),
        )
        return take(found, own[in_x]), take(weight, own[in_x])

    orders = jnp.indices((xs.orders, ys.orders), dtype=jnp.int32).reshape(2, -1).T
    counts, weight = jax.lax.map(count, orders)
    return counts.sum(axis=0), weight.sum(axis=0)


def read(values: Array, order: Array, of: Array, at: Array, grid: Grid) -> Array:
    """The values [V, size] of variables `of` in the order [V, K, B] of `at`, tiled.

    One pair after the other, which keeps XLA on CPU from repeating the reads in every user.
    """
    read = jax.lax.map(lambda i: take(values[i[0]], order[i[1]]), (of, at))
    return grid.tile(read)
