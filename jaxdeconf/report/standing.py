"""How a method stands in a comparison. Shapes: K seeds."""

from typing import NamedTuple

import numpy as np

from jaxdeconf.pipeline.results import Judged


class Standing(NamedTuple):
    """A method over the seeds."""

    method: str
    seeds: list[int]  # [K]
    judged: list[Judged]  # [K]
    experts: np.ndarray  # [K] the expert's rollout loss
    seconds: np.ndarray  # [K] of training

    @property
    def losses(self) -> np.ndarray:
        """[K] mean rollout losses."""
        return np.array([one.rollout_loss.mean for one in self.judged])

    def mean(self, name: str) -> float:
        """Of a number of the policies, over the seeds."""
        return float(np.mean([getattr(one, name) for one in self.judged]))
