"""Rollouts: the scan against a Python loop, what happens out of bounds, and keys."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.systems.rollout import (
    Trajectories,
    frames,
    random_trajectories,
    redrawn,
    rollout,
    rollout_with_memory,
    sample_action,
)

SYSTEM = systems.get("cartpole")
KEY = jax.random.key(3)


def noisy_policy(memory, state, signal, key):
    """Uses everything a policy is given; asks for more than the limits now and then."""
    action = 20 * state[2:3] - 0.1 * signal + 10 * jax.random.normal(key, (1,)) + memory
    return memory + 0.1, action


def by_hand(policy, memory, state, key):
    """`rollout` as a Python loop."""
    first_key, policy_key = jax.random.split(key)
    previous, alive, records = sample_action(SYSTEM, first_key), True, []
    for step_key in jax.random.split(policy_key, SYSTEM.steps):
        alive = alive and bool(SYSTEM.in_bounds(state))
        memory, action = policy(memory, state, previous, step_key)
        action = jnp.clip(action, -25, 25) if alive else previous
        records.append((state, action, previous, alive, previous))
        state = SYSTEM.step(state, action) if alive else state
        previous = action
    return Trajectories(*(np.array(field) for field in zip(*records, strict=True))), memory


def test_scan_matches_python_loop():
    state = jnp.array([1.0, -1.0, 0.2, 0.1])
    expected, memory = by_hand(noisy_policy, jnp.array(0.0), state, KEY)
    assert 10 < expected.valid.sum() < 100  # it falls on the way, so both branches are seen
    assert (np.abs(expected.actions) == 25).any()
    trajectory, final = rollout_with_memory(SYSTEM, noisy_policy, jnp.array(0.0), state, KEY)
    np.testing.assert_array_equal(trajectory.valid, expected.valid)
    for got, want in zip(trajectory[:3], expected[:3], strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=2e-3)
    np.testing.assert_allclose(final, memory, rtol=1e-6)


def test_trajectory_stands_still_out_of_bounds():
    trajectories = random_trajectories(SYSTEM, KEY, 50)
    inside = np.asarray(jax.vmap(jax.vmap(SYSTEM.in_bounds))(trajectories.states))
    states, actions, _, valid, _ = map(np.asarray, trajectories)
    assert not valid[:, -1].any()  # random forces hold no pole for five seconds
    np.testing.assert_array_equal(valid, inside)
    for n, length in enumerate(valid.sum(axis=1)):
        assert valid[n, :length].all()
        assert (states[n, length:] == states[n, length]).all()
        assert (actions[n, length:] == actions[n, length - 1]).all()


def test_states_and_actions_follow_the_system():
    states, actions, previous, valid, _ = random_trajectories(SYSTEM, KEY, 20)
    stepped = jax.vmap(jax.vmap(SYSTEM.step))(states, actions)[:, :-1]
    alive = np.asarray(valid[:, :-1])
    np.testing.assert_allclose(stepped[alive], states[:, 1:][alive], rtol=0, atol=1e-5)
    np.testing.assert_array_equal(previous[:, 1:], actions[:, :-1])


def test_random_actions_are_uniform_and_independent_of_the_start():
    states, actions, previous, *_ = random_trajectories(SYSTEM, KEY, 2000)
    for sample in (actions[:, 0, 0], previous[:, 0, 0]):
        unit = np.sort(np.asarray(sample)) / 50 + 0.5
        assert unit[0] >= 0
        assert unit[-1] <= 1
        assert np.abs(unit - np.arange(1, 2001) / 2000).max() < 1.63 / np.sqrt(2000)
    columns = np.column_stack([states[:, 0], previous[:, 0], actions[:, 0]])
    assert np.abs(np.corrcoef(columns.T) - np.eye(6)).max() < 0.08


def test_keys():
    first, same = (random_trajectories(SYSTEM, KEY, 4) for _ in range(2))
    other = random_trajectories(SYSTEM, jax.random.key(4), 4)
    for a, b, c in zip(first[:3], same[:3], other[:3], strict=True):
        np.testing.assert_array_equal(a, b)
        assert not np.isin(a[:, 0], c[:, 0]).any()


def test_vmap_matches_loop():
    keys = jax.random.split(KEY, 3)
    states = jax.vmap(SYSTEM.sample_initial)(keys)

    def one(state, key):
        return rollout(SYSTEM, noisy_policy, jnp.array(0.0), state, key)

    together = jax.vmap(one)(states, keys)
    for n in range(3):
        for whole, single in zip(together, one(states[n], keys[n]), strict=True):
            np.testing.assert_allclose(whole[n], single, rtol=0, atol=1e-3)


def test_random_trajectories_compile_once():
    traced = []

    def step(state, action):
        traced.append(1)
        return SYSTEM.step(state, action)

    counted = dataclasses.replace(SYSTEM, step=step)
    random_trajectories(counted, KEY, 4)
    once = len(traced)
    random_trajectories(counted, jax.random.key(9), 4)
    assert len(traced) == once > 0


def test_frames_are_the_renders():
    trajectories = random_trajectories(SYSTEM, KEY, 2)
    some = jax.tree.map(lambda leaf: leaf[:, :3], trajectories)
    images = jax.jit(frames, static_argnums=0)(SYSTEM, some)
    assert images.shape == (2, 3, 64, 64, 3)
    assert images.dtype == jnp.uint8
    image = jax.jit(SYSTEM.render)(some.states[1, 2], some.signals[1, 2])
    assert np.abs(np.asarray(images[1, 2]) - 255 * np.asarray(image)).max() <= 0.51


def test_copies_and_filters_of_past_actions_are_redrawn_alone():
    before = random_trajectories(SYSTEM, KEY, 300)
    after = redrawn(SYSTEM, before, jax.random.key(5))
    for a, b in zip(before[:4], after[:4], strict=True):
        np.testing.assert_array_equal(a, b)
    shown = np.asarray(after.signals[..., 0]) / 25
    assert np.abs(shown).max() <= 1
    assert shown.std() == pytest.approx(1 / np.sqrt(3), rel=0.02)
    assert abs(np.corrcoef(shown.ravel(), np.asarray(before.signals).ravel())[0, 1]) < 0.03
    assert abs(np.corrcoef(shown[:, 1:].ravel(), shown[:, :-1].ravel())[0, 1]) < 0.03
