"""A decoder that draws by place: each 2×2 patch of the image from where it is and what to draw.

The latents choose lines in the plane, and every patch sees on which side of each it lies, and how
far: what moves and turns, like a link, is then a smooth function of few numbers, which transposed
convolutions have to learn place by place (cf. Watters et al. 2019, "Spatial broadcast decoder").
And a training step may draw some patches only. Shapes: B batch, H × W pixels, O latents,
N = H·W/4 patches, n of them.
"""

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax import Array

SIDE = 2  # pixels of a patch
CHANNELS = 3 * SIDE**2  # numbers a patch


def patch_count(size: tuple[int, int]) -> int:
    """N: the patches of an image of size (H, W)."""
    return size[0] * size[1] // SIDE**2


def to_patches(images: Array) -> Array:
    """[B, N, 12] patches, row-major, of images [B, H, W, 3]."""
    batch, height, width = images.shape[:3]
    split = images.reshape(batch, height // SIDE, SIDE, width // SIDE, SIDE, 3)
    return split.swapaxes(2, 3).reshape(batch, -1, CHANNELS)


def from_patches(patches: Array, size: tuple[int, int]) -> Array:
    """Images [B, H, W, 3] of size (H, W), of all their patches [B, N, 12]."""
    split = patches.reshape(-1, size[0] // SIDE, size[1] // SIDE, SIDE, SIDE, 3)
    return split.swapaxes(2, 3).reshape(-1, *size, 3)


def places(size: tuple[int, int]) -> np.ndarray:
    """[N, 3] the centre (x, y) of each patch, ±4 across the image's shorter side, and a 1."""
    rows, columns = (pixels // SIDE for pixels in size)
    y, x = np.mgrid[:rows, :columns].reshape(2, -1) + 0.5
    scale = 8 / min(rows, columns)
    centers = [scale * (x - columns / 2), scale * (y - rows / 2), np.ones(len(x))]
    return np.stack(centers, axis=1).astype(np.float32)


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
