"""The expert: receding-horizon control of a known system (the paper's MPC), solved by iLQR.

Shapes: N trajectories, T time, K plan, S state, A action. The paper's t=1 is index 0.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxdeconf import checks
from jaxdeconf.expert import ilqr
from jaxdeconf.systems import System, Trajectories
from jaxdeconf.systems.rollout import Policy, rollout_with_memory
from jaxdeconf.traced import traceable


@traceable
@dataclass(frozen=True)
class ExpertConfig:
    """How the expert plans. The paper says only that it is MPC: the numbers are ours."""

    horizon: int = 30  # ours: 1.5 s of CartPole, then the terminal cost stands for the rest
    initial_iterations: int = 50  # ours: of 8000 CartPole plans 800 need over 10, two over 40
    step_iterations: int = 2  # ours: from the last plan; within 1e-4 of an interior-point MPC
    # Ours. A plan has converged if the last iteration's model promised to lower the cost by no more
    # than this fraction: a Gauss-Newton decrement, so the cost after that iteration is closer yet.
    tolerance: float = 1e-4
    # A cost below this counts as this: what is left at rest on the goal is rounding. Ours, of a
    # mean stage cost of 1e-4 over 30 steps.
    least_cost: float = 3e-3
    # Whether every step also solves from the system's own first plans, and takes the better: for
    # states that another than the expert led to, where its last plan may be far from the best.
    restart: bool = False

    def __post_init__(self) -> None:
        for name in ("horizon", "initial_iterations", "step_iterations"):
            checks.integer(name, getattr(self, name))
        checks.positive("tolerance", self.tolerance)
        checks.positive("least_cost", self.least_cost)


class Plans(NamedTuple):
    """Open-loop plans, each the best of the system's starts."""

    actions: Array  # [N, K, A]
    cost: Array  # [N] stage costs, soft-limit penalties of t = 1..K, and terminal cost
    converged: Array  # [N] bool, to a local optimum: see ExpertConfig.tolerance


class Memory(NamedTuple):
    """What the receding-horizon policy carries from step to step."""

    plan: Array  # [K, A] the first guess for the next solve
    unconverged: Array  # [] int, steps so far whose plan had not converged


def plan(system: System, initial_states: ArrayLike, config: ExpertConfig | None = None) -> Plans:
    """Optimal open-loop plans from N initial states.

    Args:
      system: what moves.
      initial_states: [N, S] finite, in the system's units.
      config: all but its `step_iterations` is used, `horizon` as K; the default is
        `ExpertConfig()`.
    Returns:
      Plans: actions [N, K, A] within the limits, cost [N], converged [N].
    Raises:
      ValueError: if `initial_states` has another shape or is not finite.
    """
    config = ExpertConfig() if config is None else config
    checks.instance("config", config, ExpertConfig)
    return _plan(system, _states(system, initial_states), config)


@partial(jax.jit, static_argnums=(0, 2))
def _plan(system: System, states: Array, config: ExpertConfig) -> Plans:
    def one(state: Array) -> Plans:
        solution = _solve_cold(system, state, config)
        return Plans(solution.actions, solution.cost, _converged(solution, config))

    return jax.vmap(one)(states)


def receding_horizon(
    system: System, config: ExpertConfig
) -> tuple[Callable[[Array], Memory], Policy]:
    """The expert as a policy for `systems.rollout`.

    Returns:
      initial_memory: state [S] -> Memory, by a solve from the system's own starts.
      policy: improves the remembered plan at the present state, takes its first action, and
        remembers the rest with the last action twice.
    """

    def initial_memory(state: Array) -> Memory:
        solution = _solve_cold(system, state, config)
        return Memory(solution.actions, jnp.zeros((), jnp.int32))

    def policy(memory: Memory, state: Array, signal: Array, key: Array):
        solution = ilqr.solve(system, state, memory.plan, config.step_iterations)
        if config.restart:
            again = replace(config, initial_iterations=config.step_iterations)
            solution = _better(solution, _solve_cold(system, state, again))
        actions = solution.actions
        rest = jnp.concatenate([actions[1:], actions[-1:]])
        unconverged = memory.unconverged + ~_converged(solution, config)
        return Memory(rest, unconverged), actions[0]

    return initial_memory, policy


def expert_trajectories(
    system: System, initial_states: ArrayLike, key: Array, config: ExpertConfig | None = None
) -> tuple[Trajectories, Array]:
    """Closed-loop trajectories of the expert from N initial states.

    Args:
      system: what moves.
      initial_states: [N, S] finite, in the system's units.
      key: draws the random actions before each trajectory's first step.
      config: the default is `ExpertConfig()`.
    Returns:
      Trajectories [N, T, ...], and unconverged [N] int: in how many of the T steps the plan had
      not converged. The action was taken all the same.
    Raises:
      ValueError: if `initial_states` has another shape or is not finite.
    """
    config = ExpertConfig() if config is None else config
    return _trajectories(system, _states(system, initial_states), key, config)


@partial(jax.jit, static_argnums=(0, 3))
def _trajectories(
    system: System, states: Array, key: Array, config: ExpertConfig
) -> tuple[Trajectories, Array]:
    initial_memory, policy = receding_horizon(system, config)

    def one(state: Array, key: Array) -> tuple[Trajectories, Array]:
        memory = initial_memory(state)
        trajectory, memory = rollout_with_memory(system, policy, memory, state, key)
        return trajectory, memory.unconverged

    return jax.vmap(one)(states, jax.random.split(key, len(states)))


def relabel(system: System, states: ArrayLike, config: ExpertConfig | None = None) -> Array:
    """What the receding-horizon expert would do in the states that another went through.

    Of its own trajectories these are the actions that it took.

    Args:
      system: what moves.
      states: [N, T, S] finite, N trajectories in the system's units.
      config: the default is `ExpertConfig()`.
    Returns:
      [N, T, A] actions within the limits.
    Raises:
      ValueError: if `states` has another shape or is not finite.
    """
    config = ExpertConfig() if config is None else config
    return _relabel(system, _states(system, states, "states", ("N", "T")), config)


@partial(jax.jit, static_argnums=(0, 2))
def _relabel(system: System, states: Array, config: ExpertConfig) -> Array:
    initial_memory, policy = receding_horizon(system, config)

    def one(states: Array) -> Array:
        def advance(memory: Memory, state: Array) -> tuple[Memory, Array]:
            return policy(memory, state, system.limits, jax.random.key(0))  # it looks at neither

        return jax.lax.scan(advance, initial_memory(states[0]), states)[1]

    return jax.vmap(one)(states)


def _solve_cold(system: System, state: Array, config: ExpertConfig) -> ilqr.Solution:
    """The best of the solutions from each of the system's own first plans."""
    starts = system.initial_plans(state, config.horizon)
    iterations = config.initial_iterations
    if len(starts) == 1:
        return ilqr.solve(system, state, starts[0], iterations)
    # One after another, for the reason given at the line search of `ilqr`.
    solutions = jax.lax.map(lambda start: ilqr.solve(system, state, start, iterations), starts)
    best = jnp.nanargmin(solutions.cost)
    return jax.tree.map(lambda leaf: leaf[best], solutions)


def _better(one: ilqr.Solution, other: ilqr.Solution) -> ilqr.Solution:
    """The cheaper of two; a cost that is not finite is none."""
    take = (other.cost < one.cost) | ~jnp.isfinite(one.cost)
    return jax.tree.map(lambda a, b: jnp.where(take, b, a), one, other)


def _converged(solution: ilqr.Solution, config: ExpertConfig) -> Array:
    return solution.promise <= config.tolerance * jnp.maximum(solution.cost, config.least_cost)


def _states(
    system: System,
    states: ArrayLike,
    name: str = "initial_states",
    axes: tuple[str, ...] = ("N",),
) -> Array:
    """[*axes, S] as floats, or ValueError."""
    checks.instance("system", system, System)
    size = len(system.state_names)
    form, shape = f"[{', '.join(axes)}, {size}]", (*[None] * len(axes), size)
    states = checks.array(name, states, form, shape, finite=True)
    return jnp.asarray(states, dtype=float)
