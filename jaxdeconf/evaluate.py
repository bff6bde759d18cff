"""Closed-loop evaluation: let a cloned policy drive, and score what it does.

Shapes: R rollouts, T time, S state, A action, n samples.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import checks
from jaxdeconf.learn.clone import Policy, blank
from jaxdeconf.learn.fit import Training
from jaxdeconf.systems.rollout import Trajectories, frames, redrawn, rollout
from jaxdeconf.systems.system import System
from jaxdeconf.traced import traceable

# Rollouts that one program drives: judging while a policy is trained then shares it with judging at
# the end. More at once are no faster on a CPU.
_AT_ONCE = 25


@traceable
@dataclass(frozen=True)
class EvaluateConfig:
    """For how many rollouts a policy drives, and how often while it is trained."""

    # Of a trained policy. Ours: a fall costs a CartPole sixty, so the paper's 25 say little.
    rollouts: int = 100
    training_rollouts: int = 25  # of one in training, the first of those; the paper's
    every: float = 10.0  # epochs between evaluations; the paper's

    def __post_init__(self):
        checks.integer("rollouts", self.rollouts)
        checks.integer("training_rollouts", self.training_rollouts)
        checks.positive("every", self.every)

    def steps(self, per_epoch: int, total: int) -> tuple[int, ...]:
        """The training steps after which a policy drives; the last one is always among them."""
        between = max(1.0, self.every * per_epoch)
        return (*(round(between * i) for i in range(1, math.ceil((total - 0.5) / between))), total)

    def visits(self, training: Training) -> tuple[int, ...]:
        """The same of a training."""
        config, samples = training.config, training.samples
        return self.steps(config.steps_per_epoch(samples), config.total_steps(samples))


def drive(system: System, policy: Policy, initial_states: Array, key: Array) -> Trajectories:
    """Closed-loop rollouts of a cloned policy from initial_states [R, S].

    Frames from before the first are blank. Frames go through uint8 before and after the view, as
    those of the demonstrations did.

    Raises:
      ValueError: if the policy is none, or a state has another size or is not finite.
    """
    checks.instance("system", system, System)
    checks.instance("policy", policy, Policy)
    size = len(system.state_names)
    checks.array("initial_states", initial_states, f"[R, {size}]", (None, size), finite=True)
    checks.key("key", key)
    keys = jax.random.split(key, len(initial_states))
    parts = [slice(i, i + _AT_ONCE) for i in range(0, max(1, len(keys)), _AT_ONCE)]
    driven = [_drive(system, policy, initial_states[part], keys[part]) for part in parts]
    return jax.tree.map(lambda *trees: jnp.concatenate(trees), *driven)


@partial(jax.jit, static_argnames="system")
def _drive(system: System, policy: Policy, initial_states: Array, keys: Array) -> Trajectories:
    def act(memory: list[Array], state: Array, signal: Array, _: Array):
        seen = [*memory, policy.see(system.frame(state, signal)[None])]
        return seen[1:], policy.act(seen)[0] * system.limits

    def one(state: Array, key: Array) -> Trajectories:
        before = blank(system.frame(state, jnp.zeros_like(system.limits))[None])
        return rollout(system, act, [before] * (policy.frames - 1), state, key)

    return jax.vmap(one)(initial_states, keys)


def rollout_loss(system: System, trajectories: Trajectories) -> Array:
    """[R] mean stage cost over the steps of each trajectory.

    A trajectory that went out of bounds stands still from there on, so it is charged the cost of
    that moment for the rest of its time.
    """
    _check(system, trajectories)
    return _rollout_loss(system, trajectories)


@partial(jax.jit, static_argnames="system")
def _rollout_loss(system: System, trajectories: Trajectories) -> Array:
    cost = jax.vmap(jax.vmap(system.stage_cost))
    return cost(trajectories.states, trajectories.actions).mean(axis=1)


def outcome(system: System, trajectories: Trajectories) -> Array:
    """[R] what each trajectory came to, in the system's own terms: 1 for survival, say."""
    _check(system, trajectories)
    return jax.vmap(system.outcome.of)(trajectories.states, trajectories.valid)


def in_turns(trajectories: Trajectories, steps: int = 25) -> Trajectories:
    """[R, steps] of trajectories [R, T]: of each another part, so that all starts and times are in.

    What is asked of frames costs as much as training: a part of them says nearly as much.
    """
    rollouts, most = trajectories.valid.shape
    length = min(steps, most)
    begin = np.arange(rollouts) * length % (most - length + 1)
    rows, columns = np.arange(rollouts)[:, None], begin[:, None] + np.arange(length)
    return jax.tree.map(lambda a: a[rows, columns], trajectories)


def copycat(system: System, policy: Policy, trajectories: Trajectories, key: Array) -> Array:
    """How far a policy's action moves when only the nuisance is redrawn.

    In every L successive frames of trajectories [R, T], the action that the nuisance shows is
    replaced by a uniform random one, everything else kept.

    Returns:
      [] mean absolute change over the action's limit, in [0, 2]: 0 is a policy that does not look.
    Raises:
      ValueError: if the trajectories are none, or shorter than L.
    """
    _check(system, trajectories, policy)
    checks.key("key", key)
    return _copycat(system, policy, trajectories, key)


@partial(jax.jit, static_argnames="system")
def _copycat(system: System, policy: Policy, trajectories: Trajectories, key: Array) -> Array:
    other = redrawn(system, trajectories, key)
    # All in one loop, so that the network is compiled once.
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), trajectories, other)
    before, after = jnp.split(_answers(system, policy, both), 2)
    changes = jax.lax.map(lambda pair: jnp.abs(pair[0] - pair[1]).mean(), (before, after))
    return changes.mean()


class Saliency(NamedTuple):
    """Where a policy looks, in the frames that the camera gives."""

    slope: Array  # [] how its action follows the action that the nuisance shows
    pixels: Array  # [R, T - L + 1, H, W] how it follows each pixel of the present frame


def saliency(system: System, policy: Policy, trajectories: Trajectories) -> Saliency:
    """The derivatives of a policy's action (Simonyan et al. 2013), through network and view.

    They are taken at every step of trajectories [R, T] that has L frames, from the present frame:
    of its pixels, absolute values summed over colours in [0, 1] and over the action's components;
    and, on through the drawing of the frame, of the action that the nuisance shows.

    Returns:
      Of actions over their limit. The slope is a mean over steps and over the action's components,
      each by its own, over the limit: 0 is a policy that does not look, 1 one that repeats what it
      is shown.
    Raises:
      ValueError: if the trajectories are none, or shorter than L.
    """
    _check(system, trajectories, policy)
    return _saliency(system, policy, trajectories)


@partial(jax.jit, static_argnames="system")
def _saliency(system: System, policy: Policy, trajectories: Trajectories) -> Saliency:
    last = policy.frames - 1

    def one(followed: Trajectories) -> tuple[Array, Array]:
        def drawn(signals: Array) -> Array:
            return jax.vmap(system.render)(followed.states, signals * system.limits)

        images, redraw = jax.vjp(drawn, followed.signals / system.limits)
        before = _successive(policy.view(policy.parameters, images), last)[:-1]

        def act(present: Array) -> Array:
            seen = policy.view(policy.parameters, present)
            return policy.decide(jnp.concatenate([*before, seen], axis=-1))

        # In reverse: our convolutions know no other way.
        actions, look = jax.vjp(act, images[last:])
        of_each = jnp.broadcast_to(
            jnp.eye(actions.shape[1])[:, None], (actions.shape[1], *actions.shape)
        )
        (pixels,) = jax.lax.map(look, of_each)  # [A, n, H, W, 3]
        (signals,) = jax.lax.map(lambda p: redraw(jnp.zeros_like(images).at[last:].set(p)), pixels)
        own = jnp.diagonal(signals[:, last:], axis1=0, axis2=2)
        return own.mean(), jnp.abs(pixels).sum(axis=(0, -1))

    slopes, pixels = jax.lax.map(one, trajectories)
    return Saliency(slopes.mean(), pixels)


def answers(system: System, policy: Policy, trajectories: Trajectories) -> Array:
    """[R, T - L + 1, A] what a policy would do at steps of others' trajectories, over the limit.

    Raises:
      ValueError: if the trajectories are none, or shorter than L.
    """
    _check(system, trajectories, policy)
    return _answers(system, policy, trajectories)


@partial(jax.jit, static_argnames="system")
def _answers(system: System, policy: Policy, trajectories: Trajectories) -> Array:
    def actions(one: Trajectories) -> Array:
        return policy.act(_successive(policy.see(frames(system, one)), policy.frames - 1))

    return jax.lax.map(actions, trajectories)


def _successive(seen: Array, last: int) -> list[Array]:
    """The frames [T, H, W, 3] that come first, second, ... and last of every `last` + 1 of them."""
    return [seen[i : len(seen) - last + i] for i in range(last + 1)]


def _check(system: System, trajectories: Trajectories, policy: Policy | None = None) -> None:
    checks.instance("system", system, System)
    checks.instance("trajectories", trajectories, Trajectories)
    steps = 1
    if policy is not None:
        checks.instance("policy", policy, Policy)
        steps = policy.frames
    valid = checks.array("valid", trajectories.valid, "[R, T]", (None, None), of="bool")
    if valid.shape[1] < steps:
        raise ValueError(f"trajectories: expected at least {steps} steps, got {valid.shape[1]}")
