"""Ranks with their ties: each variable is sorted once, whatever the number of pairs it is in.

Shapes: V variables, N samples. Ranks count from 0 and are exact integers: nothing after this
module sees a sample's value, so that no cast can create a tie.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxdeconf import checks, threads

MIN_SAMPLES = 5  # D_n and R_n are means over quintuples of distinct samples
IN_CACHE = 2**15  # values that are ranked at once
FEW = 2**12  # values for which one call of NumPy is faster than ten quicker ones
MANY = 2**17  # values for which threads are worth their start


class Ranks(NamedTuple):
    """Ranks of V variables; tied samples are neighbours, in any order among themselves."""

    order: Array | np.ndarray  # [V, N] int32: the sample at each rank
    rank: Array | np.ndarray  # [V, N] int32: the rank of each sample; inverse of `order`
    first: Array | np.ndarray | None  # [V, N] int32: first rank of the tie group at each rank;
    last: Array | np.ndarray | None  # last; both None where it is known that there are no ties


def columns(name: str, value: ArrayLike) -> Array | np.ndarray:
    """`value` as [V, N] numbers; host arrays stay on the host, with the precision they came in."""
    array = checks.plain(name, value)
    if array.ndim not in (1, 2) or 0 in array.shape[1:]:
        raise ValueError(f"{name}: expected shape [N] or [N, V], got shape {array.shape}")
    kind = "b" if array.dtype == bool else "f" if jnp.issubdtype(array.dtype, jnp.floating) else ""
    if not kind and not jnp.issubdtype(array.dtype, jnp.integer):
        raise ValueError(f"{name}: expected real numbers, got dtype {array.dtype}")
    if not MIN_SAMPLES <= array.shape[0] < 2**31:  # ranks are int32
        expected = f"at least {MIN_SAMPLES} samples and below 2^31"
        raise ValueError(f"{name}: expected {expected}, got {array.shape[0]}")
    if kind == "b" or (kind == "f" and array.dtype.itemsize < 4):
        array = array.astype(np.float32)  # exact, and sortable everywhere
    array = array.reshape(array.shape[0], -1).T
    if kind == "f" and not isinstance(array, Tracer):
        missing = int(np.isnan(array).sum()) if isinstance(array, np.ndarray) else _count_nan(array)
        if missing:
            raise ValueError(f"{name}: expected no NaN, got {missing} NaN in {array.size} values")
    return array


def _count_nan(array: Array) -> int:
    return int(jnp.isnan(array).sum())


def both_ranked(x: np.ndarray, y: np.ndarray) -> tuple[Ranks, Ranks]:
    """`rank_on_host` of each of two tables, at once where both are large."""
    run = map if min(x.size, y.size) < MANY else threads.each
    of_x, of_y = run(rank_on_host, (x, y))
    return of_x, of_y


def rank_on_host(values: np.ndarray) -> Ranks:
    """Ranks of `values` [V, N] by NumPy, whose sort is several times faster than XLA's on CPU."""
    variables, n = values.shape
    order, rank = np.empty((2, variables, n), np.int32)
    step = max(1, IN_CACHE // n)
    index = np.arange(n, dtype=np.int32)

    def sort(start: int) -> np.ndarray:
        rows = slice(start, start + step)
        place, ordered = _sorted_places(_together(values[rows]))
        rank[rows].reshape(-1)[place] = index
        order[rows] = place - n * np.arange(len(place))[:, None]
        return ordered[:, 1:] != ordered[:, :-1]  # -0.0 == 0.0

    starts = range(0, variables, step)
    run = map if values.size < MANY or len(starts) == 1 else threads.each
    rises = list(run(sort, starts))
    if all(rise.all() for rise in rises):
        return Ranks(order, rank, None, None)
    first, last = np.empty((2, variables, n), np.int32)

    def group(start: int, rise: np.ndarray) -> None:
        rows, edge = slice(start, start + step), np.ones((len(rise), 1), bool)
        at = np.flatnonzero(np.hstack([edge, rise]))
        count = np.diff(at, append=len(rise) * n)
        at = (at % n).astype(np.int32)
        first[rows] = np.repeat(at, count).reshape(-1, n)
        last[rows] = np.repeat((at + count - 1).astype(np.int32), count).reshape(-1, n)

    list(run(lambda block: group(*block), zip(starts, rises, strict=True)))
    return Ranks(order, rank, first, last)


def _together(rows: np.ndarray) -> np.ndarray:
    """Rows of a table, each in one piece: also where they were columns, far apart in memory."""
    if rows.flags.c_contiguous:
        return rows
    return np.ascontiguousarray(np.ascontiguousarray(rows.T).T)  # reads the table once


def _sorted_places(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[V, N] where the values stand, flattened, in ascending order by row; and these values.

    Value and sample are sorted as one integer: that is vectorised, and takes a third of an argsort.
    The sample stands in the last bits, so that of 64-bit values only the first bits fit; where
    these do not suffice to sort a row, it is put right after.
    """
    rows, n = values.shape
    base = n * np.arange(rows)[:, None]
    if values.size < FEW or values.itemsize <= 2:  # a stable sort of a byte or two counts
        key = np.argsort(values, axis=1, kind=None if values.size < FEW else "stable") + base
        return key, values.reshape(-1)[key]
    width = (n - 1).bit_length()
    key = _host_key(values)
    if key.itemsize < 8:
        key = key.astype(np.int64) << 32
    key &= -1 << width
    key |= np.arange(n)
    key.sort(axis=1)
    key &= (1 << width) - 1
    key += base
    ordered = values.reshape(-1)[key]
    if values.itemsize == 8:
        for row in np.flatnonzero((ordered[:, 1:] < ordered[:, :-1]).any(axis=1)):
            order = _sorted_again(values[row], key[row] - n * row)
            key[row], ordered[row] = order + n * row, values[row, order]
    return key, ordered


def _sorted_again(values: np.ndarray, order: np.ndarray) -> np.ndarray:
    """[N] an order that is all but right, put right."""
    for _ in range(4):  # neighbours change places, as in a bubble sort
        ordered = values[order]
        falls = np.flatnonzero(ordered[1:] < ordered[:-1])
        if not falls.size:
            return order
        falls = falls[np.diff(falls, prepend=-2) > 1]
        order[falls], order[falls + 1] = order[falls + 1], order[falls]
    return np.argsort(values)


def _host_key(values: np.ndarray) -> np.ndarray:
    """Signed integers in the order of `values`, in a new array."""
    if values.dtype.kind == "u":
        return (values ^ values.dtype.type(1 << 8 * values.itemsize - 1)).view(
            f"i{values.itemsize}"
        )
    if values.dtype.kind == "i":
        return values.copy()
    bits = (values + values.dtype.type(0)).view(f"i{values.itemsize}")  # -0.0 is 0.0
    return bits ^ (bits >> (8 * bits.itemsize - 1)) & np.iinfo(bits.dtype).max


def rank_on_device(values: Array) -> tuple[Ranks, Array]:
    """Ranks of `values` [V, N] and the most that are tied, traceable; call under 64-bit types."""
    n = values.shape[1]
    index = jnp.broadcast_to(jnp.arange(n, dtype=jnp.int32), values.shape)
    key = integer_key(values)
    if key.dtype == jnp.int64:
        ordered, order = jax.lax.sort((key, index), dimension=1, num_keys=1, is_stable=True)
    else:  # one packed int64 sorts several times faster than a pair of operands
        packed = jnp.sort((key.astype(jnp.int64) << 32) | index.astype(jnp.int64), axis=1)
        ordered, order = packed >> 32, (packed & 0xFFFFFFFF).astype(jnp.int32)
    variable = jnp.arange(values.shape[0])[:, None]
    rank = jnp.zeros_like(order).at[variable, order].set(index, unique_indices=True)
    same = ordered[:, 1:] == ordered[:, :-1]
    edge = jnp.ones((values.shape[0], 1), bool)
    first = jnp.where(jnp.concatenate([edge, ~same], axis=1), index, 0)
    last = jnp.where(jnp.concatenate([~same, edge], axis=1), index, n - 1)
    first = jax.lax.cummax(first, axis=1)
    last = jax.lax.cummin(last, axis=1, reverse=True)
    return Ranks(order, rank, first, last), (last - first).max() + 1


def integer_key(values: Array) -> Array:
    """Integers in the order of `values`: compared as floats, subnormals would tie with zero."""
    if not jnp.issubdtype(values.dtype, jnp.floating):
        wide = values.dtype in (jnp.uint32, jnp.int64, jnp.uint64)
        if values.dtype == jnp.uint64:  # flip the top bit, which is then a sign
            values = values ^ jnp.uint64(1 << 63)
            return jax.lax.bitcast_convert_type(values, jnp.int64)
        return values.astype(jnp.int64 if wide else jnp.int32)
    integer = jnp.int32 if values.dtype == jnp.float32 else jnp.int64
    bits = jax.lax.bitcast_convert_type(values, integer)
    lowest = jnp.array(jnp.iinfo(integer).min, integer)
    bits = jnp.where(bits == lowest, 0, bits)  # -0.0 ties with 0.0
    return jnp.where(bits < 0, bits ^ ~lowest, bits)


def largest_group(ranks: Ranks) -> int:
    """The most samples that are tied with one another."""
    if ranks.first is None or ranks.last is None:
        return 1
    return int((ranks.last - ranks.first).max()) + 1


def reverse_ties(ranks: Ranks) -> Ranks:
    """The same ranks with the samples of each tie group in the opposite order."""
    ends = jnp.asarray(ranks.first) + jnp.asarray(ranks.last)
    index = jnp.arange(ends.shape[1], dtype=jnp.int32)[None]
    order = jnp.take_along_axis(jnp.asarray(ranks.order), ends - index, axis=1)
    rank = jnp.take_along_axis(ends, ranks.rank, axis=1) - ranks.rank
    return ranks._replace(order=order, rank=rank)
