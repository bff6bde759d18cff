"""Reacher against golden values, Lagrange's equations by autodiff, and conserved energy.

tests/golden/control.json: dynamics from a sympy Lagrangian at 40 digits, checked against MuJoCo;
optima of casadi 3.8.2 / IPOPT, the best of eight starts.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.expert import ExpertConfig, receding_horizon
from jaxdeconf.independence import hoeffding_d, threshold
from jaxdeconf.systems import reacher
from jaxdeconf.systems.rollout import rollout

SYSTEM = systems.get("reacher")
GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "control.json").read_text())
QUICK = ExpertConfig(initial_iterations=15, step_iterations=1)


def golden_states():
    return np.array([case["target"] + case["x0"] for case in GOLDEN["reacher_rk4_N30"]])


def random_points(count, dtype):
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (count, 6)) * [1, 1, np.pi, 10, 7, 10]
    return states.astype(dtype), rng.uniform(-2, 2, (count, 2)).astype(dtype)


@pytest.mark.parametrize("case", GOLDEN["reacher_dynamics"])
def test_step_matches_golden(case):
    target = [0.3, -0.2]
    with jax.enable_x64(True):
        joints, torques = jnp.array(case["s"]), jnp.array(case["u"])
        acceleration = reacher.accelerations(joints, torques)
        np.testing.assert_allclose(acceleration, case["acc"], rtol=1e-13, atol=1e-12)
        stepped = SYSTEM.step(jnp.array(target + case["s"]), torques)
        np.testing.assert_allclose(stepped, target + case["next_rk4"], rtol=0, atol=1e-12)
        end = reacher.elbow_and_end(jnp.array(target + case["s"]))[1]
        np.testing.assert_allclose(end, case["end_effector"], rtol=0, atol=1e-12)
    single = SYSTEM.step(jnp.array(target + case["s"]), jnp.array(case["u"]))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, target + case["next_rk4"], rtol=0, atol=3e-5)


def energy(angles, rates):
    """Kinetic energy of two rods, each as ten thousand points along it."""
    along = (jnp.arange(10_000) + 0.5) / 10_000 * 0.5

    def positions(angles):
        upper, fore = angles[0], angles[0] + angles[1]
        elbow = 0.5 * jnp.stack([jnp.cos(upper), jnp.sin(upper)])
        first = along[:, None] * jnp.stack([jnp.cos(upper), jnp.sin(upper)])
        return jnp.stack(
            [first, elbow + along[:, None] * jnp.stack([jnp.cos(fore), jnp.sin(fore)])]
        )

    velocities = jax.jvp(positions, (angles,), (rates,))[1]
    return 0.5 * jnp.sum(velocities**2) / 10_000


def test_mass_matrix_is_the_hessian_of_the_kinetic_energy():
    of_rates = jax.jit(jax.hessian(energy, 1))
    with jax.enable_x64(True):
        for elbow in (-2.0, 0.0, 0.7, 3.0):
            hessian = of_rates(jnp.array([0.4, elbow]), jnp.array([0.3, -0.8]))
            m11, m12, m22 = reacher.mass_matrix(jnp.array(elbow))
            np.testing.assert_allclose([[m11, m12], [m12, m22]], hessian, rtol=1e-7)


def test_accelerations_fulfil_lagranges_equations():
    """d/dt dE/drate - dE/dangle = torque; there is no potential."""

    @jax.jit
    def torques(joints, acceleration):
        angles, rates = joints[0::2], joints[1::2]
        momentum = jax.grad(energy, 1)
        return jax.jvp(momentum, (angles, rates), (rates, acceleration))[1] - jax.grad(energy)(
            angles, rates
        )

    states, actions = random_points(20, np.float64)
    with jax.enable_x64(True):
        for joints, action in zip(jnp.asarray(states[:, 2:]), jnp.asarray(actions), strict=True):
            found = torques(joints, reacher.accelerations(joints, action))
            np.testing.assert_allclose(found, action, rtol=0, atol=1e-5)


def test_energy_is_conserved_without_torques():
    """To 1 % over 10 s, of arms as the expert finds them."""
    states = jax.vmap(SYSTEM.sample_initial)(jax.random.split(jax.random.key(0), 50))

    def free(state):
        return jax.lax.scan(lambda s, _: (SYSTEM.step(s, jnp.zeros(2)), s), state, length=200)[1]

    def kinetic(state):
        m11, m12, m22 = reacher.mass_matrix(state[4])
        return 0.5 * (m11 * state[3] ** 2 + 2 * m12 * state[3] * state[5] + m22 * state[5] ** 2)

    energies = jax.vmap(jax.vmap(kinetic))(jax.vmap(free)(states))
    assert energies[:, 0].min() > 0
    np.testing.assert_allclose(energies / energies[:, :1], 1.0, rtol=0, atol=0.01)


def test_costs_match_numpy():
    states, actions = random_points(50, np.float32)
    upper, fore = states[:, 2], states[:, 2] + states[:, 4]
    end = 0.5 * np.stack([np.cos(upper) + np.cos(fore), np.sin(upper) + np.sin(fore)], axis=1)
    squared = np.sum((end - states[:, :2]) ** 2, axis=1)
    stage = squared + 0.1 * np.sum(actions**2, axis=1)
    last = 10 * squared + 0.5 * np.sum(states[:, 3::2] ** 2, axis=1)
    np.testing.assert_allclose(jax.vmap(SYSTEM.stage_cost)(states, actions), stage, rtol=1e-5)
    np.testing.assert_allclose(jax.vmap(SYSTEM.terminal_cost)(states), last, rtol=1e-5)
    np.testing.assert_allclose(jax.vmap(reacher.distance)(states), np.sqrt(squared), rtol=1e-5)
    assert not jax.vmap(SYSTEM.state_penalty)(states).any()


def test_costs_have_exact_gradients_and_gauss_newton_hessians():
    def offset(state):
        return reacher.elbow_and_end(state)[1] - state[:2]

    @jax.jit
    def derivatives(state, action):
        costs = (f(SYSTEM.stage_cost)(state, action) for f in (jax.grad, jax.hessian))
        return jax.jacfwd(offset)(state), offset(state), *costs

    states, actions = random_points(10, np.float64)
    with jax.enable_x64(True):
        for state, action in zip(jnp.asarray(states), jnp.asarray(actions), strict=True):
            jacobian, error, gradient, hessian = derivatives(state, action)
            np.testing.assert_allclose(gradient, 2 * error @ jacobian, rtol=0, atol=1e-12)
            np.testing.assert_allclose(hessian, 2 * jacobian.T @ jacobian, rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def driven():
    """The golden states and 400 of the intervention's own, their plans, the golden ones driven.

    One program, because half a minute goes into compiling the expert.
    """
    sampled = jax.vmap(SYSTEM.sample_initial)(jax.random.split(jax.random.key(1), 400))
    states = jnp.concatenate([golden_states(), sampled])
    initial_memory, policy = receding_horizon(SYSTEM, QUICK)

    def drive(memory, state, key):
        return rollout(SYSTEM, policy, memory, state, key)

    @jax.jit
    def run(states, keys):
        memories = jax.vmap(initial_memory)(states)
        golden, count = jax.tree.map(lambda leaf: leaf[: len(keys)], memories), len(keys)
        return memories.plan, jax.vmap(drive)(golden, states[:count], keys)

    return states, *run(states, jax.random.split(jax.random.key(0), 10))


@pytest.mark.slow
def test_expert_plans_cost_as_the_best_of_eight(driven):
    states, plans, _ = driven
    assert plans.shape == (410, 30, 2)
    assert jnp.abs(plans).max() <= 2

    def cost(state, plan):
        def advance(state, action):
            return SYSTEM.step(state, action), SYSTEM.stage_cost(state, action)

        last, costs = jax.lax.scan(advance, state, plan)
        return costs.sum() + SYSTEM.terminal_cost(last)

    optima = [case["cost"] for case in GOLDEN["reacher_rk4_N30"]]
    np.testing.assert_allclose(jax.vmap(cost)(states[:10], plans[:10]), optima, rtol=1e-4)


@pytest.mark.slow
def test_expert_drives_like_ipopts_own(driven):
    golden, trajectories = GOLDEN["reacher_closed_loop_rk4_N30"], driven[2]
    costs = jax.vmap(jax.vmap(SYSTEM.stage_cost))(trajectories.states, trajectories.actions)
    total = costs[:, : golden["T"]].sum(axis=1)
    np.testing.assert_allclose(total, golden["stage_cost_sum"], rtol=1e-3)
    final = jax.vmap(reacher.distance)(trajectories.states[:, -1])
    assert trajectories.valid.all()
    assert final.max() < 0.01


def test_first_plans_are_six_and_reach_by_both_ways_round():
    state = jnp.array([0.3, 0.4, 0.2, 0.5, 1.0, -0.5])
    plans = SYSTEM.initial_plans(state, 60)
    assert plans.shape == (6, 60, 2)
    assert jnp.abs(plans).max() <= 2.0
    assert not plans[0].any()

    def end(actions):
        return jax.lax.scan(lambda s, u: (SYSTEM.step(s, u), None), state, actions)[0]

    ends = jax.vmap(end)(plans)
    assert jnp.abs(ends[1, 3::2]).max() < 0.05
    assert jax.vmap(reacher.distance)(ends[2:]).max() < 0.05
    # |theta_2| of the two postures, and each less or more than a turn away.
    bend = np.arccos(2 * 0.25 - 1)
    np.testing.assert_allclose(
        jnp.sort(ends[2:, 4]), np.sort([bend, bend - 2 * np.pi, -bend, 2 * np.pi - bend]), atol=0.1
    )


def test_initial_states_are_independent_and_within_their_ranges():
    states = np.asarray(jax.vmap(SYSTEM.sample_initial)(jax.random.split(jax.random.key(0), 4000)))
    radius = np.linalg.norm(states[:, :2], axis=1)
    bearing = np.arctan2(states[:, 1], states[:, 0])
    quarter = np.pi / 4
    unit = np.stack(
        [
            (radius**2 - 0.1**2) / (0.95**2 - 0.1**2),
            (bearing + quarter) / np.pi,
            (states[:, 2] + quarter) / np.pi,
            (states[:, 4] / (3 * quarter) + 1) / 2,
            *(states[:, 3::2].T + 1) / 2,
        ],
        axis=1,
    )
    assert unit.min() >= -1e-6
    assert unit.max() <= 1 + 1e-6
    # A uniform's empirical distribution strays from the diagonal by 1.63 / sqrt(n) at p = 0.01.
    ranks = np.arange(1, len(unit) + 1) / len(unit)
    assert np.abs(np.sort(unit, axis=0) - ranks[:, None]).max() < 1.63 / np.sqrt(4000)
    assert np.abs(np.corrcoef(unit.T) - np.eye(6)).max() < 0.05


@pytest.mark.slow
def test_first_actions_depend_on_target_and_arm(driven):
    """What Algorithm 1 needs, and what whole circles of bearings would not give."""
    states, actions = driven[0][10:], driven[1][10:, 0]
    d = np.asarray(hoeffding_d(states, actions)).max(axis=1)
    assert (d[[0, 1, 2, 4]] > 3 * threshold(400, 36, 0.05)).all()


@pytest.mark.parametrize(
    ("rates", "inside"), [((30.0, -30.0), True), ((30.1, 0.0), False), ((0.0, np.nan), False)]
)
def test_bounds(rates, inside):
    state = jnp.array([0.1, 0.2, 99.0, rates[0], -99.0, rates[1]])
    assert bool(SYSTEM.in_bounds(state)) is inside


def test_picture_gradients_match_finite_differences():
    weights = np.random.default_rng(0).normal(size=(64, 64, 3))
    states = random_points(10, np.float64)[0]
    with jax.enable_x64(True):
        loss = jax.jit(lambda s: jnp.sum(weights * SYSTEM.render(s, jnp.array([0.7, -1.0]))))
        gradient, h = jax.jit(jax.grad(loss)), 1e-6
        for state in jnp.asarray(states):
            numeric = [(loss(state + d) - loss(state - d)) / (2 * h) for d in h * jnp.eye(6)]
            got = gradient(state)
            np.testing.assert_allclose(got, jnp.array(numeric), rtol=1e-4, atol=1e-4)
            assert (got[3], got[5]) == (0, 0)
            assert jnp.abs(got[jnp.array([2, 4])]).min() > 1e-3


def test_arm_and_target_are_never_under_the_nuisance():
    angles = jnp.linspace(-np.pi, np.pi, 73)
    zero = jnp.zeros_like(angles)
    targets = 0.95 * jnp.stack([jnp.cos(angles), jnp.sin(angles)])
    stretched = jnp.stack([*targets, angles, zero, zero, zero], axis=1)
    corners = jax.jit(jax.vmap(lambda s: SYSTEM.draw(s)[:15, :15]))(stretched)
    assert (corners == 1).all()


def test_picture_shows_the_arm_from_above():
    """The upper link to the right, the forearm up, and the target at the left."""
    image = SYSTEM.draw(jnp.array([-0.8, 0.0, 0.0, 0.0, np.pi / 2, 0.0]))
    np.testing.assert_allclose(image[31, 38], (0.25, 0.42, 0.68), atol=1e-6)
    np.testing.assert_allclose(image[24, 42], (0.80, 0.50, 0.20), atol=1e-6)
    np.testing.assert_allclose(image[31, 15], 0.0, atol=1e-6)
