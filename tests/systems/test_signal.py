"""What the nuisance shows. Reference: actions moved by a step, and a NumPy loop."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.collect import CollectConfig
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.pipeline.config import Config, fitting
from jaxdeconf.systems.rollout import frames, random_trajectories
from jaxdeconf.systems.signal import SIGNALS

KEY = jax.random.key(3)
CARTPOLE = replace(systems.get("cartpole"), size=(16, 16))


def trajectories(name, count=200):
    """Random ones that fall, of a system with that signal."""
    system = replace(CARTPOLE, signal=SIGNALS[name])
    return jax.tree.map(np.asarray, random_trajectories(system, KEY, count))


@pytest.fixture(scope="module")
def before():
    return trajectories("previous_action")


@pytest.mark.parametrize("name", SIGNALS)
def test_what_moves_is_the_same_whatever_is_shown(name, before):
    found = trajectories(name)
    for field in ("states", "actions", "previous_actions", "valid"):
        np.testing.assert_array_equal(getattr(found, field), getattr(before, field))
    np.testing.assert_array_equal(found.previous_actions[:, 1:], found.actions[:, :-1])


def test_by_default_the_frames_are_those_of_the_previous_actions(before):
    np.testing.assert_array_equal(before.signals, before.previous_actions)
    some = jax.tree.map(lambda a: a[:3, :4], before)
    by_hand = jax.vmap(jax.vmap(CARTPOLE.frame))(some.states, some.previous_actions)
    np.testing.assert_array_equal(frames(CARTPOLE, some), by_hand)
    other = some._replace(previous_actions=-some.previous_actions)
    np.testing.assert_array_equal(frames(CARTPOLE, other), by_hand)  # it is the signals' alone
    other = some._replace(signals=-some.signals)
    assert (np.asarray(frames(CARTPOLE, other)) != by_hand).any()


def test_two_steps_ago_is_the_actions_moved_by_two():
    _, actions, previous, valid, signals = trajectories("two_steps_ago")
    within = valid[:, 2:]
    np.testing.assert_array_equal(signals[:, 2:][within], actions[:, :-2][within])
    np.testing.assert_array_equal(signals[:, 1], previous[:, 0])


def test_what_it_shows_first_is_random_and_independent():
    _, actions, previous, _, signals = trajectories("two_steps_ago", 2000)
    first = np.sort(signals[:, 0, 0]) / 50 + 0.5
    assert np.abs(first - np.arange(1, 2001) / 2000).max() < 1.63 / np.sqrt(2000)
    columns = np.column_stack([signals[:, 0], previous[:, 0], actions[:, 0]])
    assert np.abs(np.corrcoef(columns.T) - np.eye(3)).max() < 0.08


def test_filtered_is_a_loop():
    _, actions, previous, valid, signals = trajectories("filtered")
    np.testing.assert_array_equal(signals[:, 0], previous[:, 0])
    assert np.abs(signals).max() <= 25.0
    for n, length in enumerate(valid.sum(axis=1)):
        shown = signals[n, 0]
        for t in range(1, length):
            shown = 0.7 * shown + 0.3 * actions[n, t - 1]
            np.testing.assert_allclose(signals[n, t], shown, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", SIGNALS)
def test_it_stands_still_out_of_bounds(name):
    *_, valid, signals = trajectories(name)
    lengths = valid.sum(axis=1)
    assert lengths.max() < 100
    for n, length in enumerate(lengths):
        assert (signals[n, length:] == signals[n, length]).all()


@pytest.mark.parametrize("name", SIGNALS)
def test_two_actions_have_a_signal_of_two(name):
    system = replace(systems.get("reacher"), signal=SIGNALS[name], steps=6)
    found = random_trajectories(system, KEY, 3)
    assert found.signals.shape == found.actions.shape == (3, 6, 2)


def test_a_config_says_what_is_shown():
    mine = replace(CARTPOLE, signal=replace(SIGNALS["filtered"], name="mine"))
    for name, system, wanted in (
        ("previous_action", CARTPOLE, SIGNALS["previous_action"]),
        ("two_steps_ago", CARTPOLE, SIGNALS["two_steps_ago"]),
        ("previous_action", mine, mine.signal),
    ):
        collect = CollectConfig(nuisance=name, size=(64, 64))
        config = Config(collect=collect, clone=CloneConfig(steps=1))
        assert fitting(config, system).signal == wanted
    with pytest.raises(ValueError, match=r"^nuisance: expected one of previous_action, two_steps"):
        CollectConfig(nuisance="next_action")


def test_a_signal_of_ones_own_is_a_memory_and_a_rule():
    """Reference: the largest action so far."""
    largest = replace(SIGNALS["filtered"], name="largest", follow=jnp.maximum)
    found = random_trajectories(replace(CARTPOLE, signal=largest), KEY, 20)
    wanted = np.maximum.accumulate(np.asarray(found.previous_actions), axis=1)
    np.testing.assert_array_equal(found.signals[found.valid], wanted[np.asarray(found.valid)])
