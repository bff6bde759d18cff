"""Max-pooling against Flax's reduce-window, ties included."""

import jax
import jax.numpy as jnp
import pytest
from flax import linen as nn

from jaxdeconf.nets.cpu import max_pool


@pytest.mark.parametrize("shape", [(2, 8, 6, 3), (2, 7, 5, 3), (1, 1, 1, 1), (2, 2, 3, 2)])
def test_values_and_gradient_equal_reduce_window(shape):
    # Half-integers: most windows hold their maximum more than once.
    x = jnp.round(2 * jax.random.normal(jax.random.key(0), shape)) / 2
    ours, pull = jax.vjp(max_pool, x)
    theirs, their_pull = jax.vjp(lambda x: nn.max_pool(x, (3, 3), (2, 2), ((1, 1), (1, 1))), x)
    assert (ours == theirs).all()
    cotangent = jax.random.normal(jax.random.key(1), ours.shape)
    assert jnp.allclose(pull(cotangent)[0], their_pull(cotangent)[0], rtol=1e-6)


def test_gradient_under_vmap_equals_loop():
    x = jax.random.normal(jax.random.key(0), (3, 2, 6, 6, 2))

    def gradient(x):
        return jax.grad(lambda x: (max_pool(x) ** 2).sum())(x)

    assert (jax.vmap(gradient)(x) == jnp.stack([gradient(v) for v in x])).all()
