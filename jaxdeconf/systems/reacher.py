"""Reacher: a two-link planar arm that brings its end to a target (paper, Section V-B).

No gravity, friction or joint limits. The paper names neither integrator nor costs nor initial
states: RK4 (forward Euler loses half the free arm's energy in 10 s) and the numbers below are ours.

State [6]: x*, y* (m, the target, fixed), theta_1 (rad, of the upper link, counterclockwise from
+x), theta_1_dot (rad/s), theta_2 (rad, of the forearm from the upper link), theta_2_dot (rad/s).
Angles are not wrapped. Action [2]: torques (N m) at shoulder and elbow.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.systems.system import Outcome, System
from jaxdeconf.vision import raster
from jaxdeconf.vision.nuisance import JoystickDot


@dataclass(frozen=True)
class ReacherParams:
    """SI constants; the links and the torques are the paper's, the rest is ours."""

    mass: float = 1.0  # kg, of each uniform rod
    length: float = 0.5  # m, of each rod
    dt: float = 0.05  # s, RK4
    torque_limit: float = 2.0  # N m
    action_cost: float = 0.1  # per (N m)², beside 1 per m² of distance
    terminal_cost: tuple[float, float] = (10.0, 0.5)  # per m², per (rad/s)²
    target_radius: tuple[float, float] = (0.1, 0.95)  # m
    # Half a circle for the bearings of target and upper link, about one centre. On whole circles
    # the torques would be independent of either alone: only their difference matters to the arm,
    # so Algorithm 1 could see neither (docs/reacher.md).
    bearing: tuple[float, float] = (-np.pi / 4, 3 * np.pi / 4)  # rad
    elbow: float = 3 * np.pi / 4  # rad, ±
    rate: float = 1.0  # rad/s, ± of each joint
    # rad/s. An arm that spins faster is lost, and RK4 with it: at full torque from rest it takes
    # seconds to get there, and no expert does.
    rate_bound: float = 30.0


PARAMS = ReacherParams()
_TARGET, _ANGLES, _RATES = slice(0, 2), slice(2, 6, 2), slice(3, 6, 2)


def mass_matrix(elbow: Array) -> tuple[Array, Array, Array]:
    """m11, m12, m22 (kg m²), [] each, of the joint-space mass matrix at an elbow angle []."""
    inertia = PARAMS.mass * PARAMS.length**2
    cos = jnp.cos(elbow)
    m12 = inertia * (1 / 3 + cos / 2)
    return inertia * (5 / 3 + cos), m12, jnp.full_like(cos, inertia / 3)


def accelerations(joints: Array, torques: Array) -> Array:
    """Joint accelerations [2] (rad/s²) of joints [4] and torques [2], by Lagrange's equations.

    Args:
      joints: theta_1, theta_1_dot, theta_2, theta_2_dot.
      torques: N m at shoulder and elbow.
    """
    _, rate_1, elbow, rate_2 = joints
    m11, m12, m22 = mass_matrix(elbow)
    coriolis = PARAMS.mass * PARAMS.length**2 / 2 * jnp.sin(elbow)
    push_1 = torques[0] + coriolis * (2 * rate_1 + rate_2) * rate_2
    push_2 = torques[1] - coriolis * rate_1**2
    determinant = m11 * m22 - m12**2
    return jnp.stack([m22 * push_1 - m12 * push_2, m11 * push_2 - m12 * push_1]) / determinant


def step(state: Array, action: Array) -> Array:
    """One RK4 step, the torques held: state [6], action [2] (N m, |action| <= 2) -> state [6]."""
    joints = state[2:]

    def slope(at: Array) -> Array:
        acceleration = accelerations(at, action)
        return jnp.stack([at[1], acceleration[0], at[3], acceleration[1]])

    def stage(carry: tuple[Array, Array], weights: Array) -> tuple[tuple[Array, Array], None]:
        last, total = carry
        last = slope(joints + PARAMS.dt * weights[0] * last)
        return (last, total + weights[1] * last), None

    # A loop of four: written out, XLA takes five times as long over its Jacobian on a CPU.
    weights = jnp.asarray([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]], state.dtype)
    zero = jnp.zeros_like(joints)
    (_, total), _ = jax.lax.scan(stage, (zero, zero), weights)
    return jnp.concatenate([state[_TARGET], joints + PARAMS.dt * total])


def elbow_and_end(state: Array) -> tuple[Array, Array]:
    """Positions [2] each (m) of the elbow and of the arm's end in state [6]; the shoulder is 0."""
    upper, fore = state[2], state[2] + state[4]
    elbow = PARAMS.length * jnp.stack([jnp.cos(upper), jnp.sin(upper)])
    return elbow, elbow + PARAMS.length * jnp.stack([jnp.cos(fore), jnp.sin(fore)])


def distance(state: Array) -> Array:
    """[] m from the arm's end to the target in state [6]."""
    return jnp.linalg.norm(_offset(state))


def _offset(state: Array) -> Array:
    return elbow_and_end(state)[1] - state[_TARGET]


def _squared_distance(state: Array) -> Array:
    """[] m², with the Gauss-Newton Hessian: the offset is linear about the state itself.

    The full one is indefinite where the end is far from the target, and the expert needs a convex
    model.
    """
    at = jax.lax.stop_gradient(state)
    offset, change = jax.jvp(_offset, (at,), (state - at,))
    return jnp.sum((offset + change) ** 2)


def stage_cost(state: Array, action: Array) -> Array:
    """[] squared distance of state [6] plus 0.1 times the squared torques of action [2]."""
    return _squared_distance(state) + PARAMS.action_cost * jnp.sum(action**2)


def state_penalty(state: Array) -> Array:
    """[] zero: the arm has no soft limits."""
    return jnp.zeros((), state.dtype)


def terminal_cost(state: Array) -> Array:
    """[] of the end of a plan, state [6]: be there, and at rest."""
    near, still = PARAMS.terminal_cost
    return near * _squared_distance(state) + still * jnp.sum(state[_RATES] ** 2)


# N m a rad and N m s a rad, of the controllers that make the expert's first plans.
_STIFFNESS, _DAMPING = (6.0, 2.0), (2.0, 0.7)


def initial_plans(state: Array, horizon: int) -> Array:
    """[6, K, 2] plans from state [6]: do nothing, brake, and reach each of four postures.

    Two postures reach a target, elbow to the one side or the other; and the elbow can get to each
    by either way round. A plan from one start alone is 1 to 65 % worse on six states of twenty.
    """
    angles, target = state[_ANGLES], state[_TARGET]
    radius = jnp.linalg.norm(target)
    bend = jnp.arccos(jnp.clip(radius**2 / (2 * PARAMS.length**2) - 1, -1.0, 1.0))
    goals = []
    for elbow in (bend, -bend):
        shoulder = jnp.arctan2(target[1], target[0]) - elbow / 2  # the links are of one length
        near = angles + _wrapped(jnp.stack([shoulder, elbow]) - angles)
        other = jnp.where(near[1] > angles[1], near[1] - 2 * jnp.pi, near[1] + 2 * jnp.pi)
        goals += [near, jnp.stack([near[0], other])]
    stiffness, damping = (jnp.asarray(gain, state.dtype) for gain in (_STIFFNESS, _DAMPING))
    stiff = jnp.stack([0 * stiffness, 0 * stiffness, *[stiffness] * 4])
    damped = jnp.stack([0 * damping, damping, *[damping] * 4])
    goals = jnp.stack([angles, angles, *goals])

    def plan(goal: Array, stiffness: Array, damping: Array) -> Array:
        def advance(current: Array, _: None) -> tuple[Array, Array]:
            torque = stiffness * (goal - current[_ANGLES]) - damping * current[_RATES]
            torque = jnp.clip(torque, -PARAMS.torque_limit, PARAMS.torque_limit)
            return step(current, torque), torque

        return jax.lax.scan(advance, state, length=horizon)[1]

    return jax.vmap(plan)(goals, stiff, damped)


def _wrapped(angle: Array) -> Array:
    """The same angle within [-pi, pi)."""
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


def sample_initial(key: Array) -> Array:
    """[6] target and arm, independent of one another: the intervention on S_1."""
    radius_key, bearing_key, joints_key = jax.random.split(key, 3)
    nearest, farthest = PARAMS.target_radius
    low, high = PARAMS.bearing
    # Uniform over the area.
    radius = jnp.sqrt(jax.random.uniform(radius_key, (), minval=nearest**2, maxval=farthest**2))
    bearing = jax.random.uniform(bearing_key, (), minval=low, maxval=high)
    lowest = jnp.asarray([low, -PARAMS.rate, -PARAMS.elbow, -PARAMS.rate])
    highest = jnp.asarray([high, PARAMS.rate, PARAMS.elbow, PARAMS.rate])
    joints = jax.random.uniform(joints_key, (4,), minval=lowest, maxval=highest)
    target = radius * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)])
    return jnp.concatenate([target, joints])


def in_bounds(state: Array) -> Array:
    """Whether both joints of state [6] turn at no more than 30 rad/s."""
    return jnp.all(jnp.abs(state[_RATES]) <= PARAMS.rate_bound)


# Seen from above, y up. Stretched out, the arm stays clear of the nuisance's corner.
_UNITS_PER_METER, _SHOULDER = 20.5, raster.UNITS / 2
_SHOULDER_RADIUS, _LINK_RADIUS, _TARGET_RADIUS = 3.5, 2.5, 3.2
_GREY, _BLUE, _WOOD, _BLACK = (0.72, 0.72, 0.75), (0.25, 0.42, 0.68), (0.80, 0.50, 0.20), (0, 0, 0)


def draw(state: Array, size: tuple[int, int] = (64, 64)) -> Array:
    """The frame [H, W, 3] in [0, 1] of state [6], without the nuisance; differentiable."""

    def units(position: Array) -> Array:
        return _SHOULDER + _UNITS_PER_METER * position * jnp.asarray([1.0, -1.0])

    points = raster.pixel_centers(size)
    shoulder = units(jnp.zeros(2))
    elbow, end = map(units, elbow_and_end(state))
    image = jnp.ones((*size, 3))
    shapes = (
        # The target lies below the arm, and is wider: it shows where the arm has reached it.
        (raster.disc(points, units(state[_TARGET]), _TARGET_RADIUS), _BLACK),
        (raster.disc(points, shoulder, _SHOULDER_RADIUS), _GREY),
        (raster.capsule(points, shoulder, elbow, _LINK_RADIUS), _BLUE),
        (raster.capsule(points, elbow, end, _LINK_RADIUS), _WOOD),
    )
    for shape, color in shapes:
        image = raster.paint(image, shape, color)
    return image


def _final_distance(states: Array, valid: Array) -> Array:
    return distance(states[-1])


REACHER = System(
    name="reacher",
    state_names=(
        "x* (m)",
        "y* (m)",
        "theta_1 (rad)",
        "theta_1_dot (rad/s)",
        "theta_2 (rad)",
        "theta_2_dot (rad/s)",
    ),
    action_names=("shoulder torque (N m)", "elbow torque (N m)"),
    action_limit=(PARAMS.torque_limit, PARAMS.torque_limit),
    dt=PARAMS.dt,
    steps=200,
    step=step,
    stage_cost=stage_cost,
    state_penalty=state_penalty,
    terminal_cost=terminal_cost,
    initial_plans=initial_plans,
    sample_initial=sample_initial,
    in_bounds=in_bounds,
    draw=draw,
    nuisance=JoystickDot(),
    outcome=Outcome(
        "final distance (m)",
        ".3f",
        "Final distance: from the arm's end to the target at the last step, mean over rollouts.",
        _final_distance,
    ),
)
