"""A differentiable rasteriser: shapes as signed distances, edges anti-aliased over one pixel.

Coordinates are [x, y], y down, in units of which the shorter side of an image has 64: the pixels of
the paper's 64 × 64 frames, whatever the image's own resolution. The scene, 64 × 64 units, is in the
middle of the image, and its top left corner is the origin. A signed distance is negative inside a
shape (Hart 1996, "Sphere tracing"; the closed forms are Quilez's 2-D distance functions). Every
function takes one image, of H × W pixels.
"""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

# A short vector: an array, or a tuple of numbers.
Vector = ArrayLike | tuple[float, ...]

UNITS = 64  # across the shorter side of an image

# Below this many units a length counts as zero: sqrt(0) would have a NaN gradient.
_TINY = 1e-12


# (x, y) of points, in units, of shapes that broadcast. Two arrays rather than one [..., 2]: the
# columns and rows of a grid stay one-dimensional, and XLA fuses a shape four times faster.
Points = tuple[Array, Array]


def pixel_centers(size: tuple[int, int]) -> Points:
    """The centres of the pixels of an image of size (H, W): x [1, W] and y [H, 1], in units."""
    pixel = UNITS / min(size)
    y, x = ((jnp.arange(n) + 0.5) * pixel + (UNITS - n * pixel) / 2 for n in size)
    return x[None, :], y[:, None]


def _length(x: Array, y: Array) -> Array:
    return jnp.sqrt(x * x + y * y + _TINY)


def rectangle(points: Points, center: Vector, half_size: Vector) -> Array:
    """Signed distance [...] from points to an axis-aligned rectangle.

    Args:
      points: (x [...], y [...]) units.
      center: [2] units.
      half_size: [2] half of its width and height, units.
    """
    center, half_size = jnp.asarray(center), jnp.asarray(half_size)
    x = jnp.abs(points[0] - center[0]) - half_size[0]
    y = jnp.abs(points[1] - center[1]) - half_size[1]
    inside = jnp.minimum(jnp.maximum(x, y), 0.0)
    return _length(jnp.maximum(x, 0.0), jnp.maximum(y, 0.0)) + inside


def capsule(points: Points, start: Vector, end: Vector, radius: ArrayLike) -> Array:
    """Signed distance [...] from points to a segment with round ends.

    Args:
      points: (x [...], y [...]) units.
      start: [2] units.
      end: [2] units; may equal start, which gives a disc.
      radius: [] units.
    """
    start = jnp.asarray(start)
    axis = jnp.asarray(end) - start
    x, y = points[0] - start[0], points[1] - start[1]
    along = (x * axis[0] + y * axis[1]) / (jnp.dot(axis, axis) + _TINY)
    along = jnp.clip(along, 0.0, 1.0)
    return _length(x - along * axis[0], y - along * axis[1]) - radius


def disc(points: Points, center: Vector, radius: ArrayLike) -> Array:
    """Signed distance [...] from points (x, y) to a disc: center [2], radius [], units."""
    center = jnp.asarray(center)
    return _length(points[0] - center[0], points[1] - center[1]) - radius


def coverage(distance: Array) -> Array:
    """How much [H, W] of each pixel of an image a shape covers, in [0, 1].

    It rises from 0 half a pixel outside the edge to 1 half a pixel inside, by a smoothstep: unlike
    a clipped ramp it has a continuous derivative, so finite differences and gradients agree
    everywhere.

    Args:
      distance: [H, W] signed distance of each pixel's centre, units.
    """
    pixels_per_unit = min(distance.shape) / UNITS
    if pixels_per_unit != 1.0:
        distance = pixels_per_unit * distance
    ramp = jnp.clip(0.5 - distance, 0.0, 1.0)
    return ramp * ramp * (3.0 - 2.0 * ramp)


def paint(image: Array, distance: Array, color: Vector) -> Array:
    """Lays a shape over an image.

    Args:
      image: [H, W, 3] in [0, 1].
      distance: [H, W] signed distance of each pixel's centre, units.
      color: [3] RGB in [0, 1].
    Returns:
      [H, W, 3] in [0, 1].
    """
    return image + coverage(distance)[..., None] * (jnp.asarray(color) - image)


def quantize(image: Array) -> Array:
    """[...] uint8 of an image [...] in [0, 1]: what a camera hands over and what is stored."""
    return jnp.round(jnp.clip(image, 0.0, 1.0) * 255.0).astype(jnp.uint8)


def dequantize(image: Array) -> Array:
    """[...] float32 in [0, 1] of a uint8 image [...]."""
    return image.astype(jnp.float32) / 255.0
