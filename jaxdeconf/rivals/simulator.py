"""What only who owns the system can do: ask its expert anew, shake it, let a policy drive.

Shapes: N episodes, T steps, S state, A action.
"""

from dataclasses import dataclass

from jax import Array

from jaxdeconf.expert import ExpertConfig, relabel
from jaxdeconf.systems import System, Trajectories


@dataclass(frozen=True)
class Simulator:
    """A system, its expert, and the trajectories of it that are cloned."""

    system: System
    expert: ExpertConfig
    trajectories: Trajectories  # [N, T] of the expert

    def label(self, states: Array) -> Array:
        """[N, T, A] what the expert would do, over the limit, in each of the states [N, T, S]."""
        return relabel(self.system, states, self.expert) / self.system.limits
