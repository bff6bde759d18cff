"""The VQ-VAE's codes and its gradient against their definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.nets import vq
from jaxdeconf.nets.vq import VQConfig

CONFIG = VQConfig(codes=6, dimension=3, channels=(4, 4, 4))
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def images():
    return jax.random.uniform(jax.random.key(1), (5, 16, 24, 3))


@pytest.fixture(scope="module")
def variables(images):
    return jax.jit(vq.init, static_argnums=0)(CONFIG, KEY, images)


def test_a_map_has_an_eighth_of_the_side_and_becomes_an_image_again(variables, images):
    maps = jax.jit(vq.encode, static_argnums=0)(CONFIG, variables, images)
    assert maps.shape == (5, 2, 3, 3)
    assert jax.jit(vq.decode, static_argnums=0)(CONFIG, variables, maps).shape == images.shape
    assert variables["params"]["codes"].shape == (6, 3)


def test_codes_begin_at_places_of_the_images_each_at_another(variables, images):
    places = np.asarray(vq.encode(CONFIG, variables, images)).reshape(-1, 3)
    codes = np.asarray(variables["params"]["codes"])
    distances = np.linalg.norm(codes[:, None] - places[None], axis=-1)
    assert (distances.min(axis=1) < 1e-5).all()
    assert len({*distances.argmin(axis=1)}) == 6


def test_a_place_takes_the_nearest_code():
    rng = np.random.default_rng(0)
    maps, codes = rng.normal(size=(4, 3, 5, 8)), rng.normal(size=(16, 8))
    found = vq.nearest({"params": {"codes": jnp.asarray(codes)}}, jnp.asarray(maps))
    expected = np.linalg.norm(maps[..., None, :] - codes, axis=-1).argmin(axis=-1)
    np.testing.assert_array_equal(found, expected)
    assert len(np.unique(expected)) > 8


def test_straight_through_has_the_codes_values_and_the_maps_gradient():
    maps, taken = jnp.array([0.3, -2.0]), jnp.array([0.5, -1.5])
    np.testing.assert_array_equal(vq.straight_through(maps, taken), taken)

    def f(x):
        return (x**3).sum()

    to_maps, to_codes = jax.grad(lambda m, t: f(vq.straight_through(m, t)), (0, 1))(maps, taken)
    np.testing.assert_allclose(to_maps, jax.grad(f)(taken), rtol=1e-6)
    np.testing.assert_array_equal(to_codes, 0.0)


def test_perplexity_is_the_number_of_codes_in_equal_use():
    assert vq.perplexity(jnp.array([[0, 3], [7, 3], [0, 7]]), 8) == pytest.approx(3.0)
    assert vq.perplexity(jnp.full((4, 2), 5, jnp.uint8), 8) == pytest.approx(1.0)
    uneven = vq.perplexity(jnp.array([0, 0, 0, 1]), 2)
    assert uneven == pytest.approx(np.exp(-(0.75 * np.log(0.75) + 0.25 * np.log(0.25))))


def test_what_is_no_map_of_codes_is_refused(images):
    with pytest.raises(ValueError, match=r"^size: expected multiples of 8 .*, got 20 × 24$"):
        vq.check_size((20, 24))
    with pytest.raises(ValueError, match=r"^places in images: expected an integer >= 64, got 30$"):
        vq.init(VQConfig(channels=(2, 2, 2)), KEY, images)
    for field, value in {"codes": 257, "dimension": 0, "channels": (2, 2), "dtype": "int8"}.items():
        with pytest.raises(ValueError, match=f"^{field}: expected"):
            VQConfig(**{field: value})
