"""Rank statistics of every column of x against every column of y, in one jitted call.

Shapes: N samples, S columns of x, P columns of y, C pairs in a chunk, K and B as in `counts`.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxdeconf.independence.counts import Grid, count_below, plan, take
from jaxdeconf.independence.ranks import (
    Ranks,
    columns,
    rank_on_device,
    rank_on_host,
    reverse_ties,
)


class Below(NamedTuple):
    """What lies below each sample, float64, samples tied with it counted half."""

    x: Array  # samples below in x: the midrank - 1
    y: Array
    both: Array
    y_of_both: Array  # sum of `y` over the samples below in both
    tied_x: Array  # half the number of other samples tied with it in x
    tied_y: Array


Total = Callable[[Array], Array]  # sums over the samples of each pair


class Statistic(NamedTuple):
    """A statistic of a pair, times N (N-1) ... (N-4)."""

    value: Callable[[Below, int, Total], Array]
    weighted: bool  # it reads `y_of_both`


def all_pairs(x: ArrayLike, y: ArrayLike, statistic: Statistic) -> Array:
    """30 times the statistic for each pair; shapes and errors as `hoeffding_d`."""
    xs, ys = columns("x", x), columns("y", y)
    if xs.shape[1] != ys.shape[1]:
        raise ValueError(f"y: expected {xs.shape[1]} samples, as x has, got {ys.shape[1]}")
    shape = np.shape(x)[1:] + np.shape(y)[1:]
    platform = jax.default_backend()
    dtype = jnp.result_type(float)
    settings = _Settings(statistic, platform, shape)
    traced = isinstance(xs, Tracer) or isinstance(ys, Tracer)
    with jax.enable_x64(True):
        if platform == "cpu" and not traced:
            ranks = rank_on_host(np.asarray(xs)), rank_on_host(np.asarray(ys))
            result = _from_ranks(*ranks, settings)
        else:
            result = _from_values(jnp.asarray(xs), jnp.asarray(ys), settings)
        return jax.lax.convert_element_type(result, dtype)


class _Settings(NamedTuple):
    """What a compiled pass depends on beside its shapes."""

    statistic: Statistic
    platform: str
    shape: tuple[int, ...]


@partial(jax.jit, static_argnames="settings")
def _from_values(x: Array, y: Array, settings: _Settings) -> Array:
    (ranks_x, tied_x), (ranks_y, tied_y) = rank_on_device(x), rank_on_device(y)
    result = jax.lax.cond(
        tied_x | tied_y,
        lambda: _from_ranks(ranks_x, ranks_y, settings),
        lambda: _from_ranks(
            ranks_x._replace(first=None, last=None),
            ranks_y._replace(first=None, last=None),
            settings,
        ),
    )
    missing = jnp.isnan(x).any(axis=1)[:, None] | jnp.isnan(y).any(axis=1)[None, :]
    return jnp.where(missing.reshape(settings.shape), jnp.nan, result)


@partial(jax.jit, static_argnames="settings")
def _from_ranks(x: Ranks, y: Ranks, settings: _Settings) -> Array:
    (rows, n), cols = x.rank.shape, y.rank.shape[0]
    grid = plan(n, rows * cols, settings.platform)
    views_x, views_y = _arrange(x, grid), _arrange(y, grid)

    def one_chunk(pair: Array) -> Array:
        row, col = pair // cols, pair % cols
        below, real = _below(views_x, views_y, row, col, n, grid, settings.statistic.weighted)
        return settings.statistic.value(
            below, n, lambda terms: grid.total(jnp.where(real, terms, 0.0))
        )

    chunks = -(-rows * cols // grid.pairs)
    pairs = jnp.arange(chunks * grid.pairs, dtype=jnp.int32) % (rows * cols)
    total = jax.lax.map(one_chunk, pairs.reshape(chunks, grid.pairs))
    total = total.reshape(-1)[: rows * cols]
    quintuples = float(n) * (n - 1.0) * (n - 2.0) * (n - 3.0) * (n - 4.0)
    return (30.0 / quintuples * total).reshape(settings.shape)


class _Views(NamedTuple):
    """V variables padded to the grid, under O orders of their ties (one where there are none).

    See `Ranks`. `first` and `last` are those of the first order.
    """

    order: Array  # [O, V, K, B]
    rank: Array  # [O, V, size]
    digit: Array  # [O, V, size] uint8: first digit of the rank
    first: Array | None  # [V, K, B]
    last: Array | None


def _arrange(ranks: Ranks, grid: Grid) -> _Views:
    """Pads with samples above all others in both variables, which count for nobody."""
    variables, n = ranks.rank.shape
    rest = jnp.arange(n, grid.size, dtype=jnp.int32)
    rest = jnp.broadcast_to(rest, (variables, grid.size - n))
    ranks = jax.tree.map(lambda part: jnp.concatenate([part, rest], axis=1), ranks)
    orders = [ranks] if ranks.first is None else [ranks, reverse_ties(ranks)]
    rank = jnp.stack([view.rank for view in orders])
    return _Views(
        order=jnp.stack([_blocks(view.order, grid) for view in orders]),
        rank=rank,
        digit=(rank // grid.blocks).astype(jnp.uint8),
        first=None if ranks.first is None else _blocks(ranks.first, grid),
        last=None if ranks.last is None else _blocks(ranks.last, grid),
    )


def _blocks(sequences: Array | np.ndarray, grid: Grid) -> Array:
    """[V, size] -> [V, K, B]."""
    return jnp.asarray(sequences).reshape(-1, grid.blocks, grid.base).swapaxes(1, 2)


def _below(
    xs: _Views, ys: _Views, row: Array, col: Array, n: int, grid: Grid, weighted: bool
) -> tuple[Below, Array]:
    """`Below` [T, K, W] of the pairs `row`, `col` [C] in x-order, and which places are samples."""
    pair, _ = grid.block_numbers()
    position = _blocks(jnp.arange(grid.size, dtype=jnp.int32), grid)
    position = grid.tile(jnp.broadcast_to(position, (grid.pairs, *position.shape[1:])))
    p = _read(ys.rank[0], xs.order[0], col, row, grid)
    first_x = last_x = position
    if xs.first is not None and xs.last is not None:
        first_x, last_x = grid.tile(xs.first[row]), grid.tile(xs.last[row])
    first_y = last_y = p
    if ys.first is not None and ys.last is not None:
        place = grid.place(pair, p)
        first_y, last_y = (take(grid.tile(ends[col]), place) for ends in (ys.first, ys.last))
    weights = first_y + last_y if weighted else None
    if xs.first is None and ys.first is None:
        digits = _read(xs.digit[0], ys.order[0], row, col, grid)
        both, y_of_both = count_below(p, digits, grid, weights)
    else:
        # Reversing the ties takes a sample to its mirror image in the group, and back.
        own = grid.place(pair, position), grid.place(pair, first_x + last_x - position)
        both, y_of_both = _tied_counts(xs, ys, row, col, grid, jnp.stack(own), weights)
    half, mean = jnp.float64(0.5), jnp.float64(1 / (len(xs.rank) * len(ys.rank)))
    below = Below(
        x=half * (first_x + last_x),
        y=half * (first_y + last_y),
        both=mean * both,
        y_of_both=half * mean * y_of_both,
        tied_x=half * (last_x - first_x),
        tied_y=half * (last_y - first_y),
    )
    return below, position < n


def _tied_counts(
    xs: _Views,
    ys: _Views,
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
        found, weight = count_below(
            _read(ys.rank[in_y], xs.order[in_x], col, row, grid),
            _read(xs.digit[in_x], ys.order[in_y], row, col, grid),
            grid,
            None if weights is None else take(weights, own[in_x]),
        )
        return take(found, own[in_x]), take(weight, own[in_x])

    orders = jnp.indices((len(xs.rank), len(ys.rank)), dtype=jnp.int32).reshape(2, -1).T
    counts, weight = jax.lax.map(count, orders)
    return counts.sum(axis=0), weight.sum(axis=0)


def _read(values: Array, order: Array, of: Array, at: Array, grid: Grid) -> Array:
    """The values [V, size] of variables `of` in the order [V, K, B] of `at`, tiled.

    One pair after the other, which keeps XLA on CPU from repeating the reads in every user.
    """
    read = jax.lax.map(lambda i: take(values[i[0]], order[i[1]]), (of, at))
    return grid.tile(read)
