"""What the owner of a system can do, against Python loops over single steps and frames."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import evaluate
from jaxdeconf.expert import ExpertConfig, relabel
from jaxdeconf.learn.clone import Policy
from jaxdeconf.nets import network
from jaxdeconf.systems.rollout import frames, random_trajectories
from jaxdeconf.views import identity
from tests.rivals import world
from tests.rivals.world import CLONE, COUNT, EXPERT, KEY, SIZE, STEPS, SYSTEM

LIMIT = 25.0


@pytest.fixture(scope="module")
def simulator():
    return world.simulator()


@pytest.fixture(scope="module")
def demos(simulator):
    return world.demos(simulator)


@pytest.fixture(scope="module")
def shaken(simulator):
    return simulator.shaken(0.3, KEY, STEPS)


def test_where_another_led_the_expert_thinks_longer(simulator):
    assert simulator.attentive == replace(EXPERT, step_iterations=5, restart=True)
    longer = replace(simulator, expert=ExpertConfig(step_iterations=7))
    assert longer.attentive.step_iterations == 7
    states = simulator.trajectories.states
    wanted = relabel(SYSTEM, states, simulator.attentive) / LIMIT
    np.testing.assert_array_equal(simulator.label(states), wanted)


def test_an_expert_that_is_not_shaken_does_what_it_did(simulator, demos):
    still = simulator.shaken(0.0, KEY, STEPS, slice(2, 5))
    np.testing.assert_array_equal(still.initial_states, demos.initial_states[2:5])
    np.testing.assert_allclose(still.actions, demos.actions[2:5], atol=0.02)
    np.testing.assert_allclose(still.previous_actions[:, 1:], still.actions[:, :-1], atol=1e-4)
    assert (still.weights == 1).all()


def test_what_is_executed_is_what_was_intended_and_noise(shaken):
    noise = np.asarray(shaken.previous_actions[:, 1:] - shaken.actions[:, :-1])
    free = np.abs(shaken.previous_actions[:, 1:]) < 1
    assert 20 < free.sum() < free.size  # some were clipped
    assert np.abs(shaken.previous_actions).max() <= 1
    assert noise[free].std() == pytest.approx(0.3, rel=0.25)
    assert np.abs(noise[free].mean()) < 4 * 0.3 / np.sqrt(free.sum())


def test_the_executed_action_moves_the_system_and_is_shown(shaken):
    """Reference: the system, a step at a time; labels are the expert's in these states."""
    states = np.zeros((COUNT, STEPS, 4), np.float32)
    states[:, 0] = shaken.initial_states
    for n in range(COUNT):
        for t in range(1, STEPS):
            states[n, t] = SYSTEM.step(states[n, t - 1], LIMIT * shaken.previous_actions[n, t])
    for n, t in [(0, 0), (1, 3), (7, 5)]:
        image = SYSTEM.frame(jnp.asarray(states[n, t]), LIMIT * shaken.previous_actions[n, t])
        difference = np.asarray(shaken.images[n, t], int) - np.asarray(image, int)
        assert np.abs(difference).max() <= 1
    within = np.asarray(shaken.weights) > 0
    attentive = replace(EXPERT, step_iterations=5, restart=True)
    wanted = np.asarray(relabel(SYSTEM, states, attentive)) / LIMIT
    np.testing.assert_allclose(np.asarray(shaken.actions)[within], wanted[within], atol=5e-3)


def test_another_key_is_another_noise(simulator, shaken):
    other = simulator.shaken(0.3, jax.random.key(9), STEPS)
    free = np.abs(np.asarray(shaken.previous_actions)) < 1
    assert (other.previous_actions != shaken.previous_actions)[free].all()


def test_a_policy_drives_from_the_starts_of_some_demonstrations(simulator, demos):
    variables = network.init(CLONE.network, KEY, (*SIZE, 6), 1)
    policy = Policy(identity, CLONE.network, 2, {}, variables)
    found = simulator.driven(policy, KEY, 4, slice(3, 6))
    short = replace(SYSTEM, steps=4)
    wanted = evaluate.drive(short, policy, jnp.asarray(demos.initial_states[3:6]), KEY)
    assert found.states.shape == (3, 4, 4)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(a, b)


def test_steps_out_of_bounds_have_no_weight_and_no_action(simulator):
    trajectories = random_trajectories(SYSTEM, KEY, 3)
    valid = np.arange(STEPS) < np.array([6, 2, 4])[:, None]
    found = simulator.labelled(trajectories._replace(valid=jnp.asarray(valid)))
    np.testing.assert_array_equal(found.weights, valid)
    assert (np.asarray(found.actions)[~valid] == 0).all()
    wanted = np.asarray(simulator.label(trajectories.states))
    np.testing.assert_allclose(np.asarray(found.actions)[valid], wanted[valid], atol=1e-6)
    np.testing.assert_array_equal(found.images, frames(SYSTEM, trajectories))
    np.testing.assert_array_equal(found.previous_actions, trajectories.previous_actions / LIMIT)


def test_redrawn_frames_differ_where_the_nuisance_is_alone(simulator, demos):
    found = np.asarray(simulator.redrawn(KEY, 5))
    assert found.shape == (COUNT, 5, *SIZE, 3)
    same = found == np.asarray(demos.images)[:, :5]
    assert same[:, :, 4:].all()
    assert same[:, :, :, 4:].all()
    assert (~same[:, :, 1, 1]).any(axis=-1).mean() > 0.95  # every frame has another colour
    red = found[:, :, 1, 1, 0] / 127.5 - 1
    assert np.abs(red.mean()) < 4 / np.sqrt(3 * red.size)
    assert abs(np.corrcoef(red.ravel(), np.asarray(demos.actions)[:, :5].ravel())[0, 1]) < 0.4


def copying(scale, memory, frame):
    """Reads the colour of the nuisance."""
    return memory + 1, scale * (frame[1, 1, :1] / 127.5 - 1.0) * (-1.0) ** memory


def test_what_is_no_policy_drives_by_its_frames_and_its_memory(simulator, demos):
    rows = jnp.array([5, 5, 2])
    found = simulator.seen(copying, 0.5, jnp.array([0, 1, 0]), rows, KEY)
    np.testing.assert_array_equal(found.states[:, 0], demos.initial_states[rows])
    signs = np.array([1, -1, 1])[:, None, None] * (-1.0) ** np.arange(STEPS)[:, None]
    wanted = 0.5 * signs * np.asarray(found.signals)
    np.testing.assert_allclose(found.actions, wanted, atol=0.2)
    assert np.abs(wanted[:, 0]).min() > 1
    np.testing.assert_array_equal(simulator.cost(found), evaluate.rollout_loss(SYSTEM, found))
