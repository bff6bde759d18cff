"""The β-VAE's encoder and decoder, and an optional linear path beside them.

Architecture: BetaVAE of PyTorch-VAE (Subramanian 2020), the implementation the paper cites: strided
3×3 convolutions down to a vector and transposed ones back, with batch normalisation and leaky ReLU.
The linear path is ours: with the networks' last layers at zero the whole starts as a linear
autoencoder, so that a PCA or ICA solution can be its initial value. So is the decoder by place.

Plain functions hide Flax; the variables are plain pytrees that vmap over models.
Shapes: B batch, S image side, P = 3·S² pixels, O latents.
"""

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from jaxdeconf import checks
from jaxdeconf.nets import coordinates
from jaxdeconf.nets.conv import conv_general_dilated
from jaxdeconf.nets.initial import draw

Variables = dict[str, Any]


@dataclass(frozen=True)
class VAEConfig:
    """Shape of the network; hashable, so it can be a static argument of jit.

    Raises:
      ValueError: for no channels or latents, a side that the strides do not divide, or an unknown
        norm or dtype.
    """

    channels: tuple[int, ...] = (32, 64, 128, 256, 512)  # PyTorch-VAE; each one halves the side
    latents: int = 3  # the paper's, for CartPole
    image_size: int = 64  # the paper's: frames are 64 × 64 × 3
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
        checks.integer("image_size", self.image_size)
        if self.image_size % 2 ** len(self.channels):
            raise ValueError(
                f"image_size: expected a multiple of {2 ** len(self.channels)} "
                f"(one halving a channel entry), got {self.image_size}"
            )
        checks.one_of("decoder", self.decoder, ("convolutions", "coordinates"))
        checks.integer("width", self.width)
        checks.one_of("norm", self.norm, ("batch", "none"))
        checks.one_of("dtype", self.dtype, ("float32", "bfloat16"))

    @property
    def pixels(self) -> int:
        """P: the length of a flattened image."""
        return 3 * self.image_size**2

    @property
    def patches(self) -> int:
        """N: the 2×2 patches of an image."""
        return self.pixels // coordinates.CHANNELS


def init(config: VAEConfig, key: Array) -> Variables:
    """Fresh variables.

    Returns:
      {"params": {"encoder", "decoder"[, "linear"]}, "batch_stats": {"encoder", "decoder"}}.
      `params["linear"]`, with the linear path, is {"encoder": [P, O], "decoder": [O, P],
      "pixel_mean": [P]}, all zero, in the order of an image's row-major ravel; the convolutional
      branches then start at zero too, so setting it sets the whole network.
    """
    checks.instance("config", config, VAEConfig)
    checks.key("key", key)
    encoder_key, decoder_key = jax.random.split(key)
    images = jnp.zeros((1, config.image_size, config.image_size, 3))
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
        shapes = jax.eval_shape(lambda: _Decoder(config).init(key, latents, train=False))
        decoder = draw(shapes, decoder_key, 1, silent)
    params = {"encoder": encoder["params"], "decoder": decoder["params"]}
    if config.linear_path:
        params["linear"] = {
            "encoder": jnp.zeros((config.pixels, config.latents)),
            "decoder": jnp.zeros((config.latents, config.pixels)),
            "pixel_mean": jnp.zeros(config.pixels),
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
      images: [B, S, S, 3] float in [0, 1].
      train: use and track the batch's statistics (True) or the running ones (False). Static.
    Returns:
      mean [B, O], log_variance [B, O], and the whole `batch_stats` with the encoder's part updated.
    """
    side = config.image_size
    checks.array("images", images, f"[B, {side}, {side}, 3]", (None, side, side, 3), of="floats")
    (mean, log_variance), batch_stats = _run(_Encoder(config), "encoder", variables, images, train)
    if config.linear_path:
        linear = variables["params"]["linear"]
        centred = images.reshape(len(images), -1) - linear["pixel_mean"]
        mean = mean + centred @ linear["encoder"]
    return mean, log_variance, batch_stats


def decode(
    config: VAEConfig, variables: Variables, latents: Array, train: bool
) -> tuple[Array, Any]:
    """Images from latents.

    Args:
      config, variables, train: as in `encode`; in training, `batch_stats` as `encode` returned it.
      latents: [B, O].
    Returns:
      [B, S, S, 3] images, and the whole `batch_stats` with the decoder's part updated. The range is
      (0, 1) from the paper's tanh; with the linear path the output is linear, hence unbounded.
    """
    count = config.latents
    checks.array("latents", latents, f"[B, {count}]", (None, count), of="floats")
    if config.decoder == "coordinates":
        every = jnp.arange(config.patches)
        patches = decode_patches(config, variables, latents, every)
        return coordinates.from_patches(patches), variables["batch_stats"]
    images, batch_stats = _run(_Decoder(config), "decoder", variables, latents, train)
    if config.linear_path:
        linear = variables["params"]["linear"]
        flat = linear["pixel_mean"] + latents @ linear["decoder"]
        return images + flat.reshape(images.shape), batch_stats
    return 0.5 * (jnp.tanh(images) + 1), batch_stats


def decode_patches(config: VAEConfig, variables: Variables, latents: Array, chosen: Array) -> Array:
    """Some 2×2 patches of images from latents, by the decoder by place.

    Args:
      config, variables: as in `encode`.
      latents: [B, O].
      chosen: [n] int, which of the image's N patches, row-major.
    Returns:
      [B, n, 12], in the order of `coordinates.to_patches`, in the range of `decode`.
    """
    if config.decoder != "coordinates":
        raise ValueError(f"decoder: expected 'coordinates', got {config.decoder!r}")
    side = config.image_size
    places = jnp.asarray(coordinates.places(side))[chosen]
    parameters = {"params": variables["params"]["decoder"]}
    patches = _coordinate_decoder(config).apply(parameters, latents, places)
    patches = jnp.asarray(patches).astype(jnp.float32)
    if not config.linear_path:
        return 0.5 * (jnp.tanh(patches) + 1)
    linear = variables["params"]["linear"]
    rows = jnp.concatenate([linear["pixel_mean"][None], linear["decoder"]])
    rows = coordinates.to_patches(rows.reshape(-1, side, side, 3))[:, chosen]
    return patches + rows[0] + jnp.einsum("bo,onc->bnc", latents, rows[1:])


def _coordinate_decoder(config: VAEConfig) -> coordinates.CoordinateDecoder:
    return coordinates.CoordinateDecoder(config.width, config.dtype)


def _run(module: nn.Module, part: str, variables: Variables, x: Array, train: bool):
    """Apply one half of the network on its share of the variables; outputs come back as float32."""
    batch_stats = variables["batch_stats"]
    out, updates = module.apply(
        {"params": variables["params"][part], "batch_stats": batch_stats[part]},
        x,
        train=train,
        mutable=["batch_stats"],
    )
    out = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), out)
    return out, {**batch_stats, part: updates.get("batch_stats", {})}


def _conv(config: VAEConfig, features: int, name: str, stride: int = 1, upsample: bool = False):
    """A 3×3 convolution; `upsample`: PyTorch's ConvTranspose2d(3, 2, 1, output_padding=1)."""
    return nn.Conv(
        features,
        (3, 3),
        (stride, stride),
        padding=((1, 2), (1, 2)) if upsample else 1,
        input_dilation=2 if upsample else 1,
        dtype=jnp.dtype(config.dtype),
        conv_general_dilated=conv_general_dilated,
        name=name,
    )


def _norm_relu(config: VAEConfig, x: Array, train: bool, name: str) -> Array:
    if config.norm == "batch":
        x = nn.BatchNorm(
            use_running_average=not train, momentum=0.9, dtype=jnp.dtype(config.dtype), name=name
        )(x)
    return nn.leaky_relu(x, 0.01)


class _Encoder(nn.Module):
    config: VAEConfig

    @nn.compact
    def __call__(self, images: Array, train: bool) -> tuple[Array, Array]:
        x = 2 * images - 1  # the paper's range
        for i, features in enumerate(self.config.channels, 1):
            x = _conv(self.config, features, f"conv_{i}", stride=2)(x)
            x = _norm_relu(self.config, x, train, f"norm_{i}")
        x = x.reshape(len(x), -1)
        mean, log_variance = (
            nn.Dense(
                self.config.latents,
                dtype=jnp.dtype(self.config.dtype),
                name=name,
            )(x)
            for name in ("mean", "log_variance")
        )
        return mean, log_variance


class _Decoder(nn.Module):
    config: VAEConfig

    @nn.compact
    def __call__(self, latents: Array, train: bool) -> Array:
        channels = self.config.channels
        side = self.config.image_size // 2 ** len(channels)
        x = nn.Dense(side * side * channels[-1], dtype=jnp.dtype(self.config.dtype), name="dense")(
            latents
        )
        x = x.reshape(len(x), side, side, channels[-1])
        for i, features in enumerate((*channels[-2::-1], channels[0]), 1):
            x = _conv(self.config, features, f"conv_{i}", upsample=True)(x)
            x = _norm_relu(self.config, x, train, f"norm_{i}")
        return _conv(self.config, 3, "rgb")(x)
