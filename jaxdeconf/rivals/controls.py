"""What is tried before any method: less history, holes in the frames, dropout, a longer training.

Shapes: B batch, H × W pixels, L frames.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Demonstrations
from jaxdeconf.learn.fit import Loss, Variables

_LONGER = 2.5  # times as many samples
# A square's side, of the image's shorter one; 10 to 30 of 84 pixels in Park et al. (2021).
_SIDES = 0.12, 0.36


def of_one_frame(config: CloneConfig) -> CloneConfig:
    """A policy that sees the present frame alone."""
    return replace(config, frames=1)


def longer(config: CloneConfig) -> CloneConfig:
    """2.5 times the samples, the learning rate falling as far as it would have, as much slower."""
    if config.steps is not None:  # the decay is then over all of them
        return replace(config, steps=round(_LONGER * config.steps))
    decay = config.decay ** (1 / _LONGER)
    return replace(config, epochs=_LONGER * config.epochs, decay=decay)


def dropping(config: CloneConfig) -> CloneConfig:
    """The config as it is.

    Raises:
      ValueError: if its strength is no share that may be dropped, in [0, 1).
    """
    checks.number("strength", config.strength, "a share in [0, 1)", -1e-300, below=1.0)
    return config


def cutout(images: Array, key: Array) -> Array:
    """Images [B, H, W, 3 L] with a square each, the same in all L frames, of the batch's mean grey.

    Cutout (DeVries & Taylor 2017), whose squares lie within the image and differ in size.
    """
    batch, height, width, _ = images.shape
    side_key, top_key, left_key = jax.random.split(key, 3)
    low, high = (share * min(height, width) for share in _SIDES)
    side = jnp.round(jax.random.uniform(side_key, (batch, 1), minval=low, maxval=high))

    def inside(size: int, key: Array) -> Array:
        """[B, size] bool, along one axis."""
        first = jnp.floor(jax.random.uniform(key, (batch, 1)) * (size - side + 1))
        place = jnp.arange(size)
        return (place >= first) & (place < first + side)

    square = inside(height, top_key)[:, :, None] & inside(width, left_key)[:, None, :]
    return jnp.where(square[..., None], images.mean(), images)


def cutout_objective(config: CloneConfig) -> Loss:
    """The action's error on frames with a square cut out."""

    def loss(variables: Variables, data: Demonstrations, indices: Array, key: Array, step: Array):
        images = cutout(clone.stacked(config, data, indices), key)
        error, _, stats = clone.imitate(config, variables, data, indices, images)
        return error, (stats, {})

    return loss


def dropout(x: Array, share: Array | float, key: Array) -> Array:
    """x without a share of its numbers, the others larger by as much (Srivastava et al. 2014)."""
    return jnp.where(jax.random.bernoulli(key, 1.0 - share, x.shape), x / (1.0 - share), 0.0)


def dropout_objective(config: CloneConfig) -> Loss:
    """The action's error, a share `strength` of the last map's numbers dropped before its pool."""

    def loss(variables: Variables, data: Demonstrations, indices: Array, key: Array, step: Array):
        images, share = clone.stacked(config, data, indices), config.strength
        assert share is not None

        def gate(x: Array) -> Array:
            return dropout(x, share, key)

        error, _, stats = clone.imitate(config, variables, data, indices, images, gate)
        return error, (stats, {})

    return loss
