"""The β-VAE's encoder and decoder, and an optional linear path beside them.

Architecture: BetaVAE of PyTorch-VAE (Subramanian 2020), the implementation the paper cites: strided
3×3 convolutions down to a vector and transposed ones back, with batch normalisation and leaky ReLU.
The linear path is ours: with the networks' last layers at zero the whole starts as a linear
autoencoder, so that a PCA or ICA solution can be its initial value. So is the decoder by place.

Plain functions hide Flax; the variables are plain pytrees that vmap over models.
Shapes: B batch, H × W pixels, P = 3·H·W numbers an image, O latents.
"""

from dataclasses import dataclass
from math import prod
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from jaxdeconf import checks
from jaxdeconf.nets import coordinates, layers
from jaxdeconf.nets.initial import draw
from jaxdeconf.nets.layers import Variables, conv, dense
from jaxdeconf.traced import traceable


@traceable
@dataclass(frozen=True)
class VAEConfig:
    """Shape of the network; hashable, so it can be a static argument of jit.

    Raises:
      ValueError: for no channels or latents, or an unknown decoder, norm or dtype.
    """

    channels: tuple[int, ...] = (32, 64, 128, 256, 512)  # PyTorch-VAE; each one halves the side
    latents: int = 3  # the paper's, for CartPole
    linear_path: bool = False  # ours: off is the paper's network
    norm: Literal["batch", "none"] = "batch"  # PyTorch-VAE: batch normalisation
    dtype: Literal["float32", "bfloat16"] = "float32"  # of activations; parameters stay float32
    # "coordinates" is ours: by place (nets/coordinates.py), for shapes that move and turn.
    decoder: Literal["convolutions", "coordinates"] = "convolutions"
    width: int = 64  # of the decoder by place

    def __post_init__(self):
        if not isinstance(self.channels, tuple) or not self.channels:
            raise ValueError(f"channels: expected positive integers, got {self.channels!r}")
        for channels in self.channels:
            checks.integer("channels", channels)
        checks.integer("latents", self.latents)
        checks.one_of("decoder", self.decoder, ("convolutions", "coordinates"))
        checks.integer("width", self.width)
        checks.one_of("norm", self.norm, ("batch", "none"))
        checks.one_of("dtype", self.dtype, ("float32", "bfloat16"))


def check_size(config: VAEConfig, size: tuple[int, int]) -> None:
    """Raises ValueError if the decoder cannot draw images of size (H, W)."""
    factor = 2 ** len(config.channels)
    why = f"each of the {len(config.channels)} channels halves it"
    if config.decoder == "coordinates":
        factor, why = coordinates.SIDE, "it is drawn in patches of 2 × 2"
    if size[0] % factor or size[1] % factor:
        shown = f"{size[0]} × {size[1]}"
        raise ValueError(f"size: expected multiples of {factor} ({why}), got {shown}")


def init(config: VAEConfig, key: Array, size: tuple[int, int]) -> Variables:
    """Fresh variables.

    Args:
      config: the network's shape.
      key: PRNG key.
      size: (H, W) of the images. Static.
    Returns:
      {"params": {"encoder", "decoder"[, "linear"]}, "batch_stats": {"encoder", "decoder"}}.
      `params["linear"]`, with the linear path, is {"encoder": [P, O], "decoder": [O, P],
      "pixel_mean": [P]}, all zero, in the order of an image's row-major ravel; the convolutional
      branches then start at zero too, so setting it sets the whole network.
    Raises:
      ValueError: for a size that the decoder cannot draw.
    """
    check_size(config, size)
    encoder_key, decoder_key = jax.random.split(key)
    images = jnp.zeros((1, *size, 3))
    latents = jnp.zeros((1, config.latents))
    # Zero beside a linear path: the networks start silent, but still get a gradient.
    silent = ("mean", "log_variance", "rgb") if config.linear_path else ()
    shapes = jax.eval_shape(lambda: _Encoder(config).init(key, images, train=False))
    encoder = draw(shapes, encoder_key, 1, silent)
    if config.decoder == "coordinates":
        module, place = _coordinate_decoder(config), jnp.zeros((1, 3))
        shapes = jax.eval_shape(lambda: module.init(key, latents, place))
        decoder = draw(shapes, decoder_key, 2, silent)
    else:
        shapes = jax.eval_shape(lambda: _Decoder(config, size).init(key, latents, train=False))
        decoder = draw(shapes, decoder_key, 1, silent)
    params = {"encoder": encoder["params"], "decoder": decoder["params"]}
    if config.linear_path:
        pixels = prod(images.shape)
        params["linear"] = {
            "encoder": jnp.zeros((pixels, config.latents)),
            "decoder": jnp.zeros((config.latents, pixels)),
            "pixel_mean": jnp.zeros(pixels),
        }
    batch_stats = {
        "encoder": encoder.get("batch_stats", {}),
        "decoder": decoder.get("batch_stats", {}),
    }
    return {"params": params, "batch_stats": batch_stats}


def encode(
    config: VAEConfig, variables: Variables, images: Array, train: bool
) -> tuple[Array, Array, Any]:
    """The approximate posterior's mean and log-variance.

    Args:
      config: the one given to `init`.
      variables: what `init` returned, or trained from it.
      images: [B, H, W, 3] float in [0, 1], of the size given to `init`.
      train: use and track the batch's statistics (True) or the running ones (False). Static.
    Returns:
      mean [B, O], log_variance [B, O], and the whole `batch_stats` with the encoder's part updated.
    """
    (mean, log_variance), batch_stats = _run(_Encoder(config), "encoder", variables, images, train)
    if config.linear_path:
        linear = variables["params"]["linear"]
        centred = images.reshape(len(images), -1) - linear["pixel_mean"]
        mean = mean + centred @ linear["encoder"]
    return mean, log_variance, batch_stats


def decode(
    config: VAEConfig, variables: Variables, latents: Array, size: tuple[int, int], train: bool
) -> tuple[Array, Any]:
    """Images from latents.

    Args:
      config, variables, train: as in `encode`; in training, `batch_stats` as `encode` returned it.
      latents: [B, O].
      size: (H, W), the one given to `init`. Static.
    Returns:
      [B, H, W, 3] images, and the whole `batch_stats` with the decoder's part updated. The range is
      (0, 1) from the paper's tanh; with the linear path the output is linear, hence unbounded.
    """
    if config.decoder == "coordinates":
        every = jnp.arange(coordinates.patch_count(size))
        patches = decode_patches(config, variables, latents, size, every)
        return coordinates.from_patches(patches, size), variables["batch_stats"]
    images, batch_stats = _run(_Decoder(config, size), "decoder", variables, latents, train)
    if config.linear_path:
        linear = variables["params"]["linear"]
        flat = linear["pixel_mean"] + latents @ linear["decoder"]
        return images + flat.reshape(images.shape), batch_stats
    return 0.5 * (jnp.tanh(images) + 1), batch_stats


def decode_patches(
    config: VAEConfig, variables: Variables, latents: Array, size: tuple[int, int], chosen: Array
) -> Array:
    """Some 2×2 patches of images from latents, by the decoder by place.

    Args:
      config, variables, latents, size: as in `decode`.
      chosen: [n] int, which of the image's N patches, row-major.
    Returns:
      [B, n, 12], in the order of `coordinates.to_patches`, in the range of `decode`.
    """
    places = jnp.asarray(coordinates.places(size))[chosen]
    parameters = {"params": variables["params"]["decoder"]}
    patches = _coordinate_decoder(config).apply(parameters, latents, places)
    patches = jnp.asarray(patches).astype(jnp.float32)
    if not config.linear_path:
        return 0.5 * (jnp.tanh(patches) + 1)
    linear = variables["params"]["linear"]
    rows = jnp.concatenate([linear["pixel_mean"][None], linear["decoder"]])
    rows = coordinates.to_patches(rows.reshape(-1, *size, 3))[:, chosen]
    return patches + rows[0] + jnp.einsum("bo,onc->bnc", latents, rows[1:])


def _coordinate_decoder(config: VAEConfig) -> coordinates.CoordinateDecoder:
    return coordinates.CoordinateDecoder(config.width, config.dtype)


def _run(module: nn.Module, part: str, variables: Variables, x: Array, train: bool):
    """Apply one half of the network on its share of the variables."""
    share = {kind: variables[kind][part] for kind in ("params", "batch_stats")}
    out, batch_stats = layers.run(module, share, x, train)
    return out, {**variables["batch_stats"], part: batch_stats}


def _norm_relu(config: VAEConfig, x: Array, train: bool, name: str) -> Array:
    return nn.leaky_relu(layers.norm(config, x, train, name), 0.01)


# PyTorch's ConvTranspose2d(3, 2, 1, output_padding=1).
_UPSAMPLING = {"padding": ((1, 2), (1, 2)), "input_dilation": 2}


class _Encoder(nn.Module):
    config: VAEConfig

    @nn.compact
    def __call__(self, images: Array, train: bool) -> tuple[Array, Array]:
        x = 2 * images - 1  # the paper's range
        for i, features in enumerate(self.config.channels, 1):
            x = conv(self.config, features, 3, f"conv_{i}", stride=2)(x)
            x = _norm_relu(self.config, x, train, f"norm_{i}")
        x = x.reshape(len(x), -1)
        latents = self.config.latents
        mean = dense(self.config, latents, "mean")(x)
        return mean, dense(self.config, latents, "log_variance")(x)


class _Decoder(nn.Module):
    config: VAEConfig
    size: tuple[int, int]

    @nn.compact
    def __call__(self, latents: Array, train: bool) -> Array:
        channels = self.config.channels
        rows, columns = (pixels // 2 ** len(channels) for pixels in self.size)
        x = dense(self.config, rows * columns * channels[-1], "dense")(latents)
        x = x.reshape(len(x), rows, columns, channels[-1])
        for i, features in enumerate((*channels[-2::-1], channels[0]), 1):
            x = conv(self.config, features, 3, f"conv_{i}", **_UPSAMPLING)(x)
            x = _norm_relu(self.config, x, train, f"norm_{i}")
        return conv(self.config, 3, 3, "rgb")(x)
