"""Closed-loop scores against what they are by definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import evaluate, systems
from jaxdeconf.evaluate import Driver, EvaluateConfig, Weights
from jaxdeconf.learn import clone, views
from jaxdeconf.nets import resnet
from jaxdeconf.nets.resnet import ResNetConfig

SYSTEM = systems.get("cartpole")
NETWORK = ResNetConfig(width=4, stem="imagenet")


@pytest.fixture(scope="module")
def weights():
    return Weights(resnet.init(NETWORK, jax.random.key(0), (64, 64, 6), 1), {})


@pytest.fixture(scope="module")
def initial_states():
    return jax.vmap(SYSTEM.sample_initial)(jax.random.split(jax.random.key(1), 3))


@pytest.fixture(scope="module")
def driven(weights, initial_states):
    driver = Driver(NETWORK, views.identity)
    return evaluate.drive(SYSTEM, driver, weights, initial_states, jax.random.key(2))


def test_a_policy_drives_as_a_plain_loop_does(weights, initial_states, driven):
    state = initial_states[0]
    previous_action = driven.previous_actions[0, 0]
    previous = jnp.zeros((1, 64, 64, 3), jnp.uint8)
    for t in range(6):
        current = SYSTEM.frame(state, previous_action)[None]
        action = clone.act(NETWORK, weights.policy, previous, current)[0] * 25.0
        previous_action = jnp.clip(action, -25.0, 25.0)
        np.testing.assert_allclose(driven.states[0, t], state, atol=1e-3)
        np.testing.assert_allclose(driven.actions[0, t], previous_action, atol=1e-2)
        state, previous = SYSTEM.step(state, previous_action), current


def test_the_initial_states_and_the_nuisance_there_are_shared(weights, initial_states, driven):
    driver = Driver(NETWORK, views.covered(SYSTEM.nuisance))
    other = evaluate.drive(SYSTEM, driver, weights, initial_states, jax.random.key(2))
    np.testing.assert_array_equal(driven.states[:, 0], other.states[:, 0])
    np.testing.assert_array_equal(driven.previous_actions[:, 0], other.previous_actions[:, 0])


def test_rollout_loss_charges_the_cost_of_the_exit_for_the_rest(driven):
    losses, ended = evaluate.rollout_loss(SYSTEM, driven), 0
    for r in range(3):
        costs, states, actions = [], np.asarray(driven.states[r]), np.asarray(driven.actions[r])
        for t in range(100):
            x, x_dot, theta, theta_dot = states[t]
            cost = x**2 + 0.1 * x_dot**2 + 10 * theta**2 + 0.1 * theta_dot**2
            costs.append(cost + 0.01 * actions[t, 0] ** 2)
            if abs(x) > 10 or abs(theta) > np.pi / 2:
                costs += [costs[-1]] * (99 - t)
                ended += 1
                break
        assert len(costs) == 100
        assert losses[r] == pytest.approx(np.mean(costs), rel=1e-4)
        assert evaluate.outcome(SYSTEM, driven)[r] == (abs(states[-1, 2]) <= np.pi / 2)
    assert ended  # an untrained policy drops the pole


def test_copycat_is_zero_for_a_covered_nuisance_and_exact_for_a_pure_copy(
    weights, driven, monkeypatch
):
    driver = Driver(NETWORK, views.covered(SYSTEM.nuisance))
    score = evaluate.copycat(SYSTEM, driver, weights, driven, jax.random.key(3))
    assert score == 0.0

    def copy(network, variables, previous, current):
        return (current[:, 5, 5, :1] / 255.0 - 0.5) * 2.0  # red at +1, green at -1

    monkeypatch.setattr(clone, "act", copy)
    driver = Driver(ResNetConfig(width=3), views.identity)  # another key of the compilation cache
    score = evaluate.copycat(SYSTEM, driver, weights, driven, jax.random.key(3))
    shown = np.asarray(driven.previous_actions[:, 1:]) / 25.0
    # E|a - u| for u uniform on [-1, 1] is (1 + a²) / 2.
    assert score == pytest.approx(np.mean((1 + shown**2) / 2), rel=0.15)


@pytest.mark.parametrize(
    ("every", "per_epoch", "total", "steps"),
    [
        (0.25, 1250, 1562, (312, 625, 938, 1250, 1562)),
        (10.0, 100, 2500, (1000, 2000, 2500)),
        (10.0, 100, 1, (1,)),
        (0.001, 10, 3, (1, 2, 3)),
    ],
)
def test_evaluations_are_even_and_end_with_the_training(every, per_epoch, total, steps):
    assert EvaluateConfig(every=every).steps(per_epoch, total) == steps


@pytest.mark.parametrize(("field", "value"), [("rollouts", 0), ("every", 0.0)])
def test_a_bad_config_names_the_field_and_the_value(field, value):
    with pytest.raises(ValueError, match=rf"{field}: expected .*{value}"):
        EvaluateConfig(**{field: value})
