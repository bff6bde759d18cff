"""How often each level of a colour was met in frames: all that LeRobot's statistics of one need."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

_QUANTILES = (1, 10, 50, 90, 99)


class Levels(NamedTuple):
    """Of a number of frames."""

    frames: int
    counts: np.ndarray  # [C, 256] pixels

    @classmethod
    def of(cls, frames: np.ndarray) -> "Levels":
        """Of uint8 [T, H, W, C]."""
        colours = frames.reshape(-1, frames.shape[-1]).T
        return cls(len(frames), np.stack([np.bincount(one, minlength=256) for one in colours]))

    @classmethod
    def together(cls, parts: "Iterable[Levels]") -> "Levels":
        """Of the frames of all."""
        frames, counts = zip(*parts, strict=True)
        return cls(sum(frames), np.sum(counts, axis=0))

    def statistics(self) -> dict[str, Any]:
        """LeRobot's, exactly: of each colour [C, 1, 1], in [0, 1]; the count is of frames."""
        level, share = np.arange(256) / 255.0, self.counts / self.counts.sum(axis=1, keepdims=True)
        mean, below, met = share @ level, share.cumsum(axis=1), self.counts > 0
        found = {
            "min": level[met.argmax(axis=1)],
            "max": level[255 - met[:, ::-1].argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(share @ level**2 - mean**2, 0.0)),
        }
        for percent in _QUANTILES:
            found[f"q{percent:02d}"] = level[(below >= percent / 100 - 1e-12).argmax(axis=1)]
        nested = {name: values[:, None, None].tolist() for name, values in found.items()}
        return nested | {"count": [self.frames]}
