"""The same statistics by comparing every sample with every other, as matrix products.

For an accelerator. A sample compared with all N gives a matrix [S, N] for the columns of x, and one
[P, N] for those of y: 2 where the other lies below it, 1 where it is tied, 0 above. Their product
over the N counts, for all S P pairs at once, what lies below in both. That is N^2 work a pair, and
no sort, scan or gather: tensor cores do it faster than anything counts in N log N, up to `MOST`
samples. Factors are bytes (an H100 takes longer in bfloat16) and sums 32-bit integers. Weights are
multiplied six bits at a time.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf.independence.ranks import Ranks
from jaxdeconf.independence.statistic import Below, Statistic, scaled

MOST = 2**15  # samples
_DIGIT = 6  # bits; twice the largest digit fits into a byte
_FACTORS = 2**27  # bytes, of those that are there at once
_COUNTS = 2**30  # bytes


class Columns(NamedTuple):
    """V columns of N samples."""

    twice: Array  # [V, N] int32: twice the samples below, those tied with it counted half
    tied: Array  # [V, N] int32: other samples tied with it


def compared(key: Array) -> Columns:
    """Columns of integers [V, N] in the order of their values, without sorting them."""
    below = (key[:, :, None] > key[:, None, :]).sum(axis=2, dtype=jnp.int32)
    tied = (key[:, :, None] == key[:, None, :]).sum(axis=2, dtype=jnp.int32) - 1
    return Columns(2 * below + tied, tied)


def ranked(ranks: Ranks) -> Columns:
    """Columns that have been ranked."""
    rank = jnp.asarray(ranks.rank)
    if ranks.first is None or ranks.last is None:
        return Columns(2 * rank, jnp.zeros_like(rank))
    first, last = (jnp.take_along_axis(jnp.asarray(end), rank, axis=1) for end in ranks[2:])
    return Columns(first + last, last - first)


def from_columns(x: Columns, y: Columns, statistic: Statistic) -> Array:
    """[S, P] float64: 30 times the statistic of each pair; traced under 64-bit types."""
    (rows, n), cols = x.twice.shape, y.twice.shape[0]
    width = max(1, min(cols, _COUNTS // (8 * n * rows)))  # columns of y at once
    chosen = jnp.arange(-(-cols // width) * width) % cols

    def values(col: Array) -> Array:
        below = _below(x, Columns(y.twice[col], y.tied[col]), statistic.weighted)
        return statistic.value(below, n, lambda terms: terms.sum(axis=0))

    found = jax.lax.map(values, chosen.reshape(-1, width))  # [., S, width]
    return scaled(jnp.moveaxis(found, 1, 0).reshape(rows, -1)[:, :cols], n)


def _below(x: Columns, y: Columns, weighted: bool) -> Below:
    """`Below` [N, S, P]; what is the same for all columns of one side has a 1 there."""
    (rows, n), cols = x.twice.shape, y.twice.shape[0]
    digits = range(0, (2 * n).bit_length() if weighted else 0, _DIGIT)
    factors = n * (rows + cols * (1 + len(digits)))  # of a sample
    step = max(1, min(n, _FACTORS // factors))
    sample = jnp.minimum(jnp.arange(-(-n // step) * step), n - 1)

    def products(sample: Array) -> tuple[Array, Array]:
        """Four times the samples below in both [step, S, P], and that of y's `twice`."""
        in_x, in_y = _lies_below(x, sample), _lies_below(y, sample)
        weight = jnp.zeros((len(sample), rows, cols if digits else 1), jnp.int64)
        for bits in digits:
            digit = y.twice >> bits & 2**_DIGIT - 1
            weight += _product(in_x, in_y * digit.astype(jnp.int8)).astype(jnp.int64) << bits
        return _product(in_x, in_y), weight

    found = jax.lax.map(products, sample.reshape(-1, step))
    count, weight = (part.reshape(-1, *part.shape[2:])[:n] for part in found)
    twice_x, twice_y = x.twice.T[:, :, None], y.twice.T[:, None, :]
    return Below(
        x=0.5 * twice_x,
        y=0.5 * twice_y,
        both=0.25 * (count - 1),  # a sample is tied with itself
        y_of_both=0.125 * (weight - twice_y),
        tied_x=0.5 * x.tied.T[:, :, None],
        tied_y=0.5 * y.tied.T[:, None, :],
    )


def _lies_below(columns: Columns, sample: Array) -> Array:
    """[step, V, N] int8: 2 where another lies below the sample, 1 tied, 0 above."""
    own = columns.twice[:, sample].T[:, :, None]
    return (1 + jnp.clip(own - columns.twice, -1, 1)).astype(jnp.int8)


def _product(x: Array, y: Array) -> Array:
    """[step, S, P] int32 of bytes [step, S, N] and [step, P, N]."""
    return jnp.einsum("isj,ipj->isp", x, y, preferred_element_type=jnp.int32)
