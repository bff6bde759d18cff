"""Behaviour cloning: what the network sees at each step, and that it learns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Demonstrations
from jaxdeconf.nets import resnet
from jaxdeconf.nets.resnet import ResNetConfig

CONFIG = CloneConfig(
    epochs=30, batch_size=16, chunk=30, network=ResNetConfig(width=4, stem="imagenet")
)


def demonstrations(trajectories=6, length=8):
    """Grey frames whose brightness is the action: one trajectory after another."""
    actions = jax.random.uniform(jax.random.key(0), (trajectories * length, 1), minval=-1)
    grey = ((actions + 1) * 100).astype(jnp.uint8)[:, :, None, None]
    frames = jnp.broadcast_to(grey, (len(actions), 64, 64, 3))
    return Demonstrations(frames, jnp.arange(len(actions)) % length == 0, actions)


def test_the_network_sees_the_last_frame_and_a_blank_one_first(monkeypatch):
    data, seen = demonstrations(), {}

    def apply(config, variables, images, train):
        seen["images"] = images
        return jnp.zeros((len(images), 1)), {}

    monkeypatch.setattr(resnet, "apply", apply)
    indices = jnp.array([0, 1, 8, 15])
    loss = clone.objective(CONFIG)
    value, _ = loss({}, data, indices, jax.random.key(0), jnp.int32(0))
    frames = np.asarray(data.frames, np.float32) / 255
    np.testing.assert_allclose(seen["images"][..., 3:], frames[np.asarray(indices)], atol=1e-6)
    np.testing.assert_allclose(seen["images"][1, ..., :3], frames[0], atol=1e-6)
    np.testing.assert_allclose(seen["images"][3, ..., :3], frames[14], atol=1e-6)
    assert (seen["images"][0, ..., :3] == 0).all()
    assert (seen["images"][2, ..., :3] == 0).all()
    np.testing.assert_allclose(value, np.mean(np.asarray(data.actions[indices]) ** 2), rtol=1e-5)


def test_it_learns_what_the_frame_shows():
    data = demonstrations()
    state = clone.initial_state(CONFIG, (64, 64, 3), 1, jax.random.key(1))
    *_, (state, metrics) = clone.clone(CONFIG, state, data, jax.random.key(2), stops=(45, 90))
    assert metrics["loss"] < 0.1 * jnp.var(data.actions)
    acted = clone.act(CONFIG.network, state.variables, data.frames[1:4], data.frames[2:5])
    assert acted.shape == (3, 1)


def test_errors_count_squared_up_to_the_huber_threshold_and_linearly_beyond():
    predicted, actions = jnp.array([[0.05], [1.0]]), jnp.zeros((2, 1))
    squared = clone.action_error(CloneConfig(), predicted, actions)
    assert squared == pytest.approx((0.05**2 + 1.0) / 2)
    bounded = clone.action_error(CloneConfig(huber=0.1), predicted, actions)
    assert bounded == pytest.approx((0.05**2 + 0.1 * (2 * 1.0 - 0.1)) / 2)
    gradient = jax.grad(lambda p: clone.action_error(CloneConfig(huber=0.1), p, actions))(predicted)
    np.testing.assert_allclose(gradient[:, 0], [0.05, 0.1], rtol=1e-5)


@pytest.mark.parametrize(("field", "value"), [("trajectory_steps", 0), ("huber", -0.1)])
def test_a_bad_config_names_the_field_and_the_value(field, value):
    with pytest.raises(ValueError, match=rf"{field}: expected .*{value}"):
        CloneConfig(**{field: value})
