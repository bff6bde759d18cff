"""The network of places: centroids, motion, background, and what it does with a blank frame."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.nets import network
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.nets.places import background, places

CONFIG = NetworkConfig(kind="places", width=4, hidden=(8,))
KEY = jax.random.key(0)
init = jax.jit(network.init, static_argnums=(0, 2, 3))
look = jax.jit(network.look, static_argnums=(0, 3, 4))


def frames(count, batch=5, size=(32, 48)):
    return jax.random.uniform(jax.random.key(1), (batch, *size, 3 * count))


def test_places_are_centroids_in_float64():
    maps = np.random.default_rng(0).uniform(0, 2, (3, 5, 9, 4)).astype(np.float32)
    rows, columns = np.linspace(-1, 1, 5), np.linspace(-1, 1, 9)
    amount = maps.astype(float).sum((1, 2))
    across = (maps * columns[:, None]).sum((1, 2), dtype=float) / (amount + 1)
    down = (maps * rows[:, None, None]).sum((1, 2), dtype=float) / (amount + 1)
    expected = np.concatenate([across, down, 10 * amount / 45], axis=1)
    np.testing.assert_allclose(places(jnp.asarray(maps)), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(places(jnp.zeros((1, 5, 9, 4))), 0.0)


@pytest.mark.parametrize("count", [1, 4, 7])
def test_the_background_is_the_upper_median(count):
    shown = np.random.default_rng(count).integers(0, 256, (count, 6, 4, 3), np.uint8)
    expected = np.sort(shown, axis=0)[count // 2] / np.float32(255)
    np.testing.assert_allclose(background(jnp.asarray(shown)), expected, rtol=1e-6)


def test_the_background_is_not_seen():
    shown = jnp.asarray(np.random.default_rng(0).integers(1, 256, (1, 32, 48, 3), np.uint8))
    variables = network.with_background(init(CONFIG, KEY, (32, 48, 6), 2), shown)
    still = jnp.concatenate([shown, shown], axis=-1) / 255.0
    nothing = network.with_background(variables, jnp.zeros_like(shown))
    _, features, _ = look(CONFIG, variables, still, True, None)
    _, of_nothing, _ = look(CONFIG, nothing, jnp.zeros_like(still), True, None)
    np.testing.assert_allclose(features, of_nothing, atol=1e-6)


def test_training_leaves_the_background_alone():
    shown = jnp.full((3, 32, 48, 3), 7, jnp.uint8)
    variables = network.with_background(init(CONFIG, KEY, (32, 48, 6), 2), shown)
    _, _, stats = look(CONFIG, variables, frames(2), True, None)
    np.testing.assert_array_equal(stats["background"], variables["batch_stats"]["background"])
    np.testing.assert_allclose(stats["background"], 7 / 255, rtol=1e-6)


def test_motion_counts_as_often_as_the_config_says():
    # With the first layer behind the places cut to the present ones, motion does not matter; with
    # it cut to the changes, twice the motion is as good as twice the weights.
    variables = init(CONFIG, KEY, (32, 48, 6), 2)
    kernel = variables["params"]["hidden_1"]["kernel"]
    assert kernel.shape == (24, 8)  # three numbers a channel: now, and since the frame before

    def features(motion, weights):
        config = NetworkConfig(kind="places", width=4, hidden=(8,), motion=motion)
        params = {**variables["params"], "hidden_1": {"kernel": weights, "bias": jnp.zeros(8)}}
        return look(config, {**variables, "params": params}, frames(2), True, None)[1]

    now, changes = kernel.at[12:].set(0.0), kernel.at[:12].set(0.0)
    np.testing.assert_array_equal(features(1.0, now), features(10.0, now))
    assert jnp.abs(features(1.0, now)).max() > 0
    np.testing.assert_allclose(features(4.0, changes), features(2.0, 2 * changes), rtol=1e-5)
    assert jnp.abs(features(1.0, changes)).max() > 0


def test_after_a_blank_frame_nothing_has_moved():
    variables = init(CONFIG, KEY, (32, 48, 6), 2)
    present = frames(1)
    stood = jnp.concatenate([present, present], axis=-1)
    began = jnp.concatenate([jnp.zeros_like(present), present], axis=-1)
    moved = jnp.concatenate([present[::-1], present], axis=-1)
    at_rest = look(CONFIG, variables, stood, True, None)[0]
    np.testing.assert_array_equal(look(CONFIG, variables, began, True, None)[0], at_rest)
    assert jnp.abs(look(CONFIG, variables, moved, True, None)[0] - at_rest).max() > 1e-3


@pytest.mark.parametrize("count", [1, 3])
def test_every_layer_learns_from_any_number_of_frames(count):
    variables = init(CONFIG, KEY, (32, 48, 3 * count), 2)

    def loss(params):
        shown = {**variables, "params": params}
        return jnp.sum(network.apply(CONFIG, shown, frames(count), True)[0] ** 2)

    for leaf in jax.tree.leaves(jax.jit(jax.grad(loss))(variables["params"])):
        assert jnp.abs(leaf).max() > 0


def test_a_gate_sees_all_frames_of_a_sample_as_one_map():
    variables = init(CONFIG, KEY, (32, 48, 6), 2)
    earlier, present = frames(1), frames(1)[::-1]
    shapes = []

    def all_of_the_first(x):
        shapes.append(x.shape)
        return x.at[..., 4:].set(x[..., :4])

    both = jnp.concatenate([earlier, present], axis=-1)
    gated = look(CONFIG, variables, both, True, all_of_the_first)[0]
    alone = look(CONFIG, variables, jnp.concatenate([earlier] * 2, axis=-1), True, None)[0]
    assert shapes == [(5, 16, 24, 8)]
    np.testing.assert_allclose(gated, alone, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_vmap_over_models_equals_a_loop():
    keys = jax.random.split(KEY, 2)
    many = jax.vmap(lambda key: network.init(CONFIG, key, (32, 48, 6), 2))(keys)
    outputs = jax.jit(lambda variables: network.apply(CONFIG, variables, frames(2), True)[0])
    together = jax.vmap(outputs)(many)
    for m in range(2):
        one = outputs(jax.tree.map(lambda leaf, m=m: leaf[m], many))
        np.testing.assert_allclose(together[m], one, rtol=1e-4, atol=1e-6)
