"""What the nuisance shows of the actions so far; the paper's is the previous action.

The others are ours. A method that is told the previous action is not told what these show, so they
tell apart what was found from what was known. Shapes: M things remembered, A action.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

_KEPT = 0.7  # of what a filtered signal showed before; ours


@dataclass(frozen=True)
class Signal:
    """A memory [M, A] in the action's units, whose first entry is shown.

    At t=0 its entries are independent uniform random actions, and the last of them counts as the
    previous action.
    """

    name: str
    size: int  # M
    follow: Callable[[Array, Array], Array]  # (memory [M, A], the action taken [A]) -> next memory


def _shifted(memory: Array, action: Array) -> Array:
    return jnp.concatenate([memory[1:], action[None]])


def _filtered(memory: Array, action: Array) -> Array:
    """A mean of actions, the more recent the heavier, so within the limits as they are."""
    return _KEPT * memory + (1.0 - _KEPT) * action


PREVIOUS_ACTION = Signal("previous_action", 1, _shifted)
SIGNALS = {
    signal.name: signal
    for signal in (
        PREVIOUS_ACTION,
        Signal("two_steps_ago", 2, _shifted),
        Signal("filtered", 1, _filtered),
    )
}
