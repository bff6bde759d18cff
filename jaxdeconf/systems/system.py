"""What every stage knows of a physical system, and nothing more.

Shapes: S state, A action, K plan, H × W pixels. All functions take one sample; the caller vmaps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.systems.signal import PREVIOUS_ACTION, Signal
from jaxdeconf.vision import raster


class Nuisance(Protocol):
    """A mark in the frame that shows a signal of past actions; see `vision.nuisance`."""

    def draw(self, image: Array, signal: Array) -> Array:
        """Image [H, W, 3] with the mark for signal [A] in [-1, 1]."""
        ...

    def cover(self, image: Array) -> Array:
        """Image [H, W, 3] with the mark covered in white."""
        ...


class Outcome(NamedTuple):
    """What a rollout comes to, beside its cost."""

    name: str  # the head of a column
    form: str  # of its mean, a format specification
    note: str  # a sentence on what it is
    of: Callable[[Array, Array], Array]  # (states [T, S], valid [T]) -> [] float


def _survives(states: Array, valid: Array) -> Array:
    return valid[-1].astype(float)


# Of a system that can fall.
SURVIVAL = Outcome(
    "survival", ".0%", "Survival: share of rollouts in bounds to the end.", _survives
)


@dataclass(frozen=True)
class System:
    """A controlled system in discrete time: pure functions and the constants that describe them.

    Frozen and hashable, so that a System is a static argument of a jitted function. For frames of
    another size: `dataclasses.replace(system, size=(96, 128))`.

    Raises:
      ValueError: if `size` is not two positive integers.
    """

    name: str
    state_names: tuple[str, ...]  # [S], with units
    action_names: tuple[str, ...]  # [A], with units
    action_limit: tuple[float, ...]  # [A], |action| <= limit
    dt: float  # seconds a step
    steps: int  # steps of a whole trajectory
    step: Callable[[Array, Array], Array]  # (state [S], action [A]) -> next state [S]
    stage_cost: Callable[[Array, Array], Array]  # (state [S], action [A]) -> [], the rollout loss
    state_penalty: Callable[[Array], Array]  # state [S] -> [], the expert's soft limits
    terminal_cost: Callable[[Array], Array]  # state [S] -> [], ends the expert's horizon
    initial_plans: Callable[[Array, int], Array]  # (state [S], K) -> [starts, K, A], expert starts
    sample_initial: Callable[[Array], Array]  # key -> state [S]: the intervention on S_1
    in_bounds: Callable[[Array], Array]  # state [S] -> bool [], False ends a trajectory
    # (state [S], (H, W)) -> image [H, W, 3] in [0, 1], no nuisance
    draw: Callable[[Array, tuple[int, int]], Array]
    nuisance: Nuisance
    signal: Signal = PREVIOUS_ACTION  # what the nuisance shows; the paper's
    outcome: Outcome = SURVIVAL
    size: tuple[int, int] = (64, 64)  # H, W of its frames; the paper's

    def __post_init__(self):
        checks.size("size", self.size)

    @property
    def limits(self) -> Array:
        """[A] action limits as an array."""
        return jnp.asarray(self.action_limit)

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """(H, W, 3)."""
        return (*self.size, 3)

    def render(self, state: Array, signal: Array) -> Array:
        """The frame [H, W, 3] in [0, 1] of state [S] with a nuisance that shows an action [A]."""
        return self.nuisance.draw(self.draw(state, self.size), signal / self.limits)

    def frame(self, state: Array, signal: Array) -> Array:
        """The frame as a camera hands it over: uint8 [H, W, 3]."""
        return raster.quantize(self.render(state, signal))
