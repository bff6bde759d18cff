"""The β-VAE stage: train it, and use it as an encoder and a masked reconstruction.

Losses H (Higgins et al. 2017) and B (Burgess et al. 2018) in the units of PyTorch-VAE's BetaVAE,
which the paper cites: the reconstruction error is a mean over pixels of range [-1, 1], and the KL
divergence weighs β · M_N. Shapes: n frames, B batch, P pixels, O latents.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.learn.fit import FitConfig, FitState, Loss, Variables, fit, start
from jaxdeconf.learn.linear_start import linear_start
from jaxdeconf.nets import coordinates, vae
from jaxdeconf.vision import raster

# PyTorch-VAE's weight of the KL term, its batch size over its dataset's.
M_N = 0.00025
# A latent below this KL (nats) carries nothing: it is set to its prior mean wherever it is used.
ACTIVE_KL = 0.1
# Frames encoded at a time: bounds the memory of activations.
_ENCODE_BATCH = 256
# Frames that fit the linear start; its error falls as 1/sqrt(n), 1.6 % here.
_START_FRAMES = 4096


@dataclass(frozen=True)
class DisentangleConfig(FitConfig):
    """The β-VAE's training, objective and network; the defaults are the paper's for CartPole."""

    epochs: float = 100.0  # the paper's
    learning_rate: float = 0.005  # the paper's, for CartPole
    decay: float = 0.95  # the paper's
    # H: mse + β M_N KL; B: mse + β M_N |KL - C|. The paper does not say; B is its code's default,
    # and under H its β = 100 would weigh 77 squared units a nat and silence every latent.
    objective: Literal["H", "B"] = "B"
    beta: float = 100.0  # weight of the KL term; the paper's, for CartPole
    capacity: float = 25.0  # nats; B's C rises linearly to it. PyTorch-VAE's
    capacity_steps: int = 100_000  # steps of that rise; PyTorch-VAE's 1e5
    # 2×2 patches, drawn at random, that a step compares; None, the paper's, is the whole image.
    # Ours, for a CPU: a quarter of the image costs a quarter. Only with the decoder by place.
    patches: int | None = None
    # Independent components among which a linear start finds its latents; None: as many as those.
    start_components: int | None = None
    network: vae.VAEConfig = field(default_factory=vae.VAEConfig)

    TRACED: ClassVar[tuple[str, ...]] = (*FitConfig.TRACED, "beta", "capacity")

    def __post_init__(self):
        super().__post_init__()
        if self.objective not in ("H", "B"):
            raise ValueError(f"objective: expected 'H' or 'B', got {self.objective!r}")
        checks.not_negative("beta", self.beta)
        checks.not_negative("capacity", self.capacity)
        checks.integer("capacity_steps", self.capacity_steps)
        checks.instance("network", self.network, vae.VAEConfig)
        if self.start_components is not None:
            least = self.network.latents
            checks.integer("start_components", self.start_components, least=least)
        if self.patches is not None:
            checks.integer("patches", self.patches, most=self.network.patches)
            if self.network.decoder != "coordinates":
                raise ValueError(
                    f"patches: expected None for decoder 'convolutions', got {self.patches}"
                )


def initial_state(config: DisentangleConfig, images: Array, key: Array) -> FitState:
    """Fresh weights; with a linear path, it starts from the independent components of images.

    Args:
      config: network and objective.
      images: uint8 [n, 64, 64, 3].
      key: initial weights, and the frames that fit the linear start.
    """
    _check_images(config.network, images)
    checks.key("key", key)
    weights_key, choice_key, start_key = jax.random.split(key, 3)
    variables = vae.init(config.network, weights_key)
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
    return start(variables)


def kl_divergence(mean: Array, log_variance: Array) -> Array:
    """[B, O] nats, of each latent's posterior from N(0, 1)."""
    mean = checks.array("mean", mean, "[B, O]", (None, None))
    log_variance = checks.array("log_variance", log_variance, "[B, O]", mean.shape)
    return 0.5 * (mean**2 + jnp.exp(log_variance) - log_variance - 1.0)


def objective(config: DisentangleConfig) -> Loss:
    """The β-VAE loss of a config, for `fit`; data are images, uint8 [n, 64, 64, 3]."""

    def loss(variables: Variables, images: Array, indices: Array, key: Array, step: Array):
        batch = raster.dequantize(images[indices])
        mean, log_variance, stats = vae.encode(config.network, variables, batch, train=True)
        noise_key, patch_key = (key, None) if config.patches is None else jax.random.split(key)
        latents = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(noise_key, mean.shape)
        if patch_key is None:
            decoded, stats = vae.decode(
                config.network, {**variables, "batch_stats": stats}, latents, train=True
            )
        else:
            chosen = jax.random.permutation(patch_key, config.network.patches)[: config.patches]
            decoded = vae.decode_patches(config.network, variables, latents, chosen)
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


def disentangle(
    config: DisentangleConfig, state: FitState, images: Array, key: Array
) -> Iterator[tuple[FitState, dict[str, Array]]]:
    """Trains the β-VAE on images, uint8 [n, 64, 64, 3]; yields as `fit` does."""
    checks.instance("config", config, DisentangleConfig)
    _check_images(config.network, images)
    return fit(objective, state, images, len(images), key, config)


@partial(jax.jit, static_argnums=0)
def encode(config: vae.VAEConfig, variables: Variables, images: Array) -> tuple[Array, Array]:
    """Posterior mean and log-variance, [n, O] each, of uint8 images [n, 64, 64, 3]."""
    _check_images(config, images)

    def one(image: Array) -> tuple[Array, Array]:
        mean, log_variance, _ = vae.encode(
            config, variables, raster.dequantize(image[None]), train=False
        )
        return mean[0], log_variance[0]

    return jax.lax.map(one, images, batch_size=_ENCODE_BATCH)


def _check_images(config: vae.VAEConfig, images: Array) -> None:
    side = config.image_size
    checks.array("images", images, f"[n, {side}, {side}, 3]", (None, side, side, 3), of="uint8")
