"""A small VQ-VAE: images as maps of codes, out of a table of them (van den Oord et al. 2017).

The encoder is that of Park et al. (2021), smaller: three 4×4 convolutions of stride 2, then a
residual block; the decoder is its mirror image. Each place of the map, an eighth of the image's
side, takes the code that is nearest to it. Plain functions hide Flax.
Shapes: B batch, H × W pixels, h × w = H/8 × W/8 places, K codes, D their dimension.
"""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from jaxdeconf import checks
from jaxdeconf.nets.initial import draw
from jaxdeconf.nets.layers import Variables, conv
from jaxdeconf.traced import traceable

SIDE = 8  # pixels of a place


@traceable
@dataclass(frozen=True)
class VQConfig:
    """Shape of the network; ours are small, for a CPU: Park et al. have K 512, D 64, channels ×4.

    Raises:
      ValueError: for no codes, or more than a byte tells apart, or other than three channels.
    """

    codes: int = 64  # K
    dimension: int = 32  # D
    channels: tuple[int, int, int] = (16, 32, 32)  # each one halves the side
    dtype: Literal["float32", "bfloat16"] = "float32"  # of activations; parameters stay float32

    def __post_init__(self):
        checks.integer("codes", self.codes, least=2, most=256)
        checks.integer("dimension", self.dimension)
        if len(self.channels) != 3:
            raise ValueError(f"channels: expected three positive integers, got {self.channels!r}")
        for channels in self.channels:
            checks.integer("channels", channels)
        checks.one_of("dtype", self.dtype, ("float32", "bfloat16"))


def check_size(size: tuple[int, int]) -> None:
    """Raises ValueError if images of size (H, W) are no whole number of places."""
    if size[0] % SIDE or size[1] % SIDE:
        shown = f"{size[0]} × {size[1]}"
        raise ValueError(f"size: expected multiples of {SIDE} (a code's place), got {shown}")


def init(config: VQConfig, key: Array, images: Array) -> Variables:
    """Fresh variables.

    Args:
      config: the network's shape.
      key: PRNG key.
      images: [B, H, W, 3] float in [0, 1], B·h·w ≥ K. The codes begin at places of theirs, drawn at
        random: of codes that begin elsewhere, a short training leaves most unused.
    Returns:
      {"params": {"encoder", "decoder", "codes": [K, D]}, "batch_stats": {}}.
    Raises:
      ValueError: for a size that is no multiple of 8, or too few images.
    """
    _, height, width, _ = images.shape
    check_size((height, width))
    encoder_key, decoder_key, codes_key = jax.random.split(key, 3)
    places = jnp.zeros((1, height // SIDE, width // SIDE, config.dimension))
    encoder = draw(jax.eval_shape(_Encoder(config).init, key, images[:1]), encoder_key, gain=2)
    decoder = draw(jax.eval_shape(_Decoder(config).init, key, places), decoder_key, gain=2)
    params = {"encoder": encoder["params"], "decoder": decoder["params"]}
    vectors = encode(config, {"params": params}, images).reshape(-1, config.dimension)
    checks.integer("places in images", len(vectors), least=config.codes)
    params["codes"] = jax.random.permutation(codes_key, vectors)[: config.codes]
    return {"params": params, "batch_stats": {}}


def encode(config: VQConfig, variables: Variables, images: Array) -> Array:
    """[B, h, w, D] maps, before any code is taken, of images [B, H, W, 3] in [0, 1]."""
    parameters = {"params": variables["params"]["encoder"]}
    return jnp.asarray(_Encoder(config).apply(parameters, images)).astype(jnp.float32)


def nearest(variables: Variables, maps: Array) -> Array:
    """[B, h, w] int32 the codes that are nearest to the places of maps [B, h, w, D]."""
    codes = variables["params"]["codes"]
    # Of ‖m - c‖², without ‖m‖², which is the same for all codes.
    return jnp.argmin((codes**2).sum(axis=1) - 2.0 * maps @ codes.T, axis=-1)


def straight_through(maps: Array, taken: Array) -> Array:
    """The values of `taken`, but the gradient goes to the maps (Bengio et al. 2013)."""
    held = jax.lax.stop_gradient(maps)
    return jax.lax.stop_gradient(taken) + (maps - held)


def decode(config: VQConfig, variables: Variables, maps: Array) -> Array:
    """[B, H, W, 3] images, unbounded, of maps [B, h, w, D] of codes."""
    parameters = {"params": variables["params"]["decoder"]}
    return jnp.asarray(_Decoder(config).apply(parameters, maps)).astype(jnp.float32)


def perplexity(codes: Array, count: int) -> Array:
    """[] how many codes are in use, as e to the entropy of codes [...] out of so many."""
    share = jnp.bincount(codes.ravel(), length=count) / codes.size
    return jnp.exp(-jax.scipy.special.xlogy(share, share).sum())


class _Residual(nn.Module):
    """ReLU, 3×3, ReLU, 1×1, plus the input."""

    config: VQConfig

    @nn.compact
    def __call__(self, x: Array) -> Array:
        y = conv(self.config, x.shape[-1], 3, "conv_1")(nn.relu(x))
        return x + conv(self.config, x.shape[-1], 1, "conv_2")(nn.relu(y))


class _Encoder(nn.Module):
    config: VQConfig

    @nn.compact
    def __call__(self, images: Array) -> Array:
        x = 2 * images - 1
        for i, channels in enumerate(self.config.channels, 1):
            halved = {"stride": 2, "padding": 1}
            x = nn.relu(conv(self.config, channels, 4, f"conv_{i}", **halved)(x))
        x = nn.relu(_Residual(self.config, name="residual")(x))
        return conv(self.config, self.config.dimension, 1, "places")(x)


class _Decoder(nn.Module):
    config: VQConfig

    @nn.compact
    def __call__(self, maps: Array) -> Array:
        first, second, last = self.config.channels
        x = conv(self.config, last, 3, "places")(maps)
        x = _Residual(self.config, name="residual")(x)
        for i, channels in enumerate((second, first, 3), 1):
            # Twice the side: the mirror image of 4×4 with stride 2.
            doubled = {"padding": 2, "input_dilation": 2}
            x = conv(self.config, channels, 4, f"conv_{i}", **doubled)(nn.relu(x))
        return 0.5 * (x + 1)  # grey, to begin with
