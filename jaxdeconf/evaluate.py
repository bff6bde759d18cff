"""Closed-loop evaluation: let a cloned policy drive, and score what it does.

Shapes: R rollouts, T time, S state, A action, n samples.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.learn import clone
from jaxdeconf.learn.fit import Variables
from jaxdeconf.learn.views import View
from jaxdeconf.nets.resnet import ResNetConfig
from jaxdeconf.systems.rollout import Trajectories, frames, rollout, sample_action
from jaxdeconf.systems.system import System


@dataclass(frozen=True)
class EvaluateConfig:
    """How often a policy drives while it is trained, and for how many rollouts."""

    rollouts: int = 25  # the paper's
    every: float = 10.0  # epochs between evaluations; the paper's

    def __post_init__(self):
        checks.integer("rollouts", self.rollouts)
        checks.positive("every", self.every)

    def steps(self, per_epoch: int, total: int) -> tuple[int, ...]:
        """The training steps after which a policy drives; the last one is always among them."""
        checks.integer("per_epoch", per_epoch)
        checks.integer("total", total)
        between = max(1.0, self.every * per_epoch)
        return (*(round(between * i) for i in range(1, math.ceil((total - 0.5) / between))), total)


class Driver(NamedTuple):
    """A policy as it drives: its network, and the view that it is shown. Static."""

    network: ResNetConfig
    view: View


class Weights(NamedTuple):
    """The numbers of a Driver."""

    policy: Variables
    view: Variables  # {} for a view without parameters


def drive(
    system: System, driver: Driver, weights: Weights, initial_states: Array, key: Array
) -> Trajectories:
    """Closed-loop rollouts of a cloned policy from initial_states [R, S].

    The frame before the first is blank. Frames go through uint8 before and after the view, as
    those of the demonstrations did.

    Raises:
      ValueError: if an argument has another type or shape, or a state is not finite.
    """
    checks.instance("system", system, System)
    checks.instance("driver", driver, Driver)
    checks.instance("weights", weights, Weights)
    size = len(system.state_names)
    checks.array("initial_states", initial_states, f"[R, {size}]", (None, size), finite=True)
    checks.key("key", key)
    return _drive(system, driver, weights, initial_states, key)


@partial(jax.jit, static_argnames=("system", "driver"))
def _drive(
    system: System, driver: Driver, weights: Weights, initial_states: Array, key: Array
) -> Trajectories:
    def policy(previous: Array, state: Array, previous_action: Array, _: Array):
        seen = driver.view(weights.view, system.frame(state, previous_action)[None])
        action = clone.act(driver.network, weights.policy, previous, seen)[0]
        return seen, action * system.limits

    def one(state: Array, key: Array) -> Trajectories:
        memory = clone.blank(system.frame(state, jnp.zeros_like(system.limits))[None])
        return rollout(system, policy, memory, state, key)

    return jax.vmap(one)(initial_states, jax.random.split(key, len(initial_states)))


def rollout_loss(system: System, trajectories: Trajectories) -> Array:
    """[R] mean stage cost over the steps of each trajectory.

    A trajectory that went out of bounds stands still from there on, so it is charged the cost of
    that moment for the rest of its time.
    """
    checks.instance("system", system, System)
    _check_trajectories(trajectories)
    cost = jax.vmap(jax.vmap(system.stage_cost))
    return cost(trajectories.states, trajectories.actions).mean(axis=1)


def outcome(system: System, trajectories: Trajectories) -> Array:
    """[R] what each trajectory came to, in the system's own terms: 1 for survival, say."""
    checks.instance("system", system, System)
    _check_trajectories(trajectories)
    return jax.vmap(system.outcome.of)(trajectories.states, trajectories.valid)


@partial(jax.jit, static_argnames=("system", "driver"))
def copycat(
    system: System, driver: Driver, weights: Weights, trajectories: Trajectories, key: Array
) -> Array:
    """How far a policy's action moves when only the nuisance is redrawn.

    In every pair of successive frames of trajectories [R, T], the action that the nuisance shows is
    replaced by a uniform random one, everything else kept.

    Returns:
      [] mean absolute change over the action's limit, in [0, 2]: 0 is a policy that does not look.
    """
    _check_trajectories(trajectories, steps=2)
    checks.key("key", key)
    redrawn_actions = jax.vmap(jax.vmap(partial(sample_action, system)))(
        jax.random.split(key, trajectories.valid.shape)
    )
    redrawn = trajectories._replace(previous_actions=redrawn_actions)

    def actions(one: Trajectories) -> Array:
        seen = driver.view(weights.view, frames(system, one))
        return clone.act(driver.network, weights.policy, seen[:-1], seen[1:])

    def change(pair: tuple[Trajectories, Trajectories]) -> Array:
        return jnp.abs(actions(pair[0]) - actions(pair[1])).mean()

    return jax.lax.map(change, (trajectories, redrawn)).mean()


def _check_trajectories(trajectories: Trajectories, steps: int = 1) -> None:
    checks.instance("trajectories", trajectories, Trajectories)
    valid = checks.array("valid", trajectories.valid, "[R, T]", (None, None), of="bool")
    if valid.shape[1] < steps:
        raise ValueError(f"trajectories: expected at least {steps} steps, got {valid.shape[1]}")
