"""What a policy is shown: a view maps the frames of a trajectory to those that the network sees.

The methods are one `clone` on different views of the same frames (paper, Section V-B). A view is
cached by what it is made of: the same view is the same static argument, and compiles once.
"""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.learn.fit import Variables
from jaxdeconf.nets import vae
from jaxdeconf.systems.system import Nuisance
from jaxdeconf.vision import raster

# (parameters of the view, images uint8 [B, 64, 64, 3]) -> images uint8 [B, 64, 64, 3]
View = Callable[[Variables, Array], Array]


def identity(_: Variables, images: Array) -> Array:
    """BcVanilla: the frames as they are."""
    return images


@cache
def covered(nuisance: Nuisance) -> View:
    """BcManual: a white cover over the nuisance, by a human who knows where it is."""
    if not callable(getattr(nuisance, "cover", None)):
        raise ValueError(f"nuisance: expected one with a method `cover`, got {nuisance!r}")

    def view(_: Variables, images: Array) -> Array:
        return raster.quantize(jax.vmap(nuisance.cover)(raster.dequantize(images)))

    return view


@cache
def reconstructed(config: vae.VAEConfig) -> View:
    """The β-VAE's reconstruction of the latents that are kept.

    Its parameters are {"variables": of the β-VAE, "keep": [O] bool}: Masked keeps the active
    latents that the mask leaves, Reconstructed all active ones. Every other latent is set to its
    prior mean.
    """
    checks.instance("config", config, vae.VAEConfig)

    def view(parameters: Variables, images: Array) -> Array:
        variables = parameters["variables"]
        mean, _, _ = vae.encode(config, variables, raster.dequantize(images), train=False)
        latents = jnp.where(parameters["keep"], mean, 0.0)
        return raster.quantize(vae.decode(config, variables, latents, train=False)[0])

    return view
