"""Keyframes: the steps whose action the one before does not tell, and none that does not count."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf.demos import Demos
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.method import Ask, Evidence
from jaxdeconf.rivals.keyframes import keyframes, weighted

KEY = jax.random.key(0)
N, T = 50, 9


def told():
    """Previous actions, actions that mostly follow from them, and where they do not: [N, T]."""
    rng = np.random.default_rng(0)
    previous = rng.uniform(-1, 1, (N, T, 2))
    actions = np.stack([np.sin(2 * previous[..., 0]), previous.prod(axis=-1)], axis=-1)
    sudden = rng.uniform(size=(N, T)) < 0.08
    actions[sudden] += rng.choice([-1.0, 1.0], (sudden.sum(), 2))
    return previous, actions, sudden


def test_they_are_the_tenth_that_is_told_least_of():
    previous, actions, sudden = told()
    found = np.asarray(keyframes(previous, actions, np.ones((N, T), bool), KEY))
    assert found.sum() == 0.1 * N * T
    assert found[sudden].all()


def test_what_does_not_count_is_none_and_changes_nothing():
    previous, actions, sudden = told()
    counts = np.random.default_rng(1).uniform(size=(N, T)) < 0.7
    garbage = np.where(counts[..., None], actions, np.nan)
    found = np.asarray(keyframes(np.where(counts[..., None], previous, 9e9), garbage, counts, KEY))
    assert not found[~counts].any()
    assert found[sudden & counts].all()
    assert found.sum() == np.ceil(0.1 * counts.sum())
    assert not keyframes(previous, actions, np.zeros((N, T), bool), KEY).any()


def demos(**fields):
    previous, actions, _ = told()
    images, states = np.zeros((N, T, 4, 4, 3), np.uint8), np.zeros((N, 1))
    return Demos(images, actions, states, **{"previous_actions": previous, **fields})


def test_first_steps_padding_and_steps_not_cloned_weigh_1():
    lengths = np.random.default_rng(2).integers(1, T + 1, N)
    valid = np.arange(T) < lengths[:, None]
    config = CloneConfig(trajectory_steps=7, strength=5.0)
    given = demos(valid=valid)
    found = weighted(given, Evidence(), Ask(config, KEY))
    weights = np.asarray(found.weights)
    step = np.broadcast_to(np.arange(T), (N, T))
    counts = valid & (step > 0) & (step < 7)
    assert (weights[~counts] == 1).all()
    assert sorted(np.unique(weights)) == [1, 5]
    assert (weights == 5).sum() == np.ceil(0.1 * counts.sum())
    assert found.actions is given.actions
    doubled = weighted(replace(given, weights=np.full((N, T), 2.0)), Evidence(), Ask(config, KEY))
    np.testing.assert_array_equal(doubled.weights, 2 * weights)


def test_it_can_be_traced_for_its_shapes():
    config = CloneConfig(strength=5.0)
    found = jax.eval_shape(lambda: weighted(demos(), Evidence(), Ask(config, KEY)).weights)
    assert (found.shape, found.dtype) == ((N, T), jnp.float32)
