import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.independence import hoeffding_d, p_value, threshold
from jaxdeconf.mask import find_mask
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


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("gamma", [1e-3, 0.02, 0.3])
def test_is_algorithm_1(seed, gamma):
    data = trajectories(seed)
    np.testing.assert_array_equal(
        find_mask(*data, threshold=gamma).mask, mask_by_loops(*data, gamma)
    )


def test_masks_the_nuisances_and_shows_why():
    states, observations, actions = trajectories(0, n=2000)
    found = find_mask(states, observations, actions, alpha=0.01)
    np.testing.assert_array_equal(found.mask, [False, False, True, True])
    assert found.potential_cause.shape == (4, 2, 1)
    np.testing.assert_array_equal(found.potential_cause[:2], True)
    assert found.state_action.shape == found.p_state_action.shape == (3, 2, 1)
    np.testing.assert_array_equal(found.state_observation, hoeffding_d(states, observations))
    np.testing.assert_array_equal(found.p_state_observation, p_value(found.state_observation, 2000))


def test_alpha_only_ever_raises_the_threshold():
    data = trajectories(1)
    assert find_mask(*data).threshold == 1e-3
    assert find_mask(*data, alpha=0.05).threshold == threshold(120, 3 * (4 + 2 * 1), 0.05)
    assert find_mask(*data, threshold=0.9, alpha=0.05).threshold == 0.9


def test_constant_states_mask_everything():
    states, observations, actions = trajectories(2)
    assert find_mask(np.zeros_like(states), observations, actions).mask.all()


def test_jit_jax_arrays_and_mixed_types():
    states, observations, actions = (v.astype(np.float32) for v in trajectories(3))
    want = find_mask(states, observations, actions)
    for got in (
        jax.jit(find_mask)(states, observations, actions),
        find_mask(states.astype(float), jnp.asarray(observations), actions),
    ):
        np.testing.assert_array_equal(got.mask, want.mask)
        np.testing.assert_allclose(got.state_action, want.state_action, atol=1e-7)


def test_wrong_arguments():
    states, observations, actions = trajectories(0)
    with pytest.raises(
        ValueError, match=r"actions: expected numbers of shape .N, H, A., got .*\(120, 2\)"
    ):
        find_mask(states, observations, actions[:, :, 0])
    with pytest.raises(ValueError, match="observations: expected 120 trajectories, got 119"):
        find_mask(states, observations[1:], actions)
