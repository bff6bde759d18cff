"""Any System as a Brax environment (Freeman et al. 2021), so that Brax's trainers run on it.

An edge: nothing in the package imports it, because Brax takes seconds to import. Importing it
registers every system that `systems.names` lists as `deconf_<name>`. Shapes: S state, A action,
H × W pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from brax import envs
from brax.envs import base
from flax import struct
from jax import Array

from jaxdeconf import checks, systems
from jaxdeconf.systems.rollout import first_memory
from jaxdeconf.systems.system import System
from jaxdeconf.vision import raster

# Brax's vision networks and its PPO take as an image what is under a key that starts so.
PIXELS = "pixels/view_0"


class Moment(struct.PyTreeNode):
    """A Brax `pipeline_state`: all that the next step and the next frame depend on."""

    state: Array  # [S], the System's units
    previous_action: Array  # [A], the System's units
    past: Array  # [M, A], what the nuisance's signal remembers; it shows the first


def _state_of(system: System, moment: Moment) -> Array:
    return moment.state


def _pixels_of(system: System, moment: Moment) -> dict[str, Array]:
    # Through uint8, so that a policy sees here what one cloned from stored frames saw there.
    return {PIXELS: raster.dequantize(system.frame(moment.state, moment.past[0]))}


def _both_of(system: System, moment: Moment) -> dict[str, Array]:
    return {"state": moment.state, **_pixels_of(system, moment)}


OBSERVATIONS: dict[str, Callable[[System, Moment], Any]] = {
    "state": _state_of,
    "pixels": _pixels_of,
    "pixels_state": _both_of,
}


class SystemEnv(envs.Env):
    """One System as a Brax environment: one sample, as Brax's wrappers expect.

    It moves as `systems.rollout` does: the previous action before the first step is random, actions
    are clipped to the limits, and out of bounds state and action stand still. Time limits are the
    wrapper's: hand `episode_length` to `brax.envs.training.wrap`, or to the trainer.
    """

    def __init__(
        self,
        system: System,
        observation: str = "state",
        terminate: bool = True,
        backend: str | None = None,
    ):
        """Chooses what is seen and what a fall does.

        Args:
          system: what moves.
          observation: "state" [S]; "pixels", a dict of the frame with its nuisance, float32
            [H, W, 3] in [0, 1], under `PIXELS`; "pixels_state", that and the state under "state".
          terminate: whether leaving the bounds ends the episode. Costs are positive, so an agent
            may gain by falling early. False charges the cost of the fall until the time is up: a
            whole episode's reward is then minus `steps` times `evaluate.rollout_loss`.
          backend: Brax's trainers name a physics engine; the System has equations of its own.
        Raises:
          ValueError: if there is no such observation.
        """
        checks.one_of("observation", observation, tuple(OBSERVATIONS))
        self.system = system
        self._observe = partial(OBSERVATIONS[observation], system)
        self._terminate = terminate

    def reset(self, rng: Array) -> envs.State:
        """An initial state and a random previous action, both drawn from rng.

        Args:
          rng: a raw key (`jax.random.PRNGKey`, what Brax's wrappers need) or a typed one.
        """
        state_key, action_key = jax.random.split(rng)
        start = self.system.sample_initial(state_key)
        past = first_memory(self.system, action_key)
        moment = Moment(start, past[-1], past)
        zero = jnp.zeros((), moment.state.dtype)
        metrics = {"in_bounds": zero, "stage_cost_per_step": zero}
        return envs.State(cast(Any, moment), self._observe(moment), zero, zero, metrics)

    def step(self, state: envs.State, action: Array) -> envs.State:
        """One step of the System; the reward is minus its stage cost.

        Metrics: `in_bounds` is 1 while the step starts in bounds; `stage_cost_per_step` is minus
        the reward, and Brax's evaluator averages it over the episode, as its name asks for.

        Args:
          state: what `reset` or `step` returned.
          action: [A] in [-1, 1], clipped to that; times the limits is the System's action.
        Raises:
          ValueError: if the action has another size.
        """
        action = checks.array("action", action, f"[{self.action_size}]", (self.action_size,))
        moment, system = cast(Moment, state.pipeline_state), self.system
        inside = system.in_bounds(moment.state)
        scaled = jnp.clip(action, -1.0, 1.0) * system.limits
        taken = jnp.where(inside, scaled, moment.previous_action)
        following = jnp.where(inside, system.step(moment.state, taken), moment.state)
        past = jnp.where(inside, system.signal.follow(moment.past, taken), moment.past)
        after = Moment(following, taken, past)
        cost = system.stage_cost(moment.state, taken)
        fallen = jnp.logical_not(system.in_bounds(following)) & self._terminate
        metrics = {"in_bounds": inside.astype(cost.dtype), "stage_cost_per_step": cost}
        return replace(
            state,
            pipeline_state=cast(Any, after),
            obs=self._observe(after),
            reward=-cost,
            done=fallen.astype(cost.dtype),
            metrics=state.metrics | metrics,  # a wrapper may have added its own
        )

    @property
    def observation_size(self) -> base.ObservationSize:
        """S, or a dict of S and of the image's shape: Brax's convention."""
        observed = jax.eval_shape(self.reset, jax.random.PRNGKey(0)).obs
        if not isinstance(observed, dict):
            return observed.shape[-1]
        return {k: v.shape if v.ndim > 1 else v.shape[-1] for k, v in observed.items()}

    @property
    def action_size(self) -> int:
        """A."""
        return len(self.system.action_limit)

    @property
    def backend(self) -> str:
        """Not one of Brax's physics backends: the System's own equations."""
        return "jaxdeconf"

    @property
    def dt(self) -> float:
        """Seconds a step."""
        return self.system.dt

    @property
    def episode_length(self) -> int:
        """Steps of a whole trajectory, for wrappers and trainers."""
        return self.system.steps

    def render(
        self,
        trajectory: Sequence[Moment],
        height: int | None = None,
        width: int | None = None,
        camera: str | None = None,
    ) -> list[np.ndarray]:
        """uint8 [H, W, 3] frames of a list of pipeline states, with the nuisance.

        Args:
          trajectory: the states.
          height: H; None is the System's own.
          width: W, likewise.
          camera: as Brax's environments have it; the System has one view.
        """
        own = self.system.size
        frame = jax.jit(replace(self.system, size=(height or own[0], width or own[1])).frame)
        return [np.asarray(frame(moment.state, moment.past[0])) for moment in trajectory]


for _name in systems.names():
    # Brax only ever calls what is registered with keyword arguments, so a partial does.
    envs.register_environment(f"deconf_{_name}", cast(Any, partial(SystemEnv, systems.get(_name))))
