"""A VQ-VAE's training on frames, and the codes of each frame.

The objective is van den Oord et al.'s (2017), as Park et al. (2021) have it: the reconstruction's
error over the data's variance, the codes' distance from what takes them, and a quarter of that
distance the other way. Shapes: N episodes, T steps, n frames, H × W pixels, K codes.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.demos import Demos
from jaxdeconf.keys import named
from jaxdeconf.learn.fit import FitConfig, FitState, Loss, Training, Variables, start
from jaxdeconf.method import Ask, Evidence
from jaxdeconf.nets import vq
from jaxdeconf.traced import Traced, traceable
from jaxdeconf.vision import raster

_COMMITMENT = 0.25  # van den Oord et al., Park et al.
_FIRST = 256  # frames, at random, at whose places the codes begin
_ENCODE_BATCH = 256  # frames encoded at a time: bounds the memory of activations


@traceable
@dataclass(frozen=True)
class CodesConfig(FitConfig):
    """The VQ-VAE's training; ours, for a CPU, in minutes. Park et al.: 1000 epochs of batches of
    1024 with a rate of 3e-4."""

    steps: int | None = 1250
    batch_size: int = 32
    learning_rate: Traced = 1e-3  # ten times that, and a code or two are left in use
    decay: Traced = 0.1
    network: vq.VQConfig = field(default_factory=vq.VQConfig)


# The same whatever the policy's budget: it is then one VQ-VAE for a set of demonstrations.
CONFIG = CodesConfig()


def objective(config: CodesConfig) -> Loss:
    """The VQ-VAE's loss, for `fit`; data are frames, uint8 [n, H, W, 3]."""

    def loss(variables: Variables, frames: Array, indices: Array, key: Array, step: Array):
        images = raster.dequantize(frames[indices])
        maps = vq.encode(config.network, variables, images)
        codes = vq.nearest(variables, maps)
        taken = variables["params"]["codes"][codes]
        drawn = vq.decode(config.network, variables, vq.straight_through(maps, taken))
        error = ((drawn - images) ** 2).mean() / images.var()
        learnt = ((taken - jax.lax.stop_gradient(maps)) ** 2).mean()
        commitment = ((maps - jax.lax.stop_gradient(taken)) ** 2).mean()
        used = vq.perplexity(codes, config.network.codes)
        metrics = {"reconstruction": error, "perplexity": used}
        return error + learnt + _COMMITMENT * commitment, ({}, metrics)

    return loss


def training(config: CodesConfig, frames: Callable[[], Array], count: int, key: Array) -> Training:
    """The VQ-VAE's training on uint8 frames [n, H, W, 3], not yet begun; its variables come of it.

    Args:
      config: objective and network.
      frames: makes them.
      count: n.
      key: its random choices follow from it by name.
    """

    def begin(frames: Array) -> FitState:
        weights_key, choice_key = jax.random.split(named(key, "VQ-VAE initial weights"))
        chosen = jax.random.permutation(choice_key, count)[:_FIRST]
        init = jax.jit(vq.init, static_argnums=0)
        return start(init(config.network, weights_key, raster.dequantize(frames[chosen])))

    shuffles = named(key, "VQ-VAE training")
    return Training(
        objective, config, count, shuffles, frames, begin, lambda state: state.variables
    )


def codes(demos: Demos, _: Evidence, ask: Ask) -> Array:
    """[N, T, H/8, W/8] uint8 the codes of every frame, by a VQ-VAE that learns these frames.

    Raises:
      ValueError: if the images' size is no multiple of 8.
    """
    config, shape = CONFIG, np.shape(demos.images)
    vq.check_size(shape[2:4])
    within = np.ones(shape[:2], bool) if demos.valid is None else np.asarray(demos.valid)

    def frames() -> Array:
        return jnp.asarray(demos.images)[within]

    asked = training(config, frames, int(within.sum()), ask.key)
    variables = asked.trained(ask.watch("codes", asked))
    flat = jnp.asarray(demos.images).reshape(-1, *shape[2:])
    found = taken(config.network, variables, flat)
    return found.reshape(*shape[:2], *found.shape[1:])


@jax.jit
def taken(network: vq.VQConfig, variables: Variables, frames: Array) -> Array:
    """[n, H/8, W/8] uint8 the codes of uint8 frames [n, H, W, 3]."""

    def one(frame: Array) -> Array:
        maps = vq.encode(network, variables, raster.dequantize(frame[None]))
        return vq.nearest(variables, maps)[0].astype(jnp.uint8)

    return jax.lax.map(one, frames, batch_size=_ENCODE_BATCH)
