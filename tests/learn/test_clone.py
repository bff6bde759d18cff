"""Behaviour cloning: what the network sees at each step, and that it learns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Demonstrations, Policy
from jaxdeconf.learn.fit import finish
from jaxdeconf.nets import network
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.views import identity

SIZE = (8, 12)
NETWORK = NetworkConfig(width=4, stem="imagenet", stages=1, norm="none")
CONFIG = CloneConfig(steps=60, batch_size=16, chunk=30, learning_rate=0.01, network=NETWORK)
LENGTHS = (3, 1, 5, 2, 4)  # of episodes


def demonstrations(lengths=LENGTHS):
    """Grey frames whose brightness is the action: one episode after another."""
    step = np.concatenate([np.arange(length) for length in lengths])
    actions = np.random.default_rng(0).uniform(-1, 1, (len(step), 1))
    grey = np.round((actions + 1) * 100 + 20).astype(np.uint8)[:, :, None, None]
    frames = np.broadcast_to(grey, (len(step), *SIZE, 3))
    return Demonstrations(jnp.asarray(frames), jnp.asarray(step), jnp.asarray(actions, float))


def stacks_by_loops(frames, lengths, count):
    """[n, H, W, 3 L]: each episode on its own, black before its first frame."""
    frames, begin, found = np.asarray(frames) / 255, 0, []
    for length in lengths:
        for t in range(length):
            past = [frames[begin + t - ago] if ago <= t else 0 * frames[0] for ago in range(count)]
            found.append(np.concatenate(past[::-1], axis=-1))
        begin += length
    return np.stack(found)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_the_network_sees_the_last_frames_of_its_episode_and_blank_ones_before(count):
    data = demonstrations()
    expected = stacks_by_loops(data.frames, LENGTHS, count)
    order = np.random.default_rng(1).permutation(len(expected))
    found = clone.stacked(CloneConfig(frames=count), data, jnp.asarray(order))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected[order], atol=1e-6)


def test_the_loss_is_of_what_the_network_makes_of_them(monkeypatch):
    data, indices = demonstrations(), jnp.array([14, 0, 5])

    def look(config, variables, images, train, gate):
        assert config == NETWORK
        assert train
        assert gate is None
        return images[:, 0, 0, :3].mean(axis=1, keepdims=True) * variables["scale"], 0, {"seen": 1}

    monkeypatch.setattr(network, "look", look)
    loss = clone.objective(CloneConfig(frames=3, network=NETWORK))
    value, (stats, metrics) = loss({"scale": 2.0}, data, indices, jax.random.key(0), jnp.int32(0))
    oldest = stacks_by_loops(data.frames, LENGTHS, 3)[np.asarray(indices)][:, 0, 0, :3].mean(axis=1)
    error = 2.0 * oldest[:, None] - np.asarray(data.actions)[np.asarray(indices)]
    np.testing.assert_allclose(value, np.mean(error**2), rtol=1e-5)
    assert (stats, metrics) == ({"seen": 1}, {})


def test_a_policy_learns_what_the_frame_shows():
    data, key, view = demonstrations((8,) * 6), jax.random.key(1), {"of": "the view"}
    training = clone.training(CONFIG, lambda: data, 48, identity, view, key)
    assert training.made_from == view
    *chunks, (state, metrics) = training.chunks("clone")
    assert len(chunks) == 20 - 1  # three steps an epoch
    assert metrics["loss"] < 0.1 * float(jnp.var(data.actions))
    policy = training.trained(state)
    assert isinstance(policy, Policy)
    assert (policy.network, policy.frames, policy.parameters) == (NETWORK, 2, view)
    np.testing.assert_array_equal(policy.see(data.frames), data.frames)
    acted = policy.act([data.frames[:7], data.frames[1:8]])
    expected, _ = network.apply(
        NETWORK, state.variables, clone.stacked(CONFIG, data, jnp.arange(1, 8)), train=False
    )
    np.testing.assert_allclose(acted, expected, atol=1e-6)


def test_policies_of_one_key_differ_in_what_they_are_shown_and_in_nothing_else():
    data, key = demonstrations(), jax.random.key(1)

    def training(key, view):
        return clone.training(CONFIG, lambda: data, 15, view, {}, key)

    first, second = training(key, identity), training(key, lambda _, images: images)
    other = training(jax.random.key(2), identity)
    assert first.key == second.key != other.key
    weights = [jax.tree.leaves(t.start(data).variables) for t in (first, second, other)]
    assert all((a == b).all() for a, b in zip(*weights[:2], strict=True))
    assert not all((a == b).all() for a, b in zip(*weights[1:], strict=True))


def test_the_number_of_frames_is_that_of_the_networks_channels():
    data = demonstrations()
    for count in (1, 3):
        config = CloneConfig(steps=1, batch_size=8, frames=count, network=NETWORK)
        training = clone.training(config, lambda: data, 15, identity, {}, jax.random.key(1))
        state = jax.eval_shape(training.start, data)
        assert state.variables["params"]["stem"]["kernel"].shape == (7, 7, 3 * count, 4)
        assert training.trained(state).frames == count


def test_a_loss_of_ones_own_is_what_is_trained():
    data = demonstrations()

    def of_the_bias(config):
        def loss(variables, data, indices, key, step):
            bias = variables["params"]["head"]["bias"]
            return jnp.mean((bias - data.actions[indices]) ** 2), ({}, {})

        return loss

    config = CloneConfig(steps=2, batch_size=8, network=NETWORK)
    key = jax.random.key(1)
    training = clone.training(config, lambda: data, 15, identity, {}, key, of_the_bias)
    before = training.start(data).variables["params"]
    after = finish("clone", training).variables["params"]
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), before, after)
    assert moved["head"].pop("bias")
    assert not any(jax.tree.leaves(moved))


def test_a_policy_is_a_pytree_of_its_weights():
    policy = Policy(identity, NETWORK, 2, {"keep": jnp.ones(3)}, {"params": jnp.zeros(2)})
    traces = []

    @jax.jit
    def sums(policy):
        traces.append(policy.frames)
        return policy.parameters["keep"].sum() + policy.variables["params"].sum()

    assert [leaf.shape for leaf in jax.tree.leaves(policy)] == [(3,), (2,)]
    assert sums(policy) == 3
    assert sums(jax.tree.map(lambda leaf: leaf + 1, policy)) == 8
    assert traces == [2]


def test_errors_count_squared_up_to_the_huber_threshold_and_linearly_beyond():
    predicted, actions = jnp.array([[0.05], [1.0]]), jnp.zeros((2, 1))
    squared = clone.action_error(CloneConfig(), predicted, actions)
    assert squared == pytest.approx((0.05**2 + 1.0) / 2)
    bounded = clone.action_error(CloneConfig(huber=0.1), predicted, actions)
    assert bounded == pytest.approx((0.05**2 + 0.1 * (2 * 1.0 - 0.1)) / 2)
    gradient = jax.grad(lambda p: clone.action_error(CloneConfig(huber=0.1), p, actions))(predicted)
    np.testing.assert_allclose(gradient[:, 0], [0.05, 0.1], rtol=1e-5)
