"""Algorithm 1 against the loops that the paper prints."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.independence import hoeffding_d, p_value, refined_d, threshold
from jaxdeconf.independence.interaction import interaction_r
from jaxdeconf.mask import MaskConfig, effective_threshold, find_mask, potential_causes
from tests.reference import mask_by_loops


def trajectories(seed: int, n: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two state coordinates drive the actions; of four observations the last two are nuisances."""
    rng = np.random.default_rng(seed)
    states = rng.uniform(-1, 1, size=(n, 3))
    seen = states[:, :2] + 0.2 * rng.normal(size=(n, 2))
    third = states[:, 2:]  # observed, but no action depends on it
    observations = np.concatenate([seen, third, rng.normal(size=(n, 1))], axis=1)
    pull = states[:, 0] - states[:, 1]
    actions = np.stack([pull, 0.5 * pull + 0.1 * rng.normal(size=n)], axis=1)[:, :, None]
    return states, observations, actions


def late(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An action in each of two steps, of the last state coordinate and then of the first."""
    states, observations, _ = trajectories(seed)
    return states, observations, np.stack([states[:, 2:], states[:, :1]], axis=1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("gamma", [1e-3, 0.02, 0.3])
def test_is_algorithm_1(seed, gamma):
    data = trajectories(seed)
    found = find_mask(*data, threshold=gamma, alpha=None)
    np.testing.assert_array_equal(found.mask, mask_by_loops(*data, gamma))


def test_masks_the_nuisances_and_shows_why():
    states, observations, actions = trajectories(0)
    found = find_mask(states, observations, actions, alpha=0.01)
    d = hoeffding_d(states, np.concatenate([observations, actions[..., 0]], axis=1))
    np.testing.assert_array_equal(found.mask, [False, False, True, True])
    assert found.potential_cause.shape == (4, 2, 1)
    np.testing.assert_array_equal(found.potential_cause[:2], True)
    assert found.state_action.shape == found.p_state_action.shape == (3, 2, 1)
    np.testing.assert_array_equal(found.state_observation, d[:, :4])
    np.testing.assert_array_equal(found.state_action[..., 0], d[:, 4:])
    np.testing.assert_array_equal(found.p_state_observation, p_value(found.state_observation, 120))


def test_alpha_only_ever_raises_the_threshold():
    data = trajectories(1)
    least = threshold(120, 3 * (4 + 2 * 1), 0.05)
    assert find_mask(*data, alpha=None).threshold == np.float32(1e-3)
    assert find_mask(*data).threshold == np.float32(least)  # 0.05 unless told otherwise
    assert find_mask(*data, threshold=0.9).threshold == np.float32(0.9)
    several = find_mask(*data, threshold=[0.0, 0.5, 0.9], alpha=1e-6).threshold
    np.testing.assert_allclose(several, np.maximum([0, 0.5, 0.9], threshold(120, 18, 1e-6)))
    assert effective_threshold(1e-3, 0.05, 120, 18) == np.float32(least)


def test_alpha_masks_what_chance_alone_would_keep():
    """Of a hundred nuisances of chance, the bare gamma keeps a third and alpha next to none."""
    states, _, actions = trajectories(0)
    noise = np.random.default_rng(5).normal(size=(25, 120, 4))
    found = [[find_mask(states, o, actions, alpha=a).mask for o in noise] for a in (None, 0.05)]
    bare, held = 100 - np.asarray(found).sum(axis=(1, 2))
    assert 25 <= bare <= 60
    assert held <= 2


@pytest.mark.parametrize("alpha", [None, 0.05])
def test_several_thresholds_at_once_are_one_at_a_time(alpha):
    data, gammas = late(2), np.array([[0.0, 1e-3, 0.02], [0.05, 0.3, 0.99]])
    together = find_mask(*data, gammas, alpha)
    assert together.mask.shape == (2, 3, 4)
    assert together.potential_cause.shape == (2, 3, 4, 2, 1)
    assert len(np.unique(np.asarray(together.mask).reshape(6, 4), axis=0)) > 1
    for place in np.ndindex(2, 3):
        alone = find_mask(*data, float(gammas[place]), alpha)
        np.testing.assert_array_equal(together.mask[place], alone.mask)
        np.testing.assert_array_equal(together.potential_cause[place], alone.potential_cause)
        assert together.threshold[place] == alone.threshold


def test_the_mask_within_fewer_steps_is_that_of_fewer_steps():
    states, observations, actions = late(3)
    gammas = np.array([1e-3, 0.05])
    whole = find_mask(states, observations, actions, gammas, None)
    for horizon in (1, 2):
        fewer = find_mask(states, observations, actions[:, :horizon], gammas, None)
        np.testing.assert_array_equal(whole.within(horizon), fewer.mask)
    # Under alpha, it is that of the same threshold, which more tests have raised.
    whole = find_mask(states, observations, actions)
    fewer = find_mask(states, observations, actions[:, :1], whole.threshold, None)
    np.testing.assert_array_equal(whole.within(1), fewer.mask)
    np.testing.assert_array_equal(whole.within(1), [True, True, False, True])
    np.testing.assert_array_equal(whole.within(2), [False, True, False, True])


def test_potential_causes_are_those_of_the_loops():
    rng = np.random.default_rng(6)
    observed, acted, gammas = rng.uniform(size=(3, 4)), rng.uniform(size=(3, 2, 5)), [0.3, 0.7, 0.9]
    found = potential_causes(observed, acted, np.array(gammas))
    for place, o, t, a in np.ndindex(3, 4, 2, 5):
        gamma = gammas[place]
        wanted = any(observed[s, o] > gamma and acted[s, t, a] > gamma for s in range(3))
        assert found[place, o, t, a] == wanted


def test_the_refined_statistic_is_the_papers_alternative():
    states, observations, actions = trajectories(4)
    found = find_mask(states, observations, actions, statistic="refined")
    r = refined_d(states, np.concatenate([observations, actions[..., 0]], axis=1))
    np.testing.assert_array_equal(found.state_observation, r[:, :4])
    np.testing.assert_array_equal(found.state_action[..., 0], r[:, 4:])
    np.testing.assert_array_equal(found.mask, [False, False, True, True])


def test_constant_states_mask_everything():
    states, observations, actions = trajectories(2)
    assert find_mask(np.zeros_like(states), observations, actions).mask.all()


@pytest.mark.parametrize("events", [5, 8, 20, 500])
def test_a_rare_cause_is_kept(events):
    """An observation that is the state and the action, as a button is, in few of 1000 episodes."""
    button = np.zeros((1000, 1))
    button[np.random.default_rng(events).permutation(1000)[:events]] = 1
    found = find_mask(button, button, button[:, :, None])
    assert not found.mask.any()
    assert found.tied_state_observation.all()
    assert found.tied_state_action.all()


def test_too_few_events_are_no_silent_matter():
    states, observations, actions = trajectories(0)
    observations[:, 3] = np.arange(120) < 4
    with pytest.warns(UserWarning, match="observations: column 3 has .* all but 4 trajectories"):
        found = find_mask(states, observations, actions)
    np.testing.assert_array_equal(found.tied_state_observation, [[False] * 3 + [True]] * 3)
    assert not found.tied_state_action.any()


def test_the_family_wise_error_of_tied_columns_is_at_most_alpha():
    """1000 data sets in which nothing depends on anything, three sigma allowed."""
    rng = np.random.default_rng(7)
    compiled, wrong = jax.jit(find_mask), 0
    for _ in range(1000):
        rare = (rng.random((4, 400)) < 0.03).astype(np.float32)
        states = np.column_stack([rare[0], rng.normal(size=400)])
        observations = np.column_stack([rare[1], rng.integers(0, 3, 400)])
        found = compiled(np.float32(states), np.float32(observations), rare[2:].T[:, :, None])
        wrong += max(found.state_observation.max(), found.state_action.max()) > found.threshold
    assert wrong <= 50 + 3 * (50 * 0.95) ** 0.5


def test_ties_among_several_thresholds_and_under_jit():
    states, observations, actions = (v.astype(np.float32) for v in trajectories(8))
    actions, observations[:, 2] = np.clip(actions, -0.5, 0.5), np.round(observations[:, 2])
    want = find_mask(states, observations, actions, [1e-3, 0.02, 0.3])
    assert want.tied_state_action.all()
    np.testing.assert_array_equal(want.mask[0], [False, False, True, True])
    np.testing.assert_array_equal(want.p_state_action, p_value(want.state_action, 120))
    got = jax.jit(find_mask)(states, observations, actions, jnp.array([1e-3, 0.02, 0.3]))
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_jit_jax_arrays_and_mixed_types():
    states, observations, actions = (v.astype(np.float32) for v in trajectories(3))
    want = find_mask(states, observations, actions)
    for got in (
        jax.jit(find_mask)(states, observations, actions, jnp.array(1e-3)),
        find_mask(states.astype(float), jnp.asarray(observations), actions),
    ):
        np.testing.assert_array_equal(got.mask, want.mask)
        np.testing.assert_allclose(got.state_action, want.state_action, atol=1e-7)


def test_the_defaults_are_those_of_the_config():
    data, config = trajectories(1), MaskConfig()
    given = find_mask(*data, config.threshold, config.alpha, config.statistic)
    for a, b in zip(find_mask(*data), given, strict=True):
        np.testing.assert_array_equal(a, b)
    assert replace(config, alpha=None, statistic="refined").threshold == config.threshold == 1e-3


def test_wrong_arguments():
    states, observations, actions = trajectories(0)
    with pytest.raises(
        ValueError, match=r"actions: expected numbers of shape .120, H, A., got .*\(120, 2\)"
    ):
        find_mask(states, observations, actions[:, :, 0])
    with pytest.raises(
        ValueError, match=r"observations: expected numbers of shape .120, O., got .*\(119, 4\)"
    ):
        find_mask(states, observations[1:], actions)


def joint(seed: int, n: int = 500) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An arm and a target on the circle, and a third state; an action of the angle between.

    Observations: of the arm, of the target, of the third state, noise, of the angle between.
    """
    rng = np.random.default_rng(seed)
    states = rng.uniform(-np.pi, np.pi, (n, 3))
    between = states[:, 1] - states[:, 0]
    seen = [np.sin(states[:, 0]), np.cos(states[:, 1]), states[:, 2], rng.normal(size=n)]
    observations = np.column_stack([*seen, np.cos(between)]) + 0.1 * rng.normal(size=(n, 5))
    return states, observations, np.sin(between)[:, None, None] + 0.2 * rng.normal(size=(n, 1, 1))


def test_causes_that_only_two_states_show_are_kept_and_nothing_else():
    """What is seen of the arm alone too: it is of one of the two states that move the action."""
    data = joint(0)
    alone, together = (find_mask(*data, states_together=count) for count in (1, 2))
    assert alone.mask.all()
    assert alone.pair_observation.shape == (0, 5)
    np.testing.assert_array_equal(together.mask, [False, False, True, True, False])
    assert (together.pair_action[:, 0, 0] > together.threshold).tolist() == [True, False, False]
    np.testing.assert_array_equal(
        together.pair_observation > together.threshold, [[0] * 4 + [1]] + [[0] * 5] * 2
    )
    pairs = interaction_r(data[0], np.concatenate([data[1], data[2][:, 0]], axis=1))
    np.testing.assert_array_equal(together.pair_observation, pairs[:, :5])
    np.testing.assert_array_equal(together.state_action[:2, 0, 0], pairs[0, 5])
    np.testing.assert_array_equal(together.p_state_action, p_value(together.state_action, 500))
    assert together.threshold == np.float32(threshold(500, 6 * (5 + 1), 0.05))


def test_a_nuisance_of_one_state_and_an_action_of_another_do_not_meet_in_their_pair():
    states, observations, actions = trajectories(5, 500)
    observations[:, 3] = states[:, 2] ** 2  # beside the state that no action depends on
    found = find_mask(states, observations, actions, states_together=2)
    np.testing.assert_array_equal(found.mask, [False, False, True, True])
