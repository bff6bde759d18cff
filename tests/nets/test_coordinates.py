"""The decoder by place: patches, places, and that a part of an image is drawn as the whole is."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxdeconf.nets import coordinates, vae
from jaxdeconf.nets.vae import VAEConfig

CONFIG = VAEConfig(channels=(4, 4), latents=3, decoder="coordinates", width=8)
SIZE = (16, 24)


def test_patches_come_back_as_the_image():
    images = jax.random.uniform(jax.random.key(0), (3, *SIZE, 3))
    patches = coordinates.to_patches(images)
    assert patches.shape == (3, coordinates.patch_count(SIZE), 12) == (3, 96, 12)
    np.testing.assert_array_equal(patches[1, 13], images[1, 2:4, 2:4].ravel())
    np.testing.assert_array_equal(coordinates.from_patches(patches, SIZE), images)


def test_places_are_the_patches_centres():
    places = coordinates.places(SIZE)
    assert places.shape == (96, 3)
    np.testing.assert_allclose(places[0], [-5.5, -3.5, 1])
    np.testing.assert_allclose(places[13], [-4.5, -2.5, 1])
    np.testing.assert_allclose(places[11], [5.5, -3.5, 1])


@pytest.mark.parametrize("linear_path", [False, True])
def test_some_patches_are_those_of_the_whole_image(linear_path):
    config = replace(CONFIG, linear_path=linear_path)
    variables = vae.init(config, jax.random.key(0), SIZE)
    keys = iter(jax.random.split(jax.random.key(1), 100))
    params = jax.tree.map(
        lambda a: 0.3 * jax.random.normal(next(keys), a.shape), variables["params"]
    )
    variables = {**variables, "params": params}
    latents = jax.random.normal(jax.random.key(2), (5, 3))
    image, batch_stats = vae.decode(config, variables, latents, SIZE, train=False)
    assert image.shape == (5, *SIZE, 3)
    assert batch_stats["decoder"] == {}
    chosen = jnp.array([95, 0, 17])
    some = vae.decode_patches(config, variables, latents, SIZE, chosen)
    np.testing.assert_allclose(some, coordinates.to_patches(image)[:, chosen], rtol=1e-4, atol=1e-4)
    assert jnp.std(image, axis=0).mean() > 0.01  # they depend on the latents


def test_beside_a_linear_path_it_starts_silent():
    config = replace(CONFIG, linear_path=True)
    variables = vae.init(config, jax.random.key(0), SIZE)
    image, _ = vae.decode(config, variables, jnp.ones((2, 3)), SIZE, train=True)
    np.testing.assert_array_equal(image, 0.0)


def test_it_learns_to_draw_a_disc_where_two_numbers_say():
    """A moving shape, from its position: what it is for."""
    config = VAEConfig(channels=(4, 4), latents=2, decoder="coordinates", width=32)
    size = (16, 16)
    parameters = vae.init(config, jax.random.key(0), size)
    positions = jax.random.uniform(jax.random.key(1), (256, 2), minval=-1)
    y, x = jnp.mgrid[:16, :16] + 0.5
    middle = 8 + 5 * positions
    inside = (x - middle[:, 0, None, None]) ** 2 + (y - middle[:, 1, None, None]) ** 2 < 9
    images = jnp.where(inside[..., None], 0.1, 0.9) * jnp.ones(3)

    def loss(params):
        drawn = vae.decode(config, {**parameters, "params": params}, positions, size, train=True)[0]
        return jnp.mean((drawn - images) ** 2)

    adam = optax.adam(3e-3)

    def step(carry, _):
        params, moments = carry
        value, gradient = jax.value_and_grad(loss)(params)
        updates, moments = adam.update(gradient, moments)
        return (optax.apply_updates(params, updates), moments), value

    params = parameters["params"]
    _, losses = jax.jit(lambda c: jax.lax.scan(step, c, length=200))((params, adam.init(params)))
    assert losses[-1] < 0.3 * jnp.var(images)
