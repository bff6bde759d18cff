"""The nuisance: a mark in the frame that shows the previous action (paper, Section V-A).

It says nothing about the state that the frame does not, yet predicts the expert's next action well:
what a cloned policy learns to copy. A nuisance has two methods, `draw` and `cover`; the second is
the human's remedy that BcManual stands for.
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.vision import raster

WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class ColorSquare:
    """A square whose colour runs linearly from `low` to `high` with the first action (CartPole)."""

    size: float = 15.0  # pixels; the paper's
    corner: tuple[float, float] = (0.0, 0.0)  # top left, pixels; the paper's
    low: tuple[float, float, float] = (0.0, 1.0, 0.0)  # green at -limit; the paper's
    high: tuple[float, float, float] = (1.0, 0.0, 0.0)  # red at +limit; the paper's

    def __post_init__(self):
        checks.positive("size", self.size)
        for name, length in (("corner", 2), ("low", 3), ("high", 3)):
            checks.array(name, getattr(self, name), f"[{length}]", (length,), finite=True)

    def paint(self, image: Array, corner: raster.Vector, color: raster.Vector) -> Array:
        """Lays the square over image [H, W, 3]; corner [2] in pixels, color [3] in [0, 1]."""
        half = jnp.full(2, self.size / 2)
        distance = raster.rectangle(
            raster.pixel_centers(image.shape[0]), jnp.asarray(corner) + half, half
        )
        return raster.paint(image, distance, color)

    def draw(self, image: Array, signal: Array) -> Array:
        """The frame with the nuisance on it.

        Args:
          image: [H, W, 3] in [0, 1].
          signal: [A] previous action over its limit, in [-1, 1].
        Returns:
          [H, W, 3] in [0, 1].
        """
        signal = checks.array("signal", signal, "[A]", (None,))
        low, high = jnp.asarray(self.low), jnp.asarray(self.high)
        return self.paint(image, self.corner, low + (signal[0] + 1.0) / 2.0 * (high - low))

    def cover(self, image: Array) -> Array:
        """The frame [H, W, 3] with a white square where the nuisance was (BcManual)."""
        return self.paint(image, self.corner, WHITE)
