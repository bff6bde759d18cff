"""A simulator's data: an expert's demonstrations and a random policy's frames, from initial states
set at random (paper, Section III-C, step 1).

Shapes: N trajectories, T time, n frames, H × W pixels, A action.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import jax
from jax import Array

from jaxdeconf import checks
from jaxdeconf.demos import Demos, Exploration
from jaxdeconf.expert import ExpertConfig, expert_trajectories
from jaxdeconf.keys import named
from jaxdeconf.systems import System, Trajectories, random_trajectories
from jaxdeconf.systems.rollout import frames
from jaxdeconf.systems.signal import SIGNALS
from jaxdeconf.traced import traceable


@traceable
@dataclass(frozen=True)
class CollectConfig:
    """How many trajectories are collected, and how they look. Ours: the paper's are a system's."""

    random_trajectories: int = 1000  # random-policy ones, for the β-VAE
    expert_trajectories: int = 1000  # for the mask and for cloning
    held_out_trajectories: int = 500  # random-policy ones that judge latents and leakage
    # Steps of each random-policy trajectory that are used, from the first; None is all, the
    # paper's. More trajectories of fewer steps show more initial states.
    random_steps: int | None = None
    size: tuple[int, int] | None = None  # H, W of the frames; None: the system's own
    # What the nuisance shows; the paper's is the previous action. See `systems.signal`.
    nuisance: Literal["previous_action", "two_steps_ago", "filtered"] = "previous_action"

    def __post_init__(self):
        for name in ("random_trajectories", "held_out_trajectories"):
            checks.integer(name, getattr(self, name))
        # Hoeffding's D is a mean over quintuples.
        checks.integer("expert_trajectories", self.expert_trajectories, least=5)
        if self.random_steps is not None:
            checks.integer("random_steps", self.random_steps)
        if self.size is not None:
            checks.size("size", self.size)
        checks.one_of("nuisance", self.nuisance, tuple(SIGNALS))


class Collected(NamedTuple):
    """All trajectories of a run."""

    random: Trajectories  # for the β-VAE
    held_out: Trajectories  # random-policy ones that nothing is trained on
    expert: Trajectories  # for the mask and for cloning
    evaluation: Trajectories  # the expert from the initial states on which clones are judged
    unconverged: Array  # [N] steps of `expert` whose plan had not converged


def collect(
    system: System, config: CollectConfig, expert: ExpertConfig, rollouts: int, key: Array
) -> Collected:
    """Random-policy and expert trajectories, from initial states set at random.

    Args:
      system: what moves.
      config: how many.
      expert: how the expert plans.
      rollouts: how many initial states to judge clones on.
      key: every random choice follows from it by name.
    """
    learned, imitated = config.random_trajectories, config.expert_trajectories
    # Each policy rolls out all its trajectories in one call: one shape, one compilation.
    random = random_trajectories(
        system, named(key, "random"), learned + config.held_out_trajectories
    )
    keys = jax.random.split(named(key, "expert initial states"), imitated + rollouts)
    states = jax.vmap(system.sample_initial)(keys)
    driven, unconverged = expert_trajectories(system, states, named(key, "expert"), expert)
    return _parted(random, driven, unconverged, learned, config.random_steps, imitated)


@partial(jax.jit, static_argnames=("learned", "steps", "imitated"))
def _parted(
    random: Trajectories,
    driven: Trajectories,
    unconverged: Array,
    learned: int,
    steps: int | None,
    imitated: int,
) -> Collected:
    return Collected(
        jax.tree.map(lambda a: a[:learned, :steps], random),
        jax.tree.map(lambda a: a[learned:, :steps], random),
        jax.tree.map(lambda a: a[:imitated], driven),
        jax.tree.map(lambda a: a[imitated:], driven),
        unconverged[:imitated],
    )


def exploration(system: System, trajectories: Trajectories) -> Exploration:
    """The frames of all valid steps of random-policy trajectories."""
    known = jax.device_get(trajectories)  # NumPy compiles nothing
    flat = jax.tree.map(lambda a: a[known.valid], known)
    past = flat.previous_actions / system.limits, flat.signals / system.limits
    return Exploration(frames(system, flat), *past)


def demonstrations(system: System, trajectories: Trajectories, steps: int | None = None) -> Demos:
    """The first steps of an expert's trajectories, drawn; None is all steps."""
    first = jax.tree.map(lambda a: a[:, :steps], jax.device_get(trajectories))
    return Demos(
        images=draw(system, first),
        actions=first.actions / system.limits,
        initial_states=first.states[:, 0],
        valid=None if first.valid.all() else first.valid,
        previous_actions=first.previous_actions / system.limits,
        state_names=system.state_names,
        action_names=system.action_names,
    )


@partial(jax.jit, static_argnames="system")
def draw(system: System, trajectories: Trajectories) -> Array:
    """uint8 [N, T, H, W, 3] the frames of trajectories, one of these at a time."""
    return jax.lax.map(partial(frames, system), trajectories)
