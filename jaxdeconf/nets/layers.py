"""What the ResNet and the VAE are made of: Flax layers by a config's `norm` and `dtype`."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from jaxdeconf.nets.cpu import conv_general_dilated

Variables = dict[str, Any]  # {"params": trained, "batch_stats": carried along}
Config = Any  # a network's: its `norm` is "batch" or "none", its `dtype` one of activations


def conv(
    config: Config, features: int, side: int, name: str, stride: int = 1, **options
) -> nn.Conv:
    """A convolution, padded alike on all sides unless the options of `nn.Conv` say otherwise."""
    options = {"padding": side // 2, **options}
    return nn.Conv(
        features,
        (side, side),
        (stride, stride),
        dtype=jnp.dtype(config.dtype),
        conv_general_dilated=conv_general_dilated,
        name=name,
        **options,
    )


def dense(config: Config, features: int, name: str) -> nn.Dense:
    """A linear layer."""
    return nn.Dense(features, dtype=jnp.dtype(config.dtype), name=name)


def answer(config: Config, outputs: int, x: Array) -> tuple[Array, Array]:
    """A network's end: the config's hidden layers, and a last one, `head`, of so many outputs.

    Returns:
      The outputs, and what the last layer was given.
    """
    for i, features in enumerate(config.hidden, 1):
        x = nn.relu(dense(config, features, f"hidden_{i}")(x))
    return dense(config, outputs, "head")(x), x


def norm(config: Config, x: Array, train: bool, name: str) -> Array:
    """Batch normalisation, or x itself where the config wants none."""
    if config.norm == "none":
        return x
    return nn.BatchNorm(
        use_running_average=not train, momentum=0.9, dtype=jnp.dtype(config.dtype), name=name
    )(x)


def run(
    module: nn.Module, variables: Variables, x: Array, train: bool, **options
) -> tuple[Any, Any]:
    """A module's outputs, as float32, and its `batch_stats` after this batch."""
    out, updates = module.apply(variables, x, train=train, mutable=["batch_stats"], **options)
    out = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), out)
    return out, updates.get("batch_stats", {})
