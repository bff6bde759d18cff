"""A differentiable rasteriser: shapes as signed distances, edges anti-aliased over one pixel.

Coordinates are pixels, [x, y], origin in the top left corner, y down; the centre of the first pixel
is (0.5, 0.5). A signed distance is negative inside a shape (Hart 1996, "Sphere tracing"; the
closed forms are Quilez's 2-D distance functions). Every function takes one image.
"""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxdeconf import checks

# A short vector: an array, or a tuple of numbers.
Vector = ArrayLike | tuple[float, ...]

SIZE = 64  # The paper's frames are 64 x 64 RGB.

# Below this many pixels a length counts as zero: sqrt(0) would have a NaN gradient.
_TINY = 1e-12


# (x, y) of points, in pixels, of shapes that broadcast. Two arrays rather than one [..., 2]: the
# columns and rows of a grid stay one-dimensional, and XLA fuses a shape four times faster.
Points = tuple[Array, Array]


def pixel_centers(size: int = SIZE) -> Points:
    """The centres of a square image's pixels: x [1, size] and y [size, 1], in pixels."""
    centers = jnp.arange(checks.integer("size", size)) + 0.5
    return centers[None, :], centers[:, None]


def _length(x: Array, y: Array) -> Array:
    return jnp.sqrt(x * x + y * y + _TINY)


def rectangle(points: Points, center: Vector, half_size: Vector) -> Array:
    """Signed distance [...] from points to an axis-aligned rectangle.

    Args:
      points: (x [...], y [...]) pixels.
      center: [2] pixels.
      half_size: [2] half of its width and height, pixels.
    """
    center, half_size = jnp.asarray(center), jnp.asarray(half_size)
    x = jnp.abs(points[0] - center[0]) - half_size[0]
    y = jnp.abs(points[1] - center[1]) - half_size[1]
    inside = jnp.minimum(jnp.maximum(x, y), 0.0)
    return _length(jnp.maximum(x, 0.0), jnp.maximum(y, 0.0)) + inside


def capsule(points: Points, start: Vector, end: Vector, radius: ArrayLike) -> Array:
    """Signed distance [...] from points to a segment with round ends.

    Args:
      points: (x [...], y [...]) pixels.
      start: [2] pixels.
      end: [2] pixels; may equal start, which gives a disc.
      radius: [] pixels.
    """
    start = jnp.asarray(start)
    axis = jnp.asarray(end) - start
    x, y = points[0] - start[0], points[1] - start[1]
    along = (x * axis[0] + y * axis[1]) / (jnp.dot(axis, axis) + _TINY)
    along = jnp.clip(along, 0.0, 1.0)
    return _length(x - along * axis[0], y - along * axis[1]) - radius


def disc(points: Points, center: Vector, radius: ArrayLike) -> Array:
    """Signed distance [...] from points (x, y) to a disc: center [2], radius [], pixels."""
    center = jnp.asarray(center)
    return _length(points[0] - center[0], points[1] - center[1]) - radius


def paint(image: Array, distance: Array, color: Vector) -> Array:
    """Lays a shape over an image.

    The coverage of a pixel rises from 0 half a pixel outside the edge to 1 half a pixel inside, by
    a smoothstep: unlike a clipped ramp it has a continuous derivative, so finite differences and
    gradients agree everywhere.

    Args:
      image: [H, W, 3] in [0, 1].
      distance: [H, W] signed distance of each pixel's centre, pixels.
      color: [3] RGB in [0, 1].
    Returns:
      [H, W, 3] in [0, 1].
    """
    image = checks.array("image", image, "[H, W, 3]", (None, None, 3), of="floats")
    checks.array("distance", distance, "[H, W]", image.shape[:2], of="floats")
    checks.array("color", color, "[3]", (3,))
    ramp = jnp.clip(0.5 - distance, 0.0, 1.0)
    coverage = (ramp * ramp * (3.0 - 2.0 * ramp))[..., None]
    return image + coverage * (jnp.asarray(color) - image)


def quantize(image: Array) -> Array:
    """[...] uint8 of an image [...] in [0, 1]: what a camera hands over and what is stored."""
    checks.array("image", image, "[...]", jnp.shape(image), of="floats")
    return jnp.round(jnp.clip(image, 0.0, 1.0) * 255.0).astype(jnp.uint8)


def dequantize(image: Array) -> Array:
    """[...] float32 in [0, 1] of a uint8 image [...]."""
    checks.array("image", image, "[...]", jnp.shape(image), of="uint8")
    return image.astype(jnp.float32) / 255.0
