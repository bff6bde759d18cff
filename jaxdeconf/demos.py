"""Demonstrations, whoever made them: a simulator of ours, one of the user's, or a file.

Shapes: N episodes, T steps, H × W pixels, A action, S state. The paper's t=1 is index 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer

from jaxdeconf import checks


class Exploration(NamedTuple):
    """Frames under a random policy, what it did before each, and what the nuisance shows."""

    images: Any  # uint8 [n, H, W, 3]
    previous_actions: Any  # [n, A] over the limit
    signals: Any = None  # [n, A] what the nuisance shows, over the limit, if that is known


@dataclass(frozen=True, eq=False)
class Demos:
    """An expert's episodes. Frame t is what it saw when it chose action t.

    Episodes that differ in length are padded to the longest with anything, and `valid` says where.

    Raises:
      ValueError: if an array has another type or shape than the others say, or is not finite.
    """

    images: Any  # uint8 [N, T, H, W, 3]
    actions: Any  # [N, T, A] over their limit, in [-1, 1]
    initial_states: Any  # [N, S] what the system was set to, at random
    valid: Any = None  # bool [N, T], True up to an episode's end; None: all are of length T
    previous_actions: Any = None  # [N, T, A] over their limit, what each frame's past did; optional
    weights: Any = None  # [N, T] >= 0, of each step in the loss; None: all alike
    state_names: Sequence[str] = ()  # [S]
    action_names: Sequence[str] = ()  # [A]

    def __post_init__(self):
        images = self._array("images", "[N, T, H, W, 3]", (None,) * 4 + (3,), "uint8")
        count, steps = images.shape[:2]
        states = self._array("initial_states", f"[{count}, S]", (count, None), finite=True)
        within = np.ones((count, steps), bool)
        if self.valid is not None:
            within = np.asarray(self._array("valid", str(list(within.shape)), within.shape, "bool"))
            broken = ~within[:, 0] | (within[:, 1:] > within[:, :-1]).any(axis=1)
            if broken.any():
                words = "expected True up to an episode's end, then False, got otherwise"
                raise ValueError(f"valid: {words} in episode {int(broken.argmax())}")
        actions = self._array("actions", f"[{count}, {steps}, A]", (count, steps, None))
        _require_finite("actions", actions, within)
        if self.previous_actions is not None:
            shape = actions.shape
            previous = self._array("previous_actions", str(list(shape)), shape)
            _require_finite("previous_actions", previous, within)
        if self.weights is not None:
            weights = self._array("weights", str(list(within.shape)), within.shape)
            _require_finite("weights", weights[..., None], within)
        for name, size in (("state_names", states.shape[1]), ("action_names", actions.shape[2])):
            if len(getattr(self, name)):
                checks.same_length(name, len(getattr(self, name)), size, "names")

    def _array(self, name: str, *wanted: Any, **options: Any) -> Any:
        """A field as the array that it is, from here on."""
        value = checks.array(name, getattr(self, name), *wanted, **options)
        object.__setattr__(self, name, value)
        return value

    @property
    def lengths(self) -> np.ndarray:
        """[N] steps of each episode."""
        count, steps = np.shape(self.actions)[:2]
        return np.full(count, steps) if self.valid is None else np.asarray(self.valid).sum(axis=1)


def _require_finite(name: str, values: Any, within: np.ndarray) -> None:
    if not isinstance(values, Tracer):  # where only shapes are asked for
        checks.finite_numbers(name, np.where(within[..., None], values, 0))
