"""Random-latent dropout: the policy learns on reconstructions without a random part of the latents.

OREO's idea (Park et al. 2021) with a β-VAE's latents in place of codes: no latent can be relied on
alone. Nothing is dropped when the policy drives.
Shapes: N episodes, T steps, B batch, H × W pixels, L frames, O latents.
"""

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf.demos import Demos
from jaxdeconf.learn import clone, disentangle
from jaxdeconf.learn.clone import CloneConfig, Demonstrations
from jaxdeconf.learn.fit import Loss, Variables
from jaxdeconf.method import Ask, Evidence
from jaxdeconf.nets import vae
from jaxdeconf.vision import raster


def latents(demos: Demos, evidence: Evidence, _: Ask) -> Array:
    """[N, T, O] latents of every frame; 0, the prior's mean, where they carry nothing."""
    assert evidence.encoder is not None
    encoder, images = evidence.encoder, jnp.asarray(demos.images)
    flat = images.reshape(-1, *images.shape[2:])
    mean, _ = disentangle.encode(encoder.network, encoder.variables, flat)
    return jnp.where(encoder.active, mean, 0.0).reshape(*images.shape[:2], -1)


def begin(variables: Variables, evidence: Evidence, _: Array) -> Variables:
    """The policy's first variables, and the β-VAE, which the loss only reads, as "frozen"."""
    assert evidence.encoder is not None
    # A copy: a training state's buffers are given away.
    weights = jax.tree.map(jnp.copy, evidence.encoder.variables)
    return {**variables, "frozen": {"network": evidence.encoder.network, "variables": weights}}


def redrawn(frozen: Variables, latents: Array, size: tuple[int, int]) -> Array:
    """Uint8 frames [B, H, W, 3] that the β-VAE of `begin` draws of latents [B, O]."""
    drawn, _ = vae.decode(frozen["network"], frozen["variables"], latents, size, train=False)
    return raster.quantize(drawn)


def objective(config: CloneConfig) -> Loss:
    """The action's error on frames redrawn without a share `strength` of each sample's latents.

    The same latents are dropped in all L frames; data.extra are `latents`.
    """

    def loss(variables: Variables, data: Demonstrations, indices: Array, key: Array, step: Array):
        assert config.strength is not None
        size = data.frames.shape[1], data.frames.shape[2]
        kept = jax.random.bernoulli(key, 1.0 - config.strength, (len(indices), data.extra.shape[1]))
        past = [clone.ago(data, indices, steps) for steps in reversed(range(config.frames))]
        latents = jnp.concatenate([data.extra[then] * kept for then, _ in past])
        frames = jnp.split(redrawn(variables["frozen"], latents, size), config.frames)
        seen = [
            jnp.where(none[:, None, None, None], clone.blank(frame), frame)
            for frame, (_, none) in zip(frames, past, strict=True)
        ]
        error, _, stats = clone.imitate(config, variables, data, indices, clone.stack(seen))
        return error, (stats, {})

    return loss
