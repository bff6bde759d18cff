"""Permutation p-values: exact in level for any margins, discrete ones above all.

Source: Davison & Hinkley, "Bootstrap Methods and their Application" (1997), section 4.3.
Shapes: N samples, S columns of x, P columns of y, G permutations in a batch.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxdeconf import checks
from jaxdeconf.independence.hoeffding import hoeffding_d
from jaxdeconf.independence.ranks import columns, rank_on_host

BATCH_PAIRS = 64  # pairs in one pass: enough to fill it, few enough that memory stays small


def permutation_p_value(
    x: ArrayLike,
    y: ArrayLike,
    key: Array,
    permutations: int = 1000,
    statistic: Callable[[ArrayLike, ArrayLike], Array] = hoeffding_d,
) -> Array:
    """The share of permutations of y's samples whose statistic is at least the observed one.

    The observed order counts as one of them: (1 + exceedances) / (1 + permutations), which is
    at most alpha with probability at most alpha under independence, ties or not.

    Args:
      x: [N] or [N, S] real numbers, N >= 5.
      y: [N] or [N, P] real numbers; each permutation moves whole rows.
      key: random key of the permutations.
      permutations: number of random permutations, at least 1.
      statistic: `hoeffding_d` or `refined_d`.
    Returns:
      [], [P], [S] or [S, P], in [1 / (1 + permutations), 1].
    """
    checks.integer("permutations", permutations)
    checks.key("key", key)
    if not callable(statistic):
        raise ValueError(f"statistic: expected a function of x and y, got {statistic!r}")
    xs, ys = _ordinal("x", x), _ordinal("y", y)
    values = _permuted(xs, ys, key, permutations, statistic)
    # Equal values are frequent with discrete margins, and must not differ by their rounding.
    level = values[0] - 1e-5 * jnp.abs(values[0])
    shape = np.shape(x)[1:] + np.shape(y)[1:]
    return jnp.mean(values >= level[None], axis=0, dtype=float).reshape(shape)


def _ordinal(name: str, value: ArrayLike) -> Array:
    """[N, V]: on the host the values' ranks instead, which no cast on the way can make tie."""
    values = columns(name, value)
    if isinstance(values, Tracer):
        return values.T
    ranks = rank_on_host(np.asarray(values))
    rank = np.asarray(ranks.rank)
    if ranks.first is not None:
        rank = np.take_along_axis(np.asarray(ranks.first), rank, axis=1)
    return jnp.asarray(rank.T)


@partial(jax.jit, static_argnames=("permutations", "statistic"))
def _permuted(x: Array, y: Array, key: Array, permutations: int, statistic: Callable) -> Array:
    """[1 + permutations, S, P]: the statistic as observed, and under each permutation."""
    (n, cols), rows = y.shape, x.shape[1]
    batch = min(1 + permutations, max(1, BATCH_PAIRS // (rows * cols)))
    batches = -(-(1 + permutations) // batch)

    def order(number: Array, order_key: Array) -> Array:
        return jnp.where(number == 0, jnp.arange(n), jax.random.permutation(order_key, n))

    def values(numbered_keys: tuple[Array, Array]) -> Array:
        shuffled = y[jax.vmap(order)(*numbered_keys)]  # [G, N, P]
        columns_of_batch = shuffled.swapaxes(0, 1).reshape(n, batch * cols)
        return statistic(x, columns_of_batch).reshape(rows, batch, cols).swapaxes(0, 1)

    numbers = jnp.arange(batches * batch).reshape(batches, batch)
    keys = jax.random.split(key, (batches, batch))
    every = jax.lax.map(values, (numbers, keys)).reshape(-1, rows, cols)
    return every[: 1 + permutations]
