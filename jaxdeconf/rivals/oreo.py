"""OREO: in training, all places of a random half of a VQ-VAE's codes are dropped from the map.

J. Park et al. (2021), "Object-aware regularization for addressing causal confusion in imitation
learning", NeurIPS 2021: codes stand for objects, and no single one can then carry the policy.
Theirs clones on the VQ-VAE's own encoder, with five drops a sample; here the policy's network is
the usual one, a ResNet cut to where its map has the codes' size, with one drop a sample.
Shapes: B batch, L frames, h × w places, K codes.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Demonstrations
from jaxdeconf.learn.fit import Loss, Variables
from jaxdeconf.rivals.controls import dropping

_STAGES = {"imagenet": 2, "cifar": 4}  # by stem: those whose last map has an eighth of the side
_MOST = 256  # codes that a byte tells apart


def on_a_map(config: CloneConfig) -> CloneConfig:
    """The policy's network; a ResNet is cut to the stages whose last map has the codes' size."""
    if config.network.kind != "resnet":
        return config
    stages = _STAGES[config.network.stem]
    return replace(config, network=replace(config.network, stages=stages))


def dropping_codes(config: CloneConfig) -> CloneConfig:
    """The same, for a share of codes that may be dropped."""
    return on_a_map(dropping(config))


def places_kept(codes: Array, none: Array, kept: Array) -> Array:
    """Which places are kept: those whose codes are kept in all L frames.

    Args:
      codes: [L, B, h, w] of a sample's frames.
      none: [L, B] bool, True where there is no such frame; it then drops nothing.
      kept: [B, K] bool, the codes that a sample keeps, the same for all its frames.
    Returns:
      [B, h, w] bool.
    """

    def look_up(kept: Array, codes: Array) -> Array:
        return kept[codes]

    of_frames = jax.vmap(jax.vmap(look_up), (None, 0))(kept, codes)
    return (of_frames | none[..., None, None]).all(axis=0)


def objective(config: CloneConfig) -> Loss:
    """The action's error, a share `strength` of the codes dropped; data.extra are `codes.codes`.

    What is kept of the map is scaled by the share of places that the batch keeps.
    """

    def loss(variables: Variables, data: Demonstrations, indices: Array, key: Array, step: Array):
        assert config.strength is not None
        past = [clone.ago(data, indices, steps) for steps in range(config.frames)]
        codes = jnp.stack([data.extra[then] for then, _ in past])
        none = jnp.stack([none for _, none in past])
        kept = jax.random.bernoulli(key, 1.0 - config.strength, (len(indices), _MOST))
        mask = places_kept(codes, none, kept)
        share = jnp.maximum(mask.mean(), 1.0 / mask.size)

        def gate(x: Array) -> Array:
            shape = (*x.shape[:3], 1)  # of a finer map each code drops a block
            kept = jax.image.resize((mask / share)[..., None], shape, "nearest")
            return x * kept.astype(x.dtype)

        images = clone.stacked(config, data, indices)
        error, _, stats = clone.imitate(config, variables, data, indices, images, gate)
        return error, (stats, {"places kept": share})

    return loss
