"""Initial variables: the scale of each kernel, and what is not drawn."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf.nets.initial import draw

SHAPES = {
    "conv": {"kernel": jnp.zeros((3, 3, 16, 64)), "bias": jnp.zeros(64)},
    "last": {"kernel": jnp.zeros((64, 100))},
    "norm": {"scale": jnp.zeros(64), "mean": jnp.zeros(64), "var": jnp.zeros(64)},
}


def test_kernels_have_the_stated_variance_and_share_no_numbers():
    filled = draw(SHAPES, jax.random.key(0), gain=2)
    # 9,216 and 6,400 draws: the standard deviation is known within 3 %, four of its own errors.
    np.testing.assert_allclose(filled["conv"]["kernel"].std(), (2 / 144) ** 0.5, rtol=0.03)
    np.testing.assert_allclose(filled["last"]["kernel"].std(), (2 / 64) ** 0.5, rtol=0.04)
    a = filled["conv"]["kernel"].ravel()[:6400] * 144**0.5
    b = filled["last"]["kernel"].ravel() * 64**0.5
    assert abs(jnp.corrcoef(a, b)[0, 1]) < 0.05


def test_the_rest_is_zero_or_one():
    filled = draw(SHAPES, jax.random.key(0), gain=2, silent=("last",))
    assert not filled["conv"]["bias"].any()
    assert not filled["last"]["kernel"].any()
    assert (filled["norm"]["scale"] == 1).all()
    assert (filled["norm"]["var"] == 1).all()
    assert not filled["norm"]["mean"].any()
