"""The β-VAE stage: train it, and use it as an encoder and a masked reconstruction.

Losses H (Higgins et al. 2017) and B (Burgess et al. 2018) in the units of PyTorch-VAE's BetaVAE,
which the paper cites: the reconstruction error is a mean over pixels of range [-1, 1], and the KL
divergence weighs β · M_N. Shapes: n frames, B batch, P pixels, O latents.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.keys import named
from jaxdeconf.learn.fit import FitConfig, FitState, Loss, Training, Variables, start
from jaxdeconf.learn.linear_start import linear_start
from jaxdeconf.nets import coordinates, vae
from jaxdeconf.traced import Traced, traceable
from jaxdeconf.vision import raster

# PyTorch-VAE's weight of the KL term, its batch size over its dataset's.
M_N = 0.00025
# A latent below this KL (nats) carries nothing: it is set to its prior mean wherever it is used.
ACTIVE_KL = 0.1
# Frames encoded at a time: bounds the memory of activations.
_ENCODE_BATCH = 256
# Frames that fit the linear start; its error falls as 1/sqrt(n), 1.6 % here.
_START_FRAMES = 4096


@traceable
@dataclass(frozen=True)
class DisentangleConfig(FitConfig):
    """The β-VAE's training, objective and network; a paper's default is one for all its systems."""

    epochs: float = 100.0  # the paper's
    learning_rate: Traced = 1e-3  # ours: the paper's differ from system to system
    batch_size: int = 64  # ours: the paper's differ
    decay: Traced = 0.95  # the paper's
    # H: mse + β M_N KL; B: mse + β M_N |KL - C|. The paper does not say; B is its code's default,
    # and under H its β = 100 would weigh 77 squared units a nat and silence every latent.
    objective: Literal["H", "B"] = "B"
    beta: Traced = 1.0  # weight of the KL term; ours: the paper's differ
    capacity: Traced = 25.0  # nats; B's C rises linearly to it. PyTorch-VAE's
    capacity_steps: int = 100_000  # steps of that rise; PyTorch-VAE's 1e5
    # 2×2 patches, drawn at random, that a step compares; None, the paper's, is the whole image.
    # Ours, for a CPU: a quarter of the image costs a quarter. Only with the decoder by place.
    patches: int | None = None
    # Independent components among which a linear start finds its latents; None: as many as those.
    start_components: int | None = None
    network: vae.VAEConfig = field(default_factory=vae.VAEConfig)

    def __post_init__(self):
        super().__post_init__()
        checks.one_of("objective", self.objective, ("H", "B"))
        checks.not_negative("beta", self.beta)
        checks.not_negative("capacity", self.capacity)
        checks.integer("capacity_steps", self.capacity_steps)
        checks.instance("network", self.network, vae.VAEConfig)
        if self.start_components is not None:
            least = self.network.latents
            checks.integer("start_components", self.start_components, least=least)
        if self.patches is not None:
            checks.integer("patches", self.patches)
            if self.network.decoder != "coordinates":
                raise ValueError(
                    f"patches: expected None for decoder 'convolutions', got {self.patches}"
                )


# For a CPU and data of any size, in minutes: a linear start, since from random weights so few steps
# never reach the nuisance; narrow networks; as many steps, whatever the number of frames.
CPU = DisentangleConfig(
    steps=1400,
    decay=0.1,
    objective="H",
    beta=2.0,
    start_components=16,
    network=vae.VAEConfig(channels=(8, 16, 32, 32, 64), latents=12, linear_path=True),
)


def check_size(config: DisentangleConfig, size: tuple[int, int]) -> None:
    """Refuses images [H, W] = size that the network cannot take.

    Raises:
      ValueError: naming the size, or the number of patches if there are not so many.
    """
    vae.check_size(config.network, size)
    if config.patches is not None:
        checks.integer("patches", config.patches, most=coordinates.patch_count(size))


class Encoder(NamedTuple):
    """A trained β-VAE, and which of its latents carry anything."""

    network: vae.VAEConfig
    variables: Variables
    kl: Array  # [O] nats, on frames that it was not trained on
    active: Array  # [O] bool; the others are set to 0, the prior's mean, wherever they are used


def check_images(encoder: Encoder, size: tuple[int, int]) -> None:
    """Refuses images of another size, (H, W), than those that an encoder learnt.

    Raises:
      ValueError: naming the size.
    """
    fresh = jax.eval_shape(lambda key: vae.init(encoder.network, key, size), jax.random.key(0))
    if jax.tree.map(jnp.shape, fresh) != jax.tree.map(jnp.shape, encoder.variables):
        shown = f"{size[0]} × {size[1]}"
        raise ValueError(f"images: expected the size that the encoder learnt, got {shown}")


def training(
    config: DisentangleConfig,
    images: Callable[[], Array],
    count: int,
    held_out: Callable[[], Array],
    key: Array,
) -> Training:
    """The β-VAE's training, not yet begun.

    Args:
      config: objective and network.
      images: makes the uint8 images [n, H, W, 3] that it learns.
      count: n.
      held_out: makes others, which say which latents are active.
      key: its random choices follow from it by name.
    """

    def begin(images: Array) -> FitState:
        return initial_state(config, images, named(key, "VAE initial weights"))

    def trained(state: FitState) -> Encoder:
        mean, log_variance = encode(config.network, state.best, held_out())
        kl = jax.jit(kl_divergence)(mean, log_variance).mean(axis=0)
        return Encoder(config.network, state.best, kl, kl > ACTIVE_KL)

    return Training(objective, config, count, named(key, "VAE training"), images, begin, trained)


def initial_state(config: DisentangleConfig, images: Array, key: Array) -> FitState:
    """Fresh weights; with a linear path, it starts from the independent components of images.

    Args:
      config: network and objective.
      images: uint8 [n, H, W, 3].
      key: initial weights, and the frames that fit the linear start.
    """
    weights_key, choice_key, start_key = jax.random.split(key, 3)
    _, height, width, _ = images.shape
    variables = vae.init(config.network, weights_key, (height, width))
    if config.network.linear_path:
        count = min(_START_FRAMES, len(images))
        chosen = jax.random.choice(choice_key, len(images), (count,), replace=False)
        flat = raster.dequantize(images[chosen]).reshape(count, -1)
        linear = linear_start(flat, config.network.latents, start_key, config.start_components)
        variables["params"]["linear"] = {
            "encoder": linear.encoder,
            "decoder": linear.decoder,
            "pixel_mean": linear.mean,
        }
    return start(variables, config.average is not None)


def kl_divergence(mean: Array, log_variance: Array) -> Array:
    """[B, O] nats, of each latent's posterior from N(0, 1)."""
    return 0.5 * (mean**2 + jnp.exp(log_variance) - log_variance - 1.0)


def objective(config: DisentangleConfig) -> Loss:
    """The β-VAE loss of a config, for `fit`; data are images, uint8 [n, H, W, 3]."""

    def loss(variables: Variables, images: Array, indices: Array, key: Array, step: Array):
        _, height, width, _ = images.shape
        batch, size = raster.dequantize(images[indices]), (height, width)
        mean, log_variance, stats = vae.encode(config.network, variables, batch, train=True)
        noise_key, patch_key = (key, None) if config.patches is None else jax.random.split(key)
        latents = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(noise_key, mean.shape)
        if patch_key is None:
            decoded, stats = vae.decode(
                config.network, {**variables, "batch_stats": stats}, latents, size, train=True
            )
        else:
            order = jax.random.permutation(patch_key, coordinates.patch_count(size))
            chosen = order[: config.patches]
            decoded = vae.decode_patches(config.network, variables, latents, size, chosen)
            batch = coordinates.to_patches(batch)[:, chosen]
        squared_error = jnp.mean((2.0 * (decoded - batch)) ** 2)  # in the range [-1, 1]
        divergence = kl_divergence(mean, log_variance).sum(axis=1).mean()
        penalty = divergence
        if config.objective == "B":
            rise = jnp.minimum(1.0, step / config.capacity_steps)
            penalty = jnp.abs(divergence - config.capacity * rise)
        total = squared_error + config.beta * M_N * penalty
        return total, (stats, {"reconstruction": squared_error, "kl": divergence})

    return loss


@partial(jax.jit, static_argnames="size")
def decode(
    config: vae.VAEConfig, variables: Variables, latents: Array, size: tuple[int, int]
) -> Array:
    """Uint8 images [n, H, W, 3] of latents [n, O]; size is (H, W)."""

    def one(latents: Array) -> Array:
        drawn, _ = vae.decode(config, variables, latents[None], size, train=False)
        return raster.quantize(drawn[0])

    return jax.lax.map(one, latents, batch_size=_ENCODE_BATCH)


@jax.jit
def encode(config: vae.VAEConfig, variables: Variables, images: Array) -> tuple[Array, Array]:
    """Posterior mean and log-variance, [n, O] each, of uint8 images [n, H, W, 3]."""

    def one(image: Array) -> tuple[Array, Array]:
        mean, log_variance, _ = vae.encode(
            config, variables, raster.dequantize(image[None]), train=False
        )
        return mean[0], log_variance[0]

    return jax.lax.map(one, images, batch_size=_ENCODE_BATCH)
