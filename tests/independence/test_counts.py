import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.independence.counts import Grid, count_below, plan


@pytest.mark.parametrize("grid", [Grid(8, 8, 6, 16), Grid(4, 256, 3, 64), Grid(2, 32, 1, 4)])
def test_counts_and_weights_on_every_level(grid):
    """Small bases reach the levels that only samples of millions use. Against direct counts."""
    rng = np.random.default_rng(grid.size)
    p = rng.permuted(np.tile(np.arange(grid.size), (grid.pairs, 1)), axis=1)
    weights = rng.integers(0, 1000, size=p.shape)
    in_y_order = np.argsort(p, axis=1) // (grid.size // grid.base)
    earlier = np.arange(grid.size)[None, :] < np.arange(grid.size)[:, None]
    lower = earlier & (p[:, None, :] < p[:, :, None])

    def laid_out(sequences: np.ndarray, dtype: jnp.dtype) -> jax.Array:
        blocks = sequences.reshape(grid.pairs, grid.blocks, grid.base).swapaxes(1, 2)
        return grid.tile(jnp.asarray(blocks, dtype))

    with jax.enable_x64(True):
        count, weight = jax.jit(count_below, static_argnums=2)(
            laid_out(p, jnp.int32),
            laid_out(in_y_order, jnp.uint8),
            grid,
            laid_out(weights, jnp.int32),
        )
    want_weight = (lower * weights[:, None, :]).sum(axis=2)
    np.testing.assert_array_equal(count, laid_out(lower.sum(axis=2), jnp.int32))
    np.testing.assert_array_equal(weight, laid_out(want_weight, jnp.int32))


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
@pytest.mark.parametrize("pairs", [1, 2, 5, 24, 100_000])
@pytest.mark.parametrize("n", [5, 64, 1000, 4096, 10_816, 10_817, 10**5, 10**6, 10**7])
def test_plan_fits(n, pairs, platform):
    grid = plan(n, pairs, platform)
    assert n <= grid.size <= max(64, 2.4 * n)
    assert grid.base <= 104  # counts of a block are eight-bit
    assert grid.tiles * grid.lanes == grid.pairs * grid.blocks
    assert grid.tiles > 1
    assert grid.lanes % grid.blocks == 0 or grid.blocks % grid.lanes == 0
    assert grid.pairs * grid.size <= max(4 * 2**24, 1.5 * grid.size)
