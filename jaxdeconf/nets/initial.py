"""Initial variables from one random draw; a draw a layer takes XLA most of a minute to compile."""

from math import prod
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


def draw(shapes: Any, key: Array, gain: float, silent: tuple[str, ...] = ()) -> Any:
    """Fill the variables that Flax describes.

    Args:
      shapes: what `jax.eval_shape` returned for a module's `init`.
      key: PRNG key.
      gain: a kernel's entries are normal with variance gain / fan-in: 2 for ReLU (He et al. 2015),
        1 to keep a linear layer's variance (LeCun et al. 1998).
      silent: names of layers whose kernels are zero.
    Returns:
      The same tree: kernels drawn, normalisation at scale and variance one, all else zero.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(shapes)
    kernels = [leaf.shape for path, leaf in leaves if path[-1].key == "kernel"]
    normal = jax.random.normal(key, (sum(map(prod, kernels)),))
    filled, used = [], 0
    for path, leaf in leaves:
        value = jnp.zeros(leaf.shape)
        if path[-1].key in ("scale", "var"):
            value = jnp.ones(leaf.shape)
        elif path[-1].key == "kernel":
            if path[-2].key not in silent:
                deviation = (gain / prod(leaf.shape[:-1])) ** 0.5
                value = deviation * normal[used : used + prod(leaf.shape)].reshape(leaf.shape)
            used += prod(leaf.shape)
        filled.append(value)
    return jax.tree.unflatten(structure, filled)
