"""The expert against IPOPT, a NumPy cost, a convex two-control problem, and itself.

tests/golden/control.json: optima by casadi 3.8.2 / IPOPT at tolerance 1e-10.
"""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.expert import ExpertConfig, expert_trajectories, plan, receding_horizon
from jaxdeconf.systems.rollout import rollout

TRACED = []  # grows when JAX traces a step of SYSTEM anew


def counted_step(state, action):
    TRACED.append(1)
    return systems.get("cartpole").step(state, action)


SYSTEM = dataclasses.replace(systems.get("cartpole"), step=counted_step)
GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "control.json").read_text())
OPTIMA = GOLDEN["cartpole_soft_N30"]
STATES = np.array([case["x0"] for case in OPTIMA])
COSTS = np.array([case["cost"] for case in OPTIMA])


@pytest.fixture(scope="module")
def plans():
    return plan(SYSTEM, STATES)


@pytest.fixture(scope="module")
def many():
    """Closed loop from the golden states and 300 of the box; how many plans did not converge."""
    states = jax.vmap(SYSTEM.sample_initial)(jax.random.split(jax.random.key(0), 300))
    states = jnp.concatenate([STATES, states])
    return expert_trajectories(SYSTEM, states, jax.random.key(1))


def numpy_cost(state, actions):
    """J of one plan, in float64 and without the package."""
    terminal, total = np.array(GOLDEN["statement"]["P"]), 0.0
    for action in actions[:, 0].astype(float):
        total += np.sum([1, 0.1, 10, 0.1] * state**2) + 0.01 * action**2
        _, x_dot, theta, theta_dot = state
        pushed = (action + 0.05 * theta_dot**2 * np.sin(theta)) / 1.1
        turn = (9.8 * np.sin(theta) - np.cos(theta) * pushed) / (
            0.5 * (4 / 3 - 0.1 * np.cos(theta) ** 2 / 1.1)
        )
        slide = pushed - 0.05 * turn * np.cos(theta) / 1.1
        state = state + 0.05 * np.array([x_dot, slide, theta_dot, turn])
        excess = np.maximum(0, np.abs(state) - [5, 10, np.pi / 2, np.pi / 2])
        total += 100 * np.sum(excess**2)
    return total + state @ terminal @ state


def test_open_loop_matches_ipopt(plans):
    np.testing.assert_allclose(plans.cost, COSTS, rtol=1e-5)
    assert plans.converged.all()
    golden_actions = np.array([case["U"] for case in OPTIMA])
    np.testing.assert_allclose(plans.actions[:, 0, 0], golden_actions[:, 0], atol=2e-2)
    assert jnp.abs(plans.actions).max() <= 25


def test_another_horizon_matches_ipopt_one_by_one():
    optima, config = GOLDEN["cartpole_soft_N20"], ExpertConfig(horizon=20)
    plans = [plan(SYSTEM, [case["x0"]], config) for case in optima]
    assert plans[0].actions.shape == (1, 20, 1)
    costs = [float(each.cost[0]) for each in plans]
    np.testing.assert_allclose(costs, [case["cost"] for case in optima], rtol=1e-5)


def test_cost_is_that_of_the_actions(plans):
    expected = [numpy_cost(s, np.asarray(u)) for s, u in zip(STATES, plans.actions, strict=True)]
    np.testing.assert_allclose(plans.cost, expected, rtol=1e-5)


def test_closed_loop_matches_ipopt(many):
    trajectories, unconverged = jax.tree.map(lambda leaf: leaf[: len(STATES)], many)
    costs = jax.vmap(jax.vmap(SYSTEM.stage_cost))(trajectories.states, trajectories.actions)
    golden = GOLDEN["cartpole_closed_loop_soft_N30"]["stage_cost_sum"]
    np.testing.assert_allclose(costs.sum(axis=1), golden, rtol=1e-3)
    assert (unconverged == 0).all()


def test_no_pole_falls(many):
    trajectories, unconverged = many
    assert trajectories.valid.all()
    assert jnp.abs(trajectories.states[:, :, 2]).max() < np.pi / 2
    # Every trajectory ends near rest, upright, at x = 0.
    assert jnp.abs(trajectories.states[:, -1]).max() < 0.1
    assert (unconverged > 0).mean() < 0.02


@pytest.mark.parametrize("iterations", [4, 12])
def test_converged_means_converged(iterations):
    """Short of iterations some plans are unconverged, and those that claim to be are optimal."""
    got = plan(SYSTEM, STATES, ExpertConfig(initial_iterations=iterations))
    assert not got.converged.all()
    excess = np.asarray(got.cost) / COSTS - 1
    assert (excess[np.asarray(got.converged)] < 1e-4).all()


def test_expert_trajectories_are_rollouts_of_the_policy_one_by_one(many):
    trajectories, _ = many
    initial_memory, policy = receding_horizon(SYSTEM, ExpertConfig())

    @jax.jit
    def one(state, key):
        return rollout(SYSTEM, policy, initial_memory(state), state, key)

    keys = jax.random.split(jax.random.key(1), len(trajectories.states))
    for n in range(2):
        alone = one(trajectories.states[n, 0], keys[n])
        np.testing.assert_allclose(alone.states, trajectories.states[n], atol=1e-3)
        first = trajectories.previous_actions[n, 0]
        np.testing.assert_array_equal(alone.previous_actions[0], first)


def test_compiles_once(plans, many):
    count = len(TRACED)
    assert count > 0
    plan(SYSTEM, STATES[::-1])
    assert len(TRACED) == count
    expert_trajectories(SYSTEM, many[0].states[::-1, 0], jax.random.key(5))
    assert len(TRACED) == count


def two_controls():
    """A point mass in the plane that two skewed thrusters push: convex, so one optimum."""
    thrust = np.array([[1.0, 0.6], [-0.2, 0.8]])
    a = np.eye(4) + 0.1 * np.eye(4, k=2)
    b = np.concatenate([np.zeros((2, 2)), 0.1 * thrust])

    def cost(state, action):
        return state @ state + 0.05 * action @ action + 0.04 * action[0] * action[1]

    system = dataclasses.replace(
        SYSTEM,
        state_names=("x", "y", "x_dot", "y_dot"),
        action_limit=(1.0, 2.0),
        step=lambda state, action: jnp.asarray(a) @ state + jnp.asarray(b) @ action,
        stage_cost=cost,
        state_penalty=lambda state: 0.0 * state[0],
        terminal_cost=lambda state: 10 * state @ state,
        # The second start is as good as any; the first is NaN, and must lose.
        initial_plans=lambda state, horizon: jnp.stack(
            [jnp.full((horizon, 2), jnp.nan), jnp.zeros((horizon, 2))]
        ),
    )
    return system, a, b


def condensed_optimum(a, b, state, horizon):
    """The same problem as one box-QP in all actions, by accelerated projected gradient."""
    size = 2 * horizon
    drift, push = state, np.zeros((4, size))
    control = np.kron(np.eye(horizon), [[0.05, 0.02], [0.02, 0.05]])
    hessian, linear, constant = control, np.zeros(size), state @ state
    for t in range(horizon):
        drift, push = a @ drift, a @ push
        push[:, 2 * t : 2 * t + 2] += b
        weight = 10.0 if t == horizon - 1 else 1.0
        hessian = hessian + weight * push.T @ push
        linear, constant = linear + weight * push.T @ drift, constant + weight * drift @ drift
    limit, rate = np.tile([1.0, 2.0], horizon), 1 / np.linalg.eigvalsh(hessian).max()
    u = ahead = np.zeros(size)
    for n in range(3000):
        new = np.clip(ahead - rate * (hessian @ ahead + linear), -limit, limit)
        u, ahead = new, new + n / (n + 3) * (new - u)
    return u.reshape(horizon, 2), u @ hessian @ u + 2 * linear @ u + constant


def test_two_controls_match_a_condensed_qp():
    system, a, b = two_controls()
    states = np.random.default_rng(0).normal(size=(5, 4)) * [2, 2, 1, 1]
    plans = plan(system, states, ExpertConfig(horizon=15))
    assert plans.converged.all()
    for n, state in enumerate(states):
        actions, cost = condensed_optimum(a, b, state, 15)
        np.testing.assert_allclose(plans.cost[n], cost, rtol=1e-5)
        np.testing.assert_allclose(plans.actions[n], actions, atol=1e-2)
    held = np.abs(np.asarray(plans.actions)) == [1.0, 2.0]
    assert {0, 1, 2} <= set(held.sum(axis=-1).ravel())  # none, one and both at their limits


def test_a_horizon_is_no_config():
    with pytest.raises(ValueError, match=r"^config: expected a ExpertConfig, got 20$"):
        plan(SYSTEM, STATES, 20)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("states", "message"),
    [
        (np.zeros(4), r"expected numbers of shape \[N, 4\], got float64 of shape \(4,\)"),
        (np.zeros((2, 5)), r"expected numbers of shape \[N, 4\], got float64 of shape \(2, 5\)"),
        ([[0, 0, np.nan, 0]], r"expected finite numbers, got nan at \[0, 2\]"),
        ([[0, 0, 0, 0], [0, np.inf, 0, 0]], r"expected finite numbers, got inf at \[1, 1\]"),
        ([["a", "b", "c", "d"]], r"expected numbers of shape \[N, 4\], got <U1"),
        ([[1, 2, 3, 4], [1, 2]], r"expected an array, got rows of different lengths"),
        (None, r"expected numbers of shape \[N, 4\], got"),
    ],
)
def test_wrong_states_are_refused(states, message):
    for call in (
        lambda: plan(SYSTEM, states),
        lambda: expert_trajectories(SYSTEM, states, jax.random.key(0)),
    ):
        with pytest.raises(ValueError, match=f"^initial_states: {message}") as error:
            call()
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("horizon", [0, -3, 2.5, "30", None])
def test_wrong_horizon_is_refused(horizon):
    with pytest.raises(ValueError, match=r"^horizon: expected a positive integer, got "):
        ExpertConfig(horizon=horizon)


def test_wrong_tolerance_is_refused():
    with pytest.raises(ValueError, match=r"^tolerance: expected a positive number, got -1"):
        ExpertConfig(tolerance=-1.0)
