"""For each sample of a pair of variables, how many samples lie below it in both: the costly part.

A permutation p (the y-rank of the sample at each x-rank) is counted on a grid of base K and L
levels, K^L >= N. On level 0 the x-ranks fall into K runs by their first digit; every sample
counts the samples of earlier runs below it in y. Each run is then a smaller permutation, level 1,
and so on; the last level compares the K samples of a run directly. A level reads the stream of
digits in y-order, in blocks of K: earlier blocks through a histogram with two prefix sums,
its own block by comparing all of it. (With K = 2 this is a wavelet tree.) Work: N L K
eight-bit compares, which vectorise; memory: O(N).

Shapes: C pairs in a chunk, K base, B = K^(L-1) blocks a pair. The C B blocks are dealt to T tiles
of W lanes; position q of a pair's sequence is kept at [tile, q % K, lane] of its block q // K.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array


class Grid(NamedTuple):
    """How C pairs of permutations are laid out; `size` positions a pair, the last are padding."""

    base: int
    blocks: int  # B, of a pair
    pairs: int
    lanes: int
    unroll: bool = True  # see `over_rows`

    @property
    def size(self) -> int:
        """Positions of a pair, N and the padding."""
        return self.base * self.blocks

    @property
    def tiles(self) -> int:
        """T."""
        return self.pairs * self.blocks // self.lanes

    def place(self, pair: Array, position: Array) -> Array:
        """Where a pair's position is kept, in the flattened [T, K, W]."""
        block = pair * self.blocks + position // self.base
        row = block // self.lanes * self.base + position % self.base
        return row * self.lanes + block % self.lanes

    def tile(self, sequences: Array) -> Array:
        """[C, K, B] -> [T, K, W]."""
        split = (-1, self.lanes // self.blocks, self.base, self.blocks)  # pairs of a tile
        if self.lanes < self.blocks:  # tiles of a pair
            sequences = sequences.reshape(self.pairs, self.base, -1, self.lanes).swapaxes(1, 2)
        else:
            sequences = sequences.reshape(split).swapaxes(1, 2)
        return sequences.reshape(self.tiles, self.base, self.lanes)

    def block_numbers(self) -> tuple[Array, Array]:
        """The pair and the block within it of each [T, 1, W]."""
        number = jnp.arange(self.tiles * self.lanes, dtype=jnp.int32)
        number = number.reshape(self.tiles, 1, self.lanes)
        return number // self.blocks, number % self.blocks

    def total(self, values: Array) -> Array:
        """Sums values [T, K, W] over each pair: [C]."""
        return values.sum(axis=1).reshape(self.pairs, self.blocks).sum(axis=1)


def plan(n: int, pairs: int, platform: str) -> Grid:
    """The grid for n samples and up to `pairs` pairs at once.

    Two levels while a base of at most 104 does, then bases up to 64. There are two tiles at
    least: XLA unrolls a loop of one, and would then recount a block for each sample that reads
    it. On CPU a tile stays in the first cache and its lanes fill whole vectors.
    """
    levels = 2
    while (104 if levels == 2 else 64) ** levels < n:
        levels += 1
    step = 8 if levels == 2 else 2
    base = step
    while base**levels < n:
        base += step
    blocks = base ** (levels - 1)
    if pairs == 1 or (levels > 2 and platform == "cpu"):
        halves = base * base // 2 if levels > 3 and platform == "cpu" else blocks // 2
        return Grid(base, blocks, 1, halves, platform == "cpu")
    width = 8 if platform == "cpu" else max(1, 2**24 // base**levels)  # pairs in a tile
    while width > 1 and pairs <= width:
        width //= 2
    tiles = min(4, -(-pairs // width))
    return Grid(base, blocks, width * tiles, width * blocks, platform == "cpu")


def count_below(
    p: Array, digits: Array, grid: Grid, weights: Array | None = None
) -> tuple[Array, Array]:
    """[T, K, W] int32 samples below in both, in x-order, and the int64 sum of their weights.

    Args:
      p: [T, K, W] int32 in x-order: the y-rank of each sample.
      digits: [T, K, W] uint8 in y-order: the first digit of each sample's x-rank.
      grid: the layout.
      weights: [T, K, W] int32 in x-order; without them the sum is 0, and costs nothing.
    """
    base, unroll = grid.base, grid.unroll
    of_digits = partial(histogram, size=base, unroll=unroll)
    count_less = partial(count_earlier, compare=jnp.less, unroll=unroll)
    count_equal = partial(count_earlier, compare=jnp.equal, unroll=unroll)
    weigh_digits = partial(_weigh_digits, unroll=unroll)
    weigh_less = partial(_weigh_less, unroll=unroll)
    pair, block = grid.block_numbers()
    count, weight = jnp.zeros(p.shape, jnp.int32), jnp.zeros(p.shape, jnp.int64)
    run_blocks = grid.blocks  # blocks of one run of the level above
    while run_blocks > 1:
        digit = block // (run_blocks // base) % base
        run = block // run_blocks
        place = grid.place(pair, run * run_blocks * base + p)
        if run_blocks < grid.blocks:
            digits = scatter(place, jnp.broadcast_to(digit, place.shape).astype(jnp.uint8))
        equal, less = cumulative(tiled(of_digits, digits), grid, run_blocks)
        cell = (digit * run_blocks + p // base) * less.shape[-1]
        cell = cell + pair * (grid.blocks // run_blocks) + run
        count = count + take(less, cell) + take(tiled(count_less, digits), place)
        if weights is not None:
            stream = scatter(place, weights)
            heavier = cumulative(tiled(weigh_digits, (digits, stream)), grid, run_blocks)[1]
            weight = weight + take(heavier, cell)
            weight = weight + take(tiled(weigh_less, (digits, stream)), place)
        if run_blocks > base:
            p = take(equal, cell) + take(tiled(count_equal, digits), place)
        run_blocks //= base
    p = p.astype(jnp.uint16)
    if weights is not None:
        weight = weight + tiled(weigh_less, (p, weights))
    return count + tiled(count_less, p), weight


def cumulative(histograms: Array, grid: Grid, run_blocks: int) -> tuple[Array, Array]:
    """Samples of the run in earlier blocks with the same, and with a smaller, digit.

    [D, blocks of a run, runs] each, from the histogram [T, D, W] of every block, of D digits:
    counts are int32, sums of weights int64.
    """
    digits = histograms.shape[1]
    rows = histograms.transpose(1, 0, 2).reshape(digits, -1, run_blocks).transpose(2, 0, 1)
    rows = rows.astype(jnp.int32 if histograms.dtype == jnp.uint8 else jnp.int64)
    equal = _prefix(rows, grid.base).swapaxes(0, 1)
    return equal, scan_sum(equal)[0]


def take(values: Array, index: Array) -> Array:
    """values, flattened, at indices known to be in bounds."""
    return values.reshape(-1).at[index].get(mode="promise_in_bounds")


def scatter(place: Array, values: Array) -> Array:
    """The values [T, K, W], each put at a place of its own in the flattened [T, K, W]."""
    stream = jnp.zeros(place.size, values.dtype).at[place.reshape(-1)]
    stream = stream.set(values.reshape(-1), unique_indices=True, mode="promise_in_bounds")
    return stream.reshape(place.shape)


def tiled(function: Callable, blocks: Array | tuple[Array, ...]) -> Any:
    """`function` of one tile after the other."""
    return jax.lax.map(function, blocks)


def over_rows(term: Callable[..., Array], *rows: Array, unroll: bool) -> Array:
    """Sums term(k, the k-th of rows [K, ...]) over k, on a CPU unrolled: one vector loop.

    Elsewhere as a reduction: loops that long take a GPU seconds to compile.
    """
    number = jnp.arange(rows[0].shape[0], dtype=jnp.uint8)
    if not unroll:
        terms = jax.vmap(term)(number, *(part[:, None] for part in rows))
        return terms.sum(axis=0, dtype=terms.dtype)
    total = term(0, *(part[:1] for part in rows))
    for k in range(1, len(number)):
        total = total + term(k, *(part[k : k + 1] for part in rows))
    return total


def count_earlier(block: Array, compare: Callable[[Array, Array], Array], unroll: bool) -> Array:
    """[K, W] uint8: earlier rows that compare to the row."""
    row = _numbers(block)
    return over_rows(
        lambda k, one: (compare(one, block) & (row > k)).astype(jnp.uint8), block, unroll=unroll
    )


def histogram(block: Array, size: int, unroll: bool) -> Array:
    """[size, W] uint8: rows of the block [K, W] that hold each digit."""
    digit = jnp.arange(size, dtype=jnp.uint8)[:, None]
    return over_rows(lambda _, one: (one == digit).astype(jnp.uint8), block, unroll=unroll)


def _weigh_less(tile: tuple[Array, Array], unroll: bool) -> Array:
    """[K, W] int32: summed weights of the earlier rows that are less than the row."""
    block, row = tile[0], _numbers(tile[0])

    def term(k: Array | int, one: Array, weight: Array) -> Array:
        return jnp.where((one < block) & (row > k), weight, 0)

    return over_rows(term, *tile, unroll=unroll)


def _weigh_digits(tile: tuple[Array, Array], unroll: bool) -> Array:
    """[K, W] int32: summed weights of the rows of the block that hold each digit."""
    digit = _numbers(tile[0])
    return over_rows(
        lambda _, one, weight: jnp.where(one == digit, weight, 0), *tile, unroll=unroll
    )


def _numbers(block: Array) -> Array:
    """[K, 1] of the rows of a block."""
    return jnp.arange(block.shape[0], dtype=jnp.uint8)[:, None]


def scan_sum(rows: Array) -> tuple[Array, Array]:
    """Exclusive prefix sums over axis 0 and the total; jnp.cumsum is many times slower on CPU."""
    total, before = jax.lax.scan(
        lambda carry, row: (carry + row, carry), jnp.zeros_like(rows[0]), rows
    )
    return before, total


def _prefix(rows: Array, base: int) -> Array:
    """Exclusive prefix sums over axis 0, in short scans where its length is a power of `base`."""
    length, *rest = rows.shape
    if length <= base or length % base:
        return scan_sum(rows)[0]
    split = rows.reshape(length // base, base, *rest).swapaxes(0, 1)
    before, total = scan_sum(split)
    return (before + _prefix(total, base)[None]).swapaxes(0, 1).reshape(rows.shape)
