"""What the expert would do where another was: against what it did, and plans from nothing."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.expert import ExpertConfig, expert_trajectories, plan, receding_horizon, relabel
from jaxdeconf.systems.rollout import rollout

SYSTEM = replace(systems.get("cartpole"), steps=20)
USUAL = ExpertConfig(horizon=20, initial_iterations=30)
LONGER = replace(USUAL, step_iterations=5, restart=True)
KEYS = jax.random.split(jax.random.key(0), 12)
STARTS = jax.vmap(SYSTEM.sample_initial)(KEYS)


@pytest.fixture(scope="module")
def disturbed():
    """States under an expert whose hand is shaken hard."""

    def one(start, key):
        memory, policy = receding_horizon(SYSTEM, LONGER)

        def shaking(memory, state, signal, key):
            memory, action = policy(memory, state, signal, key)
            return memory, action + 7.5 * jax.random.normal(key, (1,))

        return rollout(SYSTEM, shaking, memory(start), start, key)

    return jax.jit(jax.vmap(one))(STARTS, KEYS)


def test_of_its_own_trajectories_these_are_the_actions_that_it_took():
    own, _ = expert_trajectories(SYSTEM, STARTS, jax.random.key(1), USUAL)
    found = relabel(SYSTEM, own.states, USUAL)
    found, taken, within = map(np.asarray, (found, own.actions, own.valid))
    assert taken.std() > 3
    np.testing.assert_allclose(found[within], taken[within], atol=0.05)


def test_where_another_was_they_are_nearly_those_of_plans_from_nothing(disturbed):
    """The share that differs by over 2 % of the limit; and by improving the last plan alone."""
    places = np.argwhere(np.asarray(disturbed.valid))[::2]
    states = jnp.asarray(disturbed.states)[places[:, 0], places[:, 1]]
    cold = np.asarray(plan(SYSTEM, states, USUAL).actions[:, 0]) / 25

    def share(config):
        labels = np.asarray(relabel(SYSTEM, disturbed.states, config)) / 25
        return float((np.abs(labels[places[:, 0], places[:, 1]] - cold) > 0.02).mean())

    assert len(places) > 60
    assert share(LONGER) < 0.15
    assert share(replace(LONGER, step_iterations=1, restart=False)) > 0.3


def test_states_that_are_none_are_refused():
    with pytest.raises(ValueError, match=r"^states: expected numbers of shape \[N, T, 4\], got"):
        relabel(SYSTEM, jnp.zeros((3, 4)))
