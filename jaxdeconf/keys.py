"""Random keys by name: every random choice has one, and its name stands in one place."""

import zlib

import jax
from jax import Array


def named(key: Array, name: str) -> Array:
    """The key of a named random choice: same key and name, same choice."""
    return jax.random.fold_in(key, zlib.crc32(name.encode()))
