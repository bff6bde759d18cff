"""Where things are, and how they have moved: a small network for frames before a still background.

One convolution over what differs from the background; of each channel its amount and its centroid;
of these what they are in the present frame, and how they changed from frame to frame; dense layers.
Cloned on a CPU's budget, Reacher's arm arrives with it, and with a ResNet's first stage does not
(docs/reacher.md). Ours; the nearest in the literature is the spatial softmax of Levine et al.
(2016), whose places a wide background blurs.
Shapes: B batch, L frames, H × W pixels, h × w half of them, C channels, A action, F features.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from jaxdeconf.nets.layers import Config, answer, conv

_SIDE, _STRIDE = 5, 2  # of the convolution; at full resolution it sees no better, at 3 × 3 worse
_FRAMES = 512  # of which the background is the median
# Of a channel's mean over the map, which is small beside places: shapes are a small part of it.
_AMOUNT = 10.0


@jax.jit
def background(frames: Array) -> Array:
    """[H, W, 3] in [0, 1]: each pixel's median over frames [n, H, W, 3] uint8, some 512 of them.

    The upper median, found bit by bit: nothing is sorted.
    """
    some = frames[:: max(1, len(frames) // _FRAMES)]
    found = jnp.zeros(some.shape[1:], some.dtype)
    for bit in (128, 64, 32, 16, 8, 4, 2, 1):
        reached = (some >= found + jnp.uint8(bit)).sum(axis=0) * 2 >= len(some)
        found = jnp.where(reached, found + jnp.uint8(bit), found)
    return found / jnp.float32(255)


def places(x: Array) -> Array:
    """[B, 3 C] of maps [B, h, w, C] ≥ 0: each channel's centroid x and y in [-1, 1], its amount.

    Where there is next to nothing, the centroid is next to the middle.
    """
    _, height, width, _ = x.shape
    columns, rows = (jnp.linspace(-1.0, 1.0, size, dtype=x.dtype) for size in (width, height))
    total = x.sum((1, 2))
    across = jnp.einsum("bhwc,w->bc", x, columns) / (total + 1.0)
    down = jnp.einsum("bhwc,h->bc", x, rows) / (total + 1.0)
    return jnp.concatenate([across, down, total * (_AMOUNT / (height * width))], axis=1)


class Places(nn.Module):
    """The network. Its `batch_stats` hold the background [H, W, 3], which training leaves alone."""

    config: Config
    outputs: int

    @nn.compact
    def __call__(self, images: Array, train: bool, gate: Any = None) -> tuple[Array, Array]:
        """Actions [B, A] of images [B, H, W, 3 L] in [0, 1]; the features [B, F] before."""
        batch, height, width, channels = images.shape
        count = channels // 3
        frames = jnp.moveaxis(images.reshape(batch, height, width, count, 3), 3, 1)
        shown = frames.max((2, 3, 4)) > 0  # a frame from before the first is black
        still = self.variable("batch_stats", "background", jnp.zeros, (height, width, 3)).value
        apart = (frames - still).reshape(batch * count, height, width, 3)
        x = nn.relu(conv(self.config, self.config.width, _SIDE, "eyes", _STRIDE)(apart))
        if gate is not None:
            x = _gated(x, count, gate)
        seen = places(x.astype(jnp.float32)).reshape(batch, count, -1)
        moved = (seen[:, 1:] - seen[:, :-1]) * shown[:, :-1, None] * self.config.motion
        x = jnp.concatenate([seen[:, -1], moved.reshape(batch, -1)], axis=1)
        return answer(self.config, self.outputs, x)


def _gated(x: Array, count: int, gate: Any) -> Array:
    """Maps [B L, h, w, C] behind a gate, which is given the L of a sample as [B, h, w, L C]."""
    frames, height, width, channels = x.shape
    apart = x.reshape(frames // count, count, height, width, channels)
    joined = jnp.moveaxis(apart, 1, 3).reshape(-1, height, width, count * channels)
    apart = gate(joined).reshape(-1, height, width, count, channels)
    return jnp.moveaxis(apart, 3, 1).reshape(x.shape)
