"""A decoder that draws by place: each 2×2 patch of the image from where it is and what to draw.

The latents choose lines in the plane, and every patch sees on which side of each it lies, and how
far: what moves and turns, like a link, is then a smooth function of few numbers, which transposed
convolutions have to learn place by place (cf. Watters et al. 2019, "Spatial broadcast decoder").
And a training step may draw some patches only. Shapes: B batch, S image side, O latents, N = S²/4
patches, n of them, W width.
"""

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax import Array

SIDE = 2  # pixels of a patch
CHANNELS = 3 * SIDE**2  # numbers a patch


def to_patches(images: Array) -> Array:
    """[B, N, 12] patches, row-major, of images [B, S, S, 3]."""
    count, size = images.shape[:2]
    side = size // SIDE
    split = images.reshape(count, side, SIDE, side, SIDE, 3)
    return split.swapaxes(2, 3).reshape(count, side * side, CHANNELS)


def from_patches(patches: Array) -> Array:
    """Images [B, S, S, 3] of all their patches [B, N, 12]."""
    count, side = patches.shape[0], round(patches.shape[1] ** 0.5)
    split = patches.reshape(count, side, side, SIDE, SIDE, 3)
    return split.swapaxes(2, 3).reshape(count, side * SIDE, side * SIDE, 3)


def places(size: int) -> np.ndarray:
    """[N, 3] the centre (x, y) of each patch, ±4 across the image, and a 1."""
    side = size // SIDE
    centers = 4 * ((np.arange(side) + 0.5) / side * 2 - 1)
    y, x = np.meshgrid(centers, centers, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.ones(side * side)], axis=1).astype(np.float32)


class CoordinateDecoder(nn.Module):
    """Patches [B, n, 12] of what latents [B, O] describe, at places [n, 3]."""

    width: int
    dtype: str

    @nn.compact
    def __call__(self, latents: Array, places: Array) -> Array:
        """Draws each place of each latent vector."""
        width, dtype = self.width, jnp.dtype(self.dtype)
        x = latents
        for i in (1, 2):
            x = nn.leaky_relu(nn.Dense(2 * width, dtype=dtype, name=f"latents_{i}")(x), 0.01)
        lines = nn.Dense(3 * width, dtype=dtype, name="lines")(x).reshape(-1, 3, width)
        y = nn.relu(jnp.einsum("nc,bcw->bnw", places.astype(dtype), lines))
        for i in (1, 2):
            y = nn.relu(nn.Dense(width, dtype=dtype, name=f"patch_{i}")(y))
        return nn.Dense(CHANNELS, dtype=dtype, name="rgb")(y)
