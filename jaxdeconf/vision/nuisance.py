"""The nuisance: a mark in the frame that shows the previous action (paper, Section V-A).

Or another signal of past actions: see `systems.signal`. It says nothing about the state that the
frame does not, yet predicts the expert's next action well: what a cloned policy learns to copy. A
nuisance has two methods, `draw` and `cover`; the second is the human's remedy that BcManual stands
for. Lengths are in the units of `raster`, pixels of the paper's frames; images may have any size.
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.vision import raster


@dataclass(frozen=True)
class Corner:
    """The square patch of the frame in which a mark is, and which a human would cover."""

    size: float = 15.0  # units; the paper's
    corner: tuple[float, float] = (0.0, 0.0)  # top left, units; the paper's

    def __post_init__(self):
        checks.positive("size", self.size)
        checks.array("corner", self.corner, "[2]", (2,), finite=True)

    def paint(self, image: Array, corner: raster.Vector, color: raster.Vector) -> Array:
        """Lays the square over image [H, W, 3]; corner [2] in units, color [3] in [0, 1]."""
        return raster.paint(image, self._distance(image, corner), color)

    def cover(self, image: Array) -> Array:
        """The frame [H, W, 3], white in every pixel that the square touches (BcManual)."""
        # Painting it white would leave some of the mark in pixels that the square covers in part.
        touched = raster.coverage(self._distance(image, self.corner)) > 0
        return jnp.where(touched[..., None], 1.0, image)

    def _distance(self, image: Array, corner: raster.Vector) -> Array:
        half = jnp.full(2, self.size / 2)
        points = raster.pixel_centers((image.shape[0], image.shape[1]))
        return raster.rectangle(points, jnp.asarray(corner) + half, half)


@dataclass(frozen=True)
class ColorSquare(Corner):
    """A square whose colour runs linearly from `low` to `high` with the first action (CartPole)."""

    low: tuple[float, float, float] = (0.0, 1.0, 0.0)  # green at -limit; the paper's
    high: tuple[float, float, float] = (1.0, 0.0, 0.0)  # red at +limit; the paper's

    def __post_init__(self):
        super().__post_init__()
        for name in ("low", "high"):
            checks.array(name, getattr(self, name), "[3]", (3,), finite=True)

    def draw(self, image: Array, signal: Array) -> Array:
        """The frame with the nuisance on it.

        Args:
          image: [H, W, 3] in [0, 1].
          signal: [A] what it shows, the previous action say, over its limit, in [-1, 1].
        Returns:
          [H, W, 3] in [0, 1].
        """
        low, high = jnp.asarray(self.low), jnp.asarray(self.high)
        return self.paint(image, self.corner, low + (signal[0] + 1.0) / 2.0 * (high - low))


@dataclass(frozen=True)
class JoystickDot(Corner):
    """A dot that the first action moves to the right and the second one upwards (Reacher)."""

    color: tuple[float, float, float] = (1.0, 0.0, 0.0)  # red; the paper's
    radius: float = 3.0  # units; ours
    reach: float = 4.0  # units from the square's middle at the limit; ours: the dot stays inside

    def __post_init__(self):
        super().__post_init__()
        checks.array("color", self.color, "[3]", (3,), finite=True)
        for name in ("radius", "reach"):
            checks.positive(name, getattr(self, name))

    def draw(self, image: Array, signal: Array) -> Array:
        """The frame with the nuisance on it.

        Args:
          image: [H, W, 3] in [0, 1].
          signal: [A >= 2] what it shows, over its limit, in [-1, 1].
        Returns:
          [H, W, 3] in [0, 1].
        """
        middle = jnp.asarray(self.corner) + self.size / 2
        center = middle + self.reach * signal[:2] * jnp.asarray([1.0, -1.0])
        points = raster.pixel_centers((image.shape[0], image.shape[1]))
        return raster.paint(image, raster.disc(points, center, self.radius), self.color)
