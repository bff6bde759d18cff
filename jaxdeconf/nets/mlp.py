"""A plain network of linear layers with ReLU between them. Shapes: B batch."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array

# One a layer: {"kernel": [inputs, outputs], "bias": [outputs]}
Layers = list[dict[str, Array]]


def init(key: Array, sizes: Sequence[int]) -> Layers:
    """Fresh weights (He et al. 2015), of inputs, hidden layers and outputs of these sizes."""
    keys = jax.random.split(key, len(sizes) - 1)

    def layer(key: Array, inputs: int, outputs: int) -> dict[str, Array]:
        scale = (2.0 / max(1, inputs)) ** 0.5
        kernel = scale * jax.random.normal(key, (inputs, outputs))
        return {"kernel": kernel, "bias": jnp.zeros(outputs)}

    return [layer(*of) for of in zip(keys, sizes[:-1], sizes[1:], strict=True)]


def apply(layers: Layers, x: Array) -> Array:
    """[B, outputs] of x [B, inputs]."""
    for layer in layers[:-1]:
        x = jax.nn.relu(x @ layer["kernel"] + layer["bias"])
    return x @ layers[-1]["kernel"] + layers[-1]["bias"]
