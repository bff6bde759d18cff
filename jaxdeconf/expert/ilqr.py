"""Box-constrained iterative LQR with Gauss-Newton Hessians (Tassa, Mansard & Todorov 2014).

    minimise  sum_{t=0}^{K-1} stage_cost(s_t, u_t) + terminal_cost(s_K) + sum_{t=1}^{K} penalty(s_t)
    subject to  s_{t+1} = step(s_t, u_t),  |u_t| <= limit

Every loop has a fixed count, so a vmap over initial states wastes nothing. Shapes: K plan, S state,
A action; functions take one initial state. V is the cost-to-go, Q the cost-to-go before the action,
subscripts are derivatives, all as in the paper. Hessians of the costs are JAX's own: a System whose
costs are not convex must write them so that their second derivative is the Gauss-Newton one.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf.expert import box_qp
from jaxdeconf.expert.box_qp import Scalars, fill
from jaxdeconf.systems import System

STEP_SIZES = (1.0, 0.5, 0.25, 0.125, 0.06, 0.02)
# Added to Q_uu once the best step is a short one or none, and ten times more each time it is so
# again: the model cannot see the soft limits that its own step runs into. Raising it only when no
# step helps leaves 34 of 8000 CartPole plans unconverged after 40 iterations, this leaves 2.
_SHORT_STEP = 0.2
_FIRST_REGULARIZATION = 1e-2
_LAST_REGULARIZATION = 1e6  # a plan at its optimum finds no better one: stay clear of overflow


class Solution(NamedTuple):
    """A plan and how far it is from a local optimum."""

    states: Array  # [K + 1, S]
    actions: Array  # [K, A]
    cost: Array  # []
    regularization: Array  # [] of the next iteration
    promise: Array  # [] decrease that the last iteration's quadratic model promised, in cost


def simulate(system: System, state: Array, control: Callable, inputs) -> tuple[Array, Array, Array]:
    """States [K + 1, S], actions [K, A] and cost [] of control(state, input) from state [S]."""

    def advance(carry: tuple, inputs) -> tuple[tuple, tuple]:
        state, cost = carry
        action = jnp.clip(control(state, inputs), -system.limits, system.limits)
        next_state = system.step(state, action)
        cost += system.stage_cost(state, action) + system.state_penalty(next_state)
        return (next_state, cost), (state, action)

    start = (state, jnp.zeros((), state.dtype))
    (last, cost), (states, actions) = jax.lax.scan(advance, start, inputs)
    return jnp.concatenate([states, last[None]]), actions, cost + system.terminal_cost(last)


def solve(system: System, state: Array, actions: Array, iterations: int) -> Solution:
    """A number of iterations from state [S] and a first plan [K, A]."""
    states, actions, cost = simulate(system, state, lambda _, action: action, actions)
    solution = Solution(states, actions, cost, jnp.zeros_like(cost), jnp.full_like(cost, jnp.inf))
    return jax.lax.scan(lambda s, _: (_iterate(system, s), None), solution, length=iterations)[0]


def _iterate(system: System, solution: Solution) -> Solution:
    """One backward pass and one line search; the plan changes only if the cost falls."""
    feedforward, feedback, promise = _backward(system, solution)
    inputs = (feedforward, feedback, solution.actions, solution.states[:-1])

    def attempt(best: tuple, step_size: Array) -> tuple[tuple, None]:
        def control(state: Array, inputs: tuple) -> Array:
            k, gain, action, planned = inputs
            return action + step_size * k + jnp.sum(gain * (state - planned), axis=-1)

        trial = (*simulate(system, solution.states[0], control, inputs), step_size)
        falls = trial[2] < best[2]  # False for NaN
        return jax.tree.map(lambda new, old: jnp.where(falls, new, old), trial, best), None

    # One after another: with the step sizes as an array axis the inner loops are six long instead
    # of as long as the caller's vmap, which takes four times as long on a CPU.
    stay = (solution.states, solution.actions, solution.cost, jnp.zeros_like(solution.cost))
    best, _ = jax.lax.scan(attempt, stay, jnp.asarray(STEP_SIZES, solution.cost.dtype))
    states, actions, cost, step_size = best
    old = solution.regularization
    lower = jnp.where(old > _FIRST_REGULARIZATION, old / 10.0, 0.0)
    higher = jnp.clip(old * 10.0, _FIRST_REGULARIZATION, _LAST_REGULARIZATION)
    regularization = jnp.where(step_size > _SHORT_STEP, lower, higher)
    return Solution(states, actions, cost, regularization, promise)


def _backward(system: System, solution: Solution) -> tuple[Array, Array, Array]:
    """Feedforward [K, A], feedback [K, A, S] and the promised decrease [] of the cost."""
    state_count, action_count = solution.states.shape[-1], solution.actions.shape[-1]
    limits = fill((action_count,), lambda i: system.limits[i])

    def running(state: Array, action: Array) -> Array:
        return system.stage_cost(state, action) + system.state_penalty(state)

    def final(state: Array) -> Array:
        return system.terminal_cost(state) + system.state_penalty(state)

    def recede(carry: tuple, point: tuple) -> tuple[tuple, tuple]:
        v_x, v_xx, promise = carry
        v_x, v_xx = _unstack(v_x, (state_count,)), _unstack(v_xx, (state_count, state_count))
        a, b = map(_scalars, jax.jacfwd(system.step, (0, 1))(*point))
        l_x, l_u = map(_scalars, jax.grad(running, (0, 1))(*point))
        (l_xx, _), (l_ux, l_uu) = jax.tree.map(_scalars, jax.hessian(running, (0, 1))(*point))
        action = _scalars(point[1])

        q_x, q_u = l_x + a.T @ v_x, l_u + b.T @ v_x
        q_xx, q_ux, q_uu = l_xx + a.T @ (v_xx @ a), l_ux + b.T @ (v_xx @ a), l_uu + b.T @ (v_xx @ b)
        promise += _promise(q_uu, q_u, -limits - action, limits - action)
        damped = fill(
            q_uu.shape, lambda i, j: q_uu[i, j] + (solution.regularization if i == j else 0.0)
        )
        k, inverse = box_qp.solve(damped, q_u, -limits - action, limits - action)
        gain = -inverse @ q_ux
        v_x = q_x + gain.T @ (q_uu @ k + q_u) + q_ux.T @ k
        cross = gain.T @ q_ux
        v_xx = _symmetric(q_xx + gain.T @ (q_uu @ gain) + cross + cross.T)
        return (v_x.tolist(), v_xx.tolist(), promise), (_array(k), _array(gain))

    last = solution.states[-1]
    carry = _scalars(jax.grad(final)(last)).tolist(), _scalars(jax.hessian(final)(last)).tolist()
    points = (solution.states[:-1], solution.actions)
    carry, gains = jax.lax.scan(
        recede, (*carry, jnp.zeros_like(solution.cost)), points, reverse=True
    )
    return *gains, carry[2]


def _promise(q_uu: Scalars, q_u: Scalars, low: Scalars, high: Scalars) -> Array:
    """Decrease [] that this action alone promises, whatever the regularisation."""
    k, _ = box_qp.solve(q_uu, q_u, low, high)
    return -(k @ q_u) - 0.5 * (k @ (q_uu @ k))


def _scalars(array: Array) -> Scalars:
    return fill(array.shape, lambda *index: array[index])


def _unstack(nested: list, shape: tuple[int, ...]) -> Scalars:
    return fill(shape, (lambda i: nested[i]) if len(shape) == 1 else (lambda i, j: nested[i][j]))


def _symmetric(matrix: Scalars) -> Scalars:
    """The lower triangle twice: rounding must not make V_xx drift from symmetry."""
    return fill(matrix.shape, lambda i, j: matrix[max(i, j), min(i, j)])


def _array(scalars: Scalars) -> Array:
    return jnp.stack(scalars.ravel().tolist()).reshape(scalars.shape)
