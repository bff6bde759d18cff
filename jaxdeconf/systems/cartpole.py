"""CartPole: a pole balanced on a cart by a horizontal force (Barto, Sutton & Anderson 1983).

The equations are those of OpenAI Gym's CartPole, with the constants of the paper's appendix; the
initial box stands in the comments of its source. Costs and soft limits are ours: the paper says
"quadratic" and gives no weights.

State [4]: x (m), x_dot (m/s), theta (rad, 0 upright, positive towards +x), theta_dot (rad/s).
Action [1]: force (N), positive towards +x.
"""

from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.systems.system import System
from jaxdeconf.vision import raster
from jaxdeconf.vision.nuisance import ColorSquare


@dataclass(frozen=True)
class CartPoleParams:
    """SI constants; all the paper's but the cost weights."""

    cart_mass: float = 1.0  # kg
    pole_mass: float = 0.1  # kg
    half_length: float = 0.5  # m, half of the 1 m pole
    gravity: float = 9.8  # m/s²
    dt: float = 0.05  # s, forward Euler
    force_limit: float = 25.0  # N
    state_cost: tuple[float, ...] = (1.0, 0.1, 10.0, 0.1)  # ours: diagonal of Q
    action_cost: float = 0.01  # ours: R
    # The limits are the paper's expert's; soft and from t=1 on, because one 25 N step moves
    # theta_dot by 1.83 rad/s: 15 % of the initial box has no plan within them.
    soft_limits: tuple[float, ...] = (5.0, 10.0, np.pi / 2, np.pi / 2)
    penalty: float = 100.0  # ours
    initial_box: tuple[float, ...] = (2.5, 5.0, np.pi / 4, np.pi / 4)  # ± each, uniform
    bounds: tuple[float, float] = (10.0, np.pi / 2)  # |x|, |theta| beyond which it has failed


PARAMS = CartPoleParams()


def accelerations(params: CartPoleParams, state: Array, force: Array) -> Array:
    """Frictionless cart-pole accelerations (Barto, Sutton & Anderson 1983).

    Args:
      params: SI constants; `half_length` is half of the 1 m pole.
      state: [4] x (m), x_dot (m/s), theta (rad, 0 upright), theta_dot (rad/s).
      force: [] newtons, positive towards +x.
    Returns:
      [2] x_ddot (m/s²), theta_ddot (rad/s²).
    """
    theta, theta_dot = state[2], state[3]
    sin, cos = jnp.sin(theta), jnp.cos(theta)
    mass = params.cart_mass + params.pole_mass
    pole = params.pole_mass * params.half_length
    pushed = (force + pole * theta_dot**2 * sin) / mass
    inertia = params.half_length * (4.0 / 3.0 - params.pole_mass * cos**2 / mass)
    theta_ddot = (params.gravity * sin - cos * pushed) / inertia
    return jnp.stack([pushed - pole * theta_ddot * cos / mass, theta_ddot])


def step(state: Array, action: Array) -> Array:
    """One forward-Euler step: state [4], action [1] (N, |action| <= 25) -> next state [4]."""
    x_ddot, theta_ddot = accelerations(PARAMS, state, action[0])
    return state + PARAMS.dt * jnp.stack([state[1], x_ddot, state[3], theta_ddot])


def stage_cost(state: Array, action: Array) -> Array:
    """Quadratic cost [] of a state [4] and an action [1] against the upright pole at x = 0."""
    return jnp.dot(jnp.asarray(PARAMS.state_cost), state**2) + PARAMS.action_cost * action[0] ** 2


def state_penalty(state: Array) -> Array:
    """Soft limits []: penalty times the summed squared excess of state [4] over its limits."""
    excess = jnp.maximum(jnp.abs(state) - jnp.asarray(PARAMS.soft_limits), 0.0)
    return PARAMS.penalty * jnp.sum(excess**2)


def linearize(params: CartPoleParams) -> tuple[np.ndarray, np.ndarray]:
    """A [4, 4] and B [4, 1] of the Euler step at the upright state."""
    mass = params.cart_mass + params.pole_mass
    pole = params.pole_mass * params.half_length / mass
    inertia = params.half_length * (4.0 / 3.0 - params.pole_mass / mass)
    fall, push = params.gravity / inertia, -1.0 / (mass * inertia)
    drift = np.array([[0, 1, 0, 0], [0, 0, -pole * fall, 0], [0, 0, 0, 1], [0, 0, fall, 0]])
    force = np.array([[0], [1 / mass - pole * push], [0], [push]])
    return np.eye(4) + params.dt * drift, params.dt * force


@cache
def riccati(state_cost: tuple[float, ...], action_cost: float) -> tuple[np.ndarray, np.ndarray]:
    """The infinite-horizon LQR at upright: cost-to-go P [4, 4] and gain K [1, 4], action = -K s.

    Value iteration in float64; 2000 sweeps are 100 s of plant time, far past convergence.
    """
    a, b = linearize(PARAMS)
    q, r = np.diag(state_cost), np.array([[action_cost]])
    p = q
    for _ in range(2000):
        k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
        p = q + a.T @ p @ (a - b @ k)
    return p, k


def terminal_cost(state: Array) -> Array:
    """LQR cost-to-go [] of state [4]: the bare stage cost leaves short horizons unstable."""
    p, _ = riccati(PARAMS.state_cost, PARAMS.action_cost)
    return state @ jnp.asarray(p, state.dtype) @ state


def initial_plans(state: Array, horizon: int) -> Array:
    """[1, K, 1] a clipped LQR rollout from state [4] that rights the pole before the cart.

    The pole-first weights matter: the stage cost's own LQR, clipped, drops the pole from the edge
    of the box, and the solver then starts from a fallen one.
    """
    _, gain = riccati((0.01, 0.01, 10.0, 0.1), PARAMS.action_cost)
    gain = jnp.asarray(gain, state.dtype)

    def advance(current: Array, _: None) -> tuple[Array, Array]:
        action = jnp.clip(-gain @ current, -PARAMS.force_limit, PARAMS.force_limit)
        return step(current, action), action

    return jax.lax.scan(advance, state, length=horizon)[1][None]


def sample_initial(key: Array) -> Array:
    """[4] uniform over the box: the distributional intervention on S_1."""
    box = jnp.asarray(PARAMS.initial_box)
    return jax.random.uniform(key, (4,), minval=-box, maxval=box)


def in_bounds(state: Array) -> Array:
    """Whether state [4] still has |x| <= 10 m and |theta| <= pi/2."""
    return (jnp.abs(state[0]) <= PARAMS.bounds[0]) & (jnp.abs(state[2]) <= PARAMS.bounds[1])


# The camera sees 19 m, so that most of a cart at |x| = 8.5 m is in the picture. To that scale the
# pole would be 3 units long: it is drawn 27 long, legible at 64 × 64, and its tip stays below the
# nuisance at every angle.
_UNITS_PER_METER = raster.UNITS / 19.0
_TRACK, _PIVOT, _POLE_LENGTH = 55.0, 47.0, 27.0
_CART_HALF_SIZE, _POLE_RADIUS = (5.0, 3.5), 1.6
_GREY, _INK, _WOOD = (0.72, 0.72, 0.75), (0.16, 0.18, 0.24), (0.80, 0.50, 0.20)


def draw(state: Array, size: tuple[int, int] = (64, 64)) -> Array:
    """The frame [H, W, 3] in [0, 1] of state [4], without the nuisance; differentiable."""
    points = raster.pixel_centers(size)
    x = raster.UNITS / 2 + _UNITS_PER_METER * state[0]
    pivot = jnp.stack([x, jnp.full_like(x, _PIVOT)])
    tip = pivot + _POLE_LENGTH * jnp.stack([jnp.sin(state[2]), -jnp.cos(state[2])])
    image_width = raster.UNITS * size[1] / min(size)
    track = raster.rectangle(points, (raster.UNITS / 2, _TRACK), (image_width, 0.5))
    image = raster.paint(jnp.ones((*size, 3)), track, _GREY)
    cart = raster.rectangle(points, jnp.stack([x, pivot[1] + 3.5]), _CART_HALF_SIZE)
    image = raster.paint(image, cart, _INK)
    return raster.paint(image, raster.capsule(points, pivot, tip, _POLE_RADIUS), _WOOD)


CARTPOLE = System(
    name="cartpole",
    state_names=("x (m)", "x_dot (m/s)", "theta (rad)", "theta_dot (rad/s)"),
    action_names=("force (N)",),
    action_limit=(PARAMS.force_limit,),
    dt=PARAMS.dt,
    steps=100,
    step=step,
    stage_cost=stage_cost,
    state_penalty=state_penalty,
    terminal_cost=terminal_cost,
    initial_plans=initial_plans,
    sample_initial=sample_initial,
    in_bounds=in_bounds,
    draw=draw,
    nuisance=ColorSquare(),
)
