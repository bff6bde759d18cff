"""Pre-activation ResNet-18 (He et al. 2016, "Identity Mappings in Deep Residual Networks").

Two plain functions, `init` and `apply`, hide Flax; the variables are plain pytrees that vmap over
models. Shapes: B batch, H × W pixels, C channels (3 a frame, L frames stacked), A action.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from jaxdeconf import checks
from jaxdeconf.nets import layers
from jaxdeconf.nets.cpu import max_pool
from jaxdeconf.nets.initial import draw
from jaxdeconf.nets.layers import Variables, dense
from jaxdeconf.traced import traceable

_conv = partial(layers.conv, use_bias=False)


@traceable
@dataclass(frozen=True)
class ResNetConfig:
    """Shape of the network; hashable, so it can be a static argument of jit.

    Raises:
      ValueError: for a width below one or an unknown stem, norm or dtype.
    """

    width: int = 64  # He et al.: channels of the first stage; the next ones double it
    # "cifar": 3×3, full resolution (the usual pre-activation form, 11.17 M parameters).
    # "imagenet": 7×7 stride 2 and a 3×3 stride 2 max-pool; about nine times cheaper, for a CPU.
    stem: Literal["cifar", "imagenet"] = "cifar"
    norm: Literal["batch", "none"] = "batch"  # He et al.: batch normalisation
    dtype: Literal["float32", "bfloat16"] = "float32"  # of activations; parameters stay float32
    stages: int = 4  # He et al.; fewer keep the last one's resolution high
    # What becomes of the last stage's channels. "mean": of each over the image, He et al.'s.
    # "spatial_softmax": where each is high, as expected x and y under a softmax over the image
    # (Levine et al. 2016): positions, where the policy needs no classes.
    pool: Literal["mean", "spatial_softmax"] = "mean"
    hidden: tuple[int, ...] = ()  # widths of layers between pool and output; He et al.: none

    def __post_init__(self):
        checks.integer("width", self.width)
        checks.one_of("stem", self.stem, ("cifar", "imagenet"))
        checks.integer("stages", self.stages, most=4)
        checks.one_of("pool", self.pool, ("mean", "spatial_softmax"))
        if not isinstance(self.hidden, tuple):
            raise ValueError(f"hidden: expected a tuple of positive integers, got {self.hidden!r}")
        for width in self.hidden:
            checks.integer("hidden", width)
        checks.one_of("norm", self.norm, ("batch", "none"))
        checks.one_of("dtype", self.dtype, ("float32", "bfloat16"))


def init(
    config: ResNetConfig, key: Array, input_shape: tuple[int, int, int], outputs: int
) -> Variables:
    """Fresh variables.

    Args:
      config: the network's shape.
      key: PRNG key.
      input_shape: (H, W, C) of one image; C = 3·L for L stacked frames.
      outputs: A, the number of regressed action components.
    Returns:
      {"params": ..., "batch_stats": ...}; `batch_stats` is empty without batch normalisation.
    """
    shapes = jax.eval_shape(
        lambda: _ResNet(config, outputs).init(key, jnp.zeros((1, *input_shape)), train=False)
    )
    variables = draw(shapes, key, gain=2)
    return {"params": variables["params"], "batch_stats": variables.get("batch_stats", {})}


def apply(
    config: ResNetConfig, variables: Variables, images: Array, train: bool
) -> tuple[Array, Any]:
    """The network's outputs, and its running statistics after this batch.

    Args:
      config: the one given to `init`.
      variables: what `init` returned, or trained from it.
      images: [B, H, W, C] float in [0, 1]; mapped to [-1, 1] inside.
      train: normalise by the batch's statistics and update the running ones (True), or use the
        running ones as they are (False). Static.
    Returns:
      [B, A] float32 outputs, and the `batch_stats` to carry on with (unchanged if not `train`).
    """
    outputs, _, batch_stats = look(config, variables, images, train)
    return outputs, batch_stats


def look(
    config: ResNetConfig,
    variables: Variables,
    images: Array,
    train: bool,
    gate: Callable[[Array], Array] | None = None,
) -> tuple[Array, Array, Any]:
    """What `apply` returns, and between the two the features [B, F] that the last layer is given.

    Args:
      config, variables, images, train: as in `apply`.
      gate: of the last map [B, h, w, channels], just before it is pooled, to one of that shape.
    """
    outputs = variables["params"]["head"]["bias"].shape[0]
    network = _ResNet(config, outputs)
    (out, features), batch_stats = layers.run(network, variables, images, train, gate=gate)
    return out, features, batch_stats


def spatial_softmax(x: Array) -> Array:
    """[B, 2 C] expected (x, y), each in [-1, 1], under a softmax of [B, H, W, C] over the image."""
    batch, height, width, channels = x.shape
    share = jax.nn.softmax(x.reshape(batch, -1, channels), axis=1).reshape(x.shape)
    columns, rows = (jnp.linspace(-1.0, 1.0, size, dtype=x.dtype) for size in (width, height))
    across = jnp.einsum("bhwc,w->bc", share, columns)
    down = jnp.einsum("bhwc,h->bc", share, rows)
    return jnp.concatenate([across, down], axis=1)


def _norm_relu(config: ResNetConfig, x: Array, train: bool, name: str) -> Array:
    return nn.relu(layers.norm(config, x, train, name))


class _Block(nn.Module):
    """Twice BN, ReLU, 3×3, plus a shortcut: 1×1 from the activated input if shapes change."""

    config: ResNetConfig
    features: int
    stride: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        activated = _norm_relu(self.config, x, train, "norm_1")
        shortcut = x
        if self.stride != 1 or x.shape[-1] != self.features:
            shortcut = _conv(self.config, self.features, 1, "shortcut", self.stride)(activated)
        y = _conv(self.config, self.features, 3, "conv_1", self.stride)(activated)
        y = _norm_relu(self.config, y, train, "norm_2")
        return shortcut + _conv(self.config, self.features, 3, "conv_2")(y)


class _ResNet(nn.Module):
    config: ResNetConfig
    outputs: int

    @nn.compact
    def __call__(self, images: Array, train: bool, gate: Any = None) -> tuple[Array, Array]:
        width = self.config.width
        x = 2 * images - 1
        if self.config.stem == "cifar":
            x = _conv(self.config, width, 3, "stem")(x)
        else:
            x = max_pool(_conv(self.config, width, 7, "stem", stride=2)(x))
        for stage, stride in enumerate((1, 2, 2, 2)[: self.config.stages]):
            for block in range(2):
                x = _Block(
                    self.config,
                    features=width * 2**stage,
                    stride=stride if block == 0 else 1,
                    name=f"stage_{stage + 1}_block_{block + 1}",
                )(x, train)
        x = _norm_relu(self.config, x, train, "norm")
        x = x if gate is None else gate(x)
        x = spatial_softmax(x) if self.config.pool == "spatial_softmax" else x.mean((1, 2))
        for i, features in enumerate(self.config.hidden, 1):
            x = nn.relu(dense(self.config, features, f"hidden_{i}")(x))
        return dense(self.config, self.outputs, "head")(x), x
