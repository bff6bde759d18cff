"""A simulator's data against a loop over frames of single states."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import collect, systems
from jaxdeconf.collect import CollectConfig
from jaxdeconf.expert import ExpertConfig
from jaxdeconf.systems import Trajectories, random_trajectories
from jaxdeconf.systems.signal import SIGNALS

CARTPOLE = replace(systems.get("cartpole"), steps=5, size=(12, 16))
# What its nuisance shows is not the previous action, so that the two are told apart.
SYSTEM = replace(CARTPOLE, signal=SIGNALS["two_steps_ago"])
EXPERT = ExpertConfig(horizon=7)
CONFIG = CollectConfig(
    random_trajectories=3, expert_trajectories=6, held_out_trajectories=2, random_steps=4
)
LENGTHS = np.array([5, 1, 3, 4])
RAGGED = np.arange(5) < LENGTHS[:, None]


@pytest.fixture(scope="module")
def trajectories():
    """Of which all but the first end early."""
    return random_trajectories(SYSTEM, jax.random.key(0), 4)._replace(valid=RAGGED)


def frame(trajectories, n, t):
    """Of one state."""
    return SYSTEM.frame(trajectories.states[n, t], trajectories.signals[n, t])


def test_exploration_is_the_frames_of_the_valid_steps(trajectories):
    found = collect.exploration(SYSTEM, trajectories)
    places = [(n, t) for n in range(4) for t in range(LENGTHS[n])]
    assert found.images.dtype == np.uint8
    # A frame drawn alone may round half a grey level the other way.
    images = np.stack([frame(trajectories, *place) for place in places]).astype(int)
    np.testing.assert_allclose(np.asarray(found.images, int), images, atol=1)
    previous = [trajectories.previous_actions[place] / 25.0 for place in places]
    np.testing.assert_allclose(found.previous_actions, previous, rtol=1e-6)
    shown = [trajectories.signals[place] / 25.0 for place in places]
    np.testing.assert_allclose(found.signals, shown, rtol=1e-6)


@pytest.mark.parametrize("steps", [None, 2])
def test_demonstrations_are_the_frames_of_the_first_steps(trajectories, steps):
    demos, length = collect.demonstrations(SYSTEM, trajectories, steps), steps or 5
    assert demos.images.shape == (4, length, 12, 16, 3)
    for n, t in np.ndindex(4, length):
        image = np.asarray(frame(trajectories, n, t), int)
        np.testing.assert_allclose(np.asarray(demos.images[n, t], int), image, atol=1)
        action = trajectories.actions[n, t] / 25.0
        np.testing.assert_allclose(demos.actions[n, t], action, rtol=1e-6)
        previous = trajectories.previous_actions[n, t] / 25.0
        np.testing.assert_allclose(demos.previous_actions[n, t], previous, rtol=1e-6)
    np.testing.assert_array_equal(demos.initial_states, trajectories.states[:, 0])
    np.testing.assert_array_equal(demos.valid, RAGGED[:, :steps])
    np.testing.assert_array_equal(demos.lengths, np.minimum(LENGTHS, length))
    assert demos.state_names == SYSTEM.state_names
    assert demos.action_names == SYSTEM.action_names


def test_demonstrations_of_whole_episodes_say_so_by_no_valid(trajectories):
    assert collect.demonstrations(SYSTEM, trajectories, 1).valid is None


def idle(system, states, key, config):
    """In the place of the expert, which takes seconds to compile: nothing is done."""
    assert config is EXPERT
    still = jnp.zeros((len(states), system.steps, 1))
    where = jnp.repeat(states[:, None], system.steps, axis=1)
    seen = jax.random.uniform(key, still.shape)
    return Trajectories(where, still, seen, still[..., 0] == 0, seen), jnp.arange(len(states))


def test_collecting_keeps_its_sets_apart_and_follows_from_the_key(monkeypatch):
    monkeypatch.setattr(collect, "expert_trajectories", idle)
    key = jax.random.key(1)
    found = collect.collect(SYSTEM, CONFIG, EXPERT, 2, key)
    sizes = {name: getattr(found, name).valid.shape for name in found._fields[:4]}
    assert sizes == {"random": (3, 4), "held_out": (2, 4), "expert": (6, 5), "evaluation": (2, 5)}
    np.testing.assert_array_equal(found.unconverged, np.arange(6))
    starts = np.concatenate([getattr(found, name).states[:, 0] for name in sizes])
    assert len(np.unique(starts, axis=0)) == 3 + 2 + 6 + 2
    again = collect.collect(SYSTEM, CONFIG, EXPERT, 2, key)
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), found, again))
    other = collect.collect(SYSTEM, CONFIG, EXPERT, 2, jax.random.key(2))
    assert (other.random.states != found.random.states).all()
    assert (other.expert.states != found.expert.states).all()
    assert (other.expert.previous_actions != found.expert.previous_actions).all()
