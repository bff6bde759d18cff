"""Scan a policy through a System.

Shapes: N trajectories, T time, S state, A action, M things that the nuisance's signal remembers,
H × W pixels. The paper's t=1 is index 0.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf.systems.system import System

# (memory, state [S], signal [A], key) -> (memory, action [A]); of state and signal a frame is drawn
Policy = Callable[[Any, Array, Array, Array], tuple[Any, Array]]


class Trajectories(NamedTuple):
    """Trajectories of equal length; what lies past the end of one is marked, not cut.

    From the first state out of bounds on, `valid` is False; state, action and signal stand still.
    """

    states: Array  # [N, T, S]
    actions: Array  # [N, T, A] taken in that state
    previous_actions: Array  # [N, T, A] taken before; at t=0 a uniform random action
    valid: Array  # [N, T] bool
    signals: Array  # [N, T, A] what the nuisance shows: see `System.signal`


def sample_action(system: System, key: Array) -> Array:
    """[A] uniform within the action limits."""
    return jax.random.uniform(key, system.limits.shape, minval=-1.0, maxval=1.0) * system.limits


def first_memory(system: System, key: Array) -> Array:
    """[M, A] what the signal remembers at t=0: independent random actions, the latest last."""
    earlier = [jax.random.fold_in(key, back) for back in reversed(range(1, system.signal.size))]
    return jnp.stack([sample_action(system, one) for one in [*earlier, key]])


def rollout(system: System, policy: Policy, memory: Any, state: Array, key: Array) -> Trajectories:
    """One trajectory of `system.steps` steps under a policy.

    Args:
      system: what moves.
      policy: (memory, state [S], signal [A], key) -> (memory, action [A]); the action is clipped to
        the limits.
      memory: the policy's memory at the start, any pytree.
      state: [S] the initial state.
      key: draws the random actions before the first step and the policy's own randomness.
    Returns:
      Trajectories without the leading axis N.
    """
    return rollout_with_memory(system, policy, memory, state, key)[0]


def rollout_with_memory(
    system: System, policy: Policy, memory: Any, state: Array, key: Array
) -> tuple[Trajectories, Any]:
    """`rollout`, and the policy's memory at the end (what it has counted, say)."""
    first_key, policy_key = jax.random.split(key)

    def advance(carry: tuple, step_key: Array) -> tuple[tuple, Trajectories]:
        memory, state, previous_action, past, alive = carry
        alive = alive & system.in_bounds(state)
        memory, action = policy(memory, state, past[0], step_key)
        action = jnp.where(alive, jnp.clip(action, -system.limits, system.limits), previous_action)
        record = Trajectories(state, action, previous_action, alive, past[0])
        next_state = jnp.where(alive, system.step(state, action), state)
        past = jnp.where(alive, system.signal.follow(past, action), past)
        return (memory, next_state, action, past, alive), record

    past = first_memory(system, first_key)
    start = (memory, state, past[-1], past, jnp.array(True))
    keys = jax.random.split(policy_key, system.steps)
    (memory, *_), trajectory = jax.lax.scan(advance, start, keys)
    return trajectory, memory


@partial(jax.jit, static_argnums=(0, 2))
def random_trajectories(system: System, key: Array, count: int) -> Trajectories:
    """N = count trajectories of uniform random actions from random initial states."""

    def policy(memory: None, state: Array, signal: Array, key: Array):
        return memory, sample_action(system, key)

    def one(key: Array) -> Trajectories:
        state_key, rollout_key = jax.random.split(key)
        start = system.sample_initial(state_key)
        return rollout_with_memory(system, policy, None, start, rollout_key)[0]

    return jax.vmap(one)(jax.random.split(key, count))


@partial(jax.jit, static_argnames="system")
def frames(system: System, trajectories: Trajectories) -> Array:
    """uint8 [..., H, W, 3]: the frame of every state in trajectories of any leading shape."""
    draw = system.frame
    for _ in range(trajectories.states.ndim - 1):
        draw = jax.vmap(draw)
    return draw(trajectories.states, trajectories.signals)


def redrawn(system: System, trajectories: Trajectories, key: Array) -> Trajectories:
    """Trajectories [N, T] whose nuisance shows independent uniform random actions instead."""
    keys = jax.random.split(key, trajectories.valid.shape)
    signals = jax.vmap(jax.vmap(partial(sample_action, system)))(keys)
    return trajectories._replace(signals=signals)
