"""CartPole against golden values, Gym's equations in NumPy, conserved quantities and jacfwd.

tests/golden/control.json: dynamics from a sympy Lagrangian at 40 digits, checked against MuJoCo;
P is the solution of the discrete algebraic Riccati equation.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.systems import cartpole

SYSTEM = systems.get("cartpole")
GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "control.json").read_text())


def gym_step(state, force):
    """OpenAI Gym's cartpole.py, line by line; its `length` is half the pole's."""
    gravity, masscart, masspole, length, tau = 9.8, 1.0, 0.1, 0.5, 0.05
    x, x_dot, theta, theta_dot = state
    costheta, sintheta = np.cos(theta), np.sin(theta)
    total_mass, polemass_length = masspole + masscart, masspole * length
    temp = (force + polemass_length * theta_dot**2 * sintheta) / total_mass
    thetaacc = (gravity * sintheta - costheta * temp) / (
        length * (4.0 / 3.0 - masspole * costheta**2 / total_mass)
    )
    xacc = temp - polemass_length * thetaacc * costheta / total_mass
    return np.array(
        [x + tau * x_dot, x_dot + tau * xacc, theta + tau * theta_dot, theta_dot + tau * thetaacc]
    )


def random_points(count, dtype):
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (count, 4)) * [10, 10, np.pi, 10]
    return states.astype(dtype), rng.uniform(-25, 25, (count, 1)).astype(dtype)


@pytest.mark.parametrize("case", GOLDEN["cartpole_dynamics"])
def test_step_matches_golden(case):
    with jax.enable_x64(True):
        state, action = jnp.array(case["s"]), jnp.array([case["u"]])
        acceleration = cartpole.accelerations(cartpole.PARAMS, state, action[0])
        np.testing.assert_allclose(acceleration, [case["xacc"], case["thacc"]], rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            SYSTEM.step(state, action), case["next_euler"], rtol=0, atol=1e-12
        )
    single = SYSTEM.step(jnp.array(case["s"]), jnp.array([case["u"]]))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, case["next_euler"], rtol=0, atol=2e-5)


def test_step_matches_gym():
    states, actions = random_points(200, np.float64)
    expected = [gym_step(s, u[0]) for s, u in zip(states, actions, strict=True)]
    with jax.enable_x64(True):
        stepped = jax.vmap(SYSTEM.step)(jnp.asarray(states), jnp.asarray(actions))
        np.testing.assert_allclose(stepped, expected, rtol=0, atol=1e-12)


def test_power_of_the_force_is_the_rate_of_energy():
    """dE/dt = force x velocity holds for the exact accelerations, whatever the state."""

    def energy(state):
        x_dot, theta, theta_dot = state[1], state[2], state[3]
        half, mass = 0.5, 0.1
        velocity = (x_dot + half * theta_dot * jnp.cos(theta), half * theta_dot * jnp.sin(theta))
        kinetic = 0.5 * x_dot**2 + 0.5 * mass * (velocity[0] ** 2 + velocity[1] ** 2)
        spin = 0.5 * (mass * (2 * half) ** 2 / 12) * theta_dot**2
        return kinetic + spin + mass * 9.8 * half * jnp.cos(theta)

    def power(state, action):
        x_ddot, theta_ddot = cartpole.accelerations(cartpole.PARAMS, state, action[0])
        return jax.grad(energy)(state) @ jnp.stack([state[1], x_ddot, state[3], theta_ddot])

    states, actions = random_points(50, np.float64)
    with jax.enable_x64(True):
        rates = jax.vmap(power)(jnp.asarray(states), jnp.asarray(actions))
    np.testing.assert_allclose(rates, actions[:, 0] * states[:, 1], rtol=0, atol=1e-10)


def test_linearization_matches_jacfwd_and_golden():
    a, b = cartpole.linearize(cartpole.PARAMS)
    with jax.enable_x64(True):
        expected = jax.jacfwd(SYSTEM.step, (0, 1))(jnp.zeros(4), jnp.zeros(1))
    np.testing.assert_allclose(a, expected[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(b, expected[1], rtol=0, atol=1e-13)
    np.testing.assert_allclose(a, GOLDEN["statement"]["A"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(b, GOLDEN["statement"]["B"], rtol=0, atol=1e-12)


def test_terminal_cost_is_the_riccati_solution():
    np.testing.assert_allclose(
        jax.hessian(SYSTEM.terminal_cost)(jnp.zeros(4)) / 2, GOLDEN["statement"]["P"], rtol=1e-6
    )


def test_costs_match_numpy():
    states, actions = random_points(50, np.float32)
    stage = np.sum([1, 0.1, 10, 0.1] * states**2, axis=1) + 0.01 * actions[:, 0] ** 2
    excess = np.maximum(0, np.abs(states) - [5, 10, np.pi / 2, np.pi / 2])
    penalty = 100 * np.sum(excess**2, axis=1)
    assert (penalty > 0).any()
    np.testing.assert_allclose(jax.vmap(SYSTEM.stage_cost)(states, actions), stage, rtol=1e-5)
    np.testing.assert_allclose(jax.vmap(SYSTEM.state_penalty)(states), penalty, rtol=1e-4)
    assert SYSTEM.state_penalty(jnp.array([5.0, -10.0, 1.57, -1.57])) == 0


def test_initial_states_fill_the_box_uniformly():
    states = np.asarray(jax.vmap(SYSTEM.sample_initial)(jax.random.split(jax.random.key(0), 4000)))
    unit = states / [2.5, 5, np.pi / 4, np.pi / 4]
    assert np.abs(unit).max() <= 1
    # A uniform's empirical distribution strays from the diagonal by 1.63 / sqrt(n) at p = 0.01.
    ranks = np.arange(1, len(unit) + 1) / len(unit)
    assert np.abs((np.sort(unit, axis=0) + 1) / 2 - ranks[:, None]).max() < 1.63 / np.sqrt(4000)
    # The intervention makes the coordinates independent.
    assert np.abs(np.corrcoef(unit.T) - np.eye(4)).max() < 0.05
    again = SYSTEM.sample_initial(jax.random.split(jax.random.key(0), 4000)[7])
    np.testing.assert_allclose(again, states[7], rtol=1e-6)


@pytest.mark.parametrize(
    ("state", "inside"),
    [
        ((10.0, 99.0, 1.57, 99.0), True),
        ((-10.01, 0.0, 0.0, 0.0), False),
        ((0.0, 0.0, 1.58, 0.0), False),
        ((np.nan, 0.0, 0.0, 0.0), False),
    ],
)
def test_bounds(state, inside):
    assert bool(SYSTEM.in_bounds(jnp.array(state))) is inside


def test_initial_plan_keeps_the_pole_up_within_the_limits():
    start = jnp.array([2.0, 4.0, 0.7, 0.7])

    def angles(plan):
        return jax.lax.scan(lambda s, u: (SYSTEM.step(s, u), s[2]), start, plan)[1]

    plans = SYSTEM.initial_plans(start, 30)
    assert plans.shape == (1, 30, 1)
    assert jnp.abs(plans).max() == 25.0
    assert jnp.abs(angles(plans[0])).max() < np.pi / 2 < jnp.abs(angles(0 * plans[0])).max()


def test_unknown_name_lists_the_known_ones():
    assert "cartpole" in systems.names()
    with pytest.raises(ValueError, match=r"^name: expected one of .*cartpole.*, got 'cartpol'$"):
        systems.get("cartpol")
