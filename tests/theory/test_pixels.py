"""CartPole's fork. Reference: the law of the first squares, by correlation and by margin."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.systems.cartpole import CARTPOLE
from jaxdeconf.systems.rollout import Trajectories
from jaxdeconf.theory.pixels import PixelsConfig, coupled

COUNT = 4000


def trajectories():
    states = jax.vmap(CARTPOLE.sample_initial)(jax.random.split(jax.random.key(0), COUNT))
    states = jnp.stack([states, states + 1.0], axis=1)
    actions = jnp.ones((COUNT, 2, 1))
    return Trajectories(states, actions, 5 * actions, jnp.ones((COUNT, 2), bool), 7 * actions)


def squares(coupling, seed=1):
    found = coupled(CARTPOLE, trajectories(), coupling, jax.random.key(seed))
    return np.asarray(found.states[:, 0, 0]), np.asarray(found.signals[:, 0, 0])


@pytest.mark.parametrize("coupling", [0.0, 0.5, 1.0])
def test_the_first_square_follows_the_place_as_often_as_is_said(coupling):
    place, square = squares(coupling)
    full = -0.8 / (0.8**2 + 0.2**2) ** 0.5  # of a sum of two uniforms
    assert np.corrcoef(place, square)[0, 1] == pytest.approx(coupling * full, abs=0.05)


def test_its_law_is_the_same_in_all_conditions():
    quantiles = [np.quantile(squares(c)[1], np.linspace(0, 1, 11)) for c in (0.0, 0.5, 1.0)]
    for one in quantiles:
        np.testing.assert_allclose(one, quantiles[0], atol=2.0)
        assert np.abs(one).max() <= CARTPOLE.action_limit[0]


def test_nothing_else_is_moved():
    before = trajectories()
    found = coupled(CARTPOLE, before, 1.0, jax.random.key(1))
    np.testing.assert_array_equal(found.states, before.states)
    np.testing.assert_array_equal(found.actions, before.actions)
    np.testing.assert_array_equal(found.previous_actions, before.previous_actions)
    np.testing.assert_array_equal(found.signals[:, 1:], before.signals[:, 1:])


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"couplings": (1.5,)}, r"couplings: expected numbers in \[0, 1\], got 1.5"),
        ({"method": "none"}, "method: expected one of "),
        ({"dataset": 4}, "dataset: expected an integer >= 5, got 4"),
        ({"rollouts": 0}, "rollouts: expected a positive integer, got 0"),
    ],
)
def test_a_wrong_number_is_said(wrong, said):
    with pytest.raises(ValueError, match=said):
        PixelsConfig(**wrong)
