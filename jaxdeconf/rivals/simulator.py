"""What only who owns the system can do: ask its expert anew, shake it, let a policy drive.

All of it can be traced, and has the shapes of the demonstrations: what goes out of bounds stands
still to the end, without a weight. Shapes: N episodes, T steps, R rollouts, S state, A action,
H × W pixels.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf import evaluate
from jaxdeconf.collect import draw
from jaxdeconf.demos import Demos
from jaxdeconf.expert import ExpertConfig, receding_horizon, relabel
from jaxdeconf.learn.clone import Policy
from jaxdeconf.systems import System, Trajectories
from jaxdeconf.systems.rollout import redrawn, rollout

# (parameters, memory, frame uint8 [H, W, 3]) -> (memory, action over the limit [A]); a module's
# function, so that it compiles once.
Act = Callable[[Any, Any, Array], tuple[Any, Array]]

_EVERY = slice(None)
# Improvements of a plan where another than the expert led to the state. Of CartPole's states under
# strong noise (sigma 0.3), 54 % of labels are off by over 2 % of the limit after 5 improvements of
# the last plan alone, and 8 % where each step also starts anew.
_STEP_ITERATIONS = 5


@dataclass(frozen=True)
class Simulator:
    """A system, its expert, and the trajectories of it that are cloned."""

    system: System
    expert: ExpertConfig
    trajectories: Trajectories  # [N, T] of the expert

    @property
    def attentive(self) -> ExpertConfig:
        """The expert where its plan is disturbed: it thinks longer, and anew at each step."""
        iterations = max(_STEP_ITERATIONS, self.expert.step_iterations)
        return replace(self.expert, step_iterations=iterations, restart=True)

    def label(self, states: Array) -> Array:
        """[N, T, A] what the expert would do, over the limit, in each of the states [N, T, S]."""
        return relabel(self.system, states, self.attentive) / self.system.limits

    def labelled(self, trajectories: Trajectories) -> Demos:
        """Trajectories [N, T] of whoever moves, with what the expert would have done.

        Steps out of bounds weigh 0, and have the action 0.
        """
        limits, within = self.system.limits, jnp.asarray(trajectories.valid)
        return Demos(
            images=draw(self.system, trajectories),
            actions=jnp.where(within[..., None], self.label(trajectories.states), 0.0),
            initial_states=trajectories.states[:, 0],
            previous_actions=trajectories.previous_actions / limits,
            weights=within.astype(float),
            state_names=self.system.state_names,
            action_names=self.system.action_names,
        )

    def shaken(self, sigma: Array | float, key: Array, steps: int, rows: slice = _EVERY) -> Demos:
        """The expert with noise on what it executes; the labels are what it intended.

        The executed action moves the system, and the nuisance shows it.

        Args:
          sigma: standard deviation of the noise over the limit; the sum is clipped to the limit.
          key: of the noise, and of the random actions before the first.
          steps: T of each trajectory.
          rows: which of the demonstrations it starts as.
        """
        starts = self.trajectories.states[rows, 0]
        short = replace(self.system, steps=steps)
        return self.labelled(_shaken(short, self.attentive, starts, sigma, key))

    def driven(self, policy: Policy, key: Array, steps: int, rows: slice = _EVERY) -> Trajectories:
        """What a policy does in the first steps from the starts of some of the demonstrations."""
        starts = self.trajectories.states[rows, 0]
        return evaluate.drive(replace(self.system, steps=steps), policy, starts, key)

    def seen(
        self, act: Act, parameters: Any, memories: Any, rows: Array, key: Array
    ) -> Trajectories:
        """Whole trajectories of what is no `Policy`.

        Args:
          act: what to do at a frame.
          parameters: of it, a pytree.
          memories: a pytree [R, ...], what each rollout remembers at first.
          rows: [R] which of the demonstrations each starts as.
          key: of the random actions before the first.
        """
        starts = jnp.asarray(self.trajectories.states)[rows, 0]
        return _seen(self.system, act, parameters, memories, starts, key)

    def cost(self, trajectories: Trajectories) -> Array:
        """[R] mean stage cost of each trajectory: minus its return, a step."""
        return evaluate.rollout_loss(self.system, trajectories)

    def redrawn(self, key: Array, steps: int) -> Array:
        """uint8 [N, T, H, W, 3] the demonstrations' frames; what the nuisance shows is random."""
        first = jax.tree.map(lambda a: jnp.asarray(a)[:, :steps], self.trajectories)
        return draw(self.system, redrawn(self.system, first, key))


@partial(jax.jit, static_argnames=("system", "expert"))
def _shaken(
    system: System, expert: ExpertConfig, starts: Array, sigma: Array | float, key: Array
) -> Trajectories:
    initial_memory, policy = receding_horizon(system, expert)

    def shaking(memory: Any, state: Array, signal: Array, key: Array) -> tuple[Any, Array]:
        memory, intended = policy(memory, state, signal, key)
        noise = sigma * system.limits * jax.random.normal(key, intended.shape)
        return memory, intended + noise

    def one(start: Array, key: Array) -> Trajectories:
        return rollout(system, shaking, initial_memory(start), start, key)

    return jax.vmap(one)(starts, jax.random.split(key, len(starts)))


@partial(jax.jit, static_argnames=("system", "act"))
def _seen(
    system: System, act: Act, parameters: Any, memories: Any, starts: Array, key: Array
) -> Trajectories:
    def policy(memory: Any, state: Array, signal: Array, _: Array) -> tuple[Any, Array]:
        memory, action = act(parameters, memory, system.frame(state, signal))
        return memory, action * system.limits

    def one(memory: Any, start: Array, key: Array) -> Trajectories:
        return rollout(system, policy, memory, start, key)

    return jax.vmap(one)(memories, starts, jax.random.split(key, len(starts)))
