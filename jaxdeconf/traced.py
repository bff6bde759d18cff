"""Configs as pytrees: a field of type `Traced` is a leaf, every other one is structure.

So it is said once, by type, which numbers may differ between models of one compiled program: two
configs train together if `jax.tree.structure` of them is equal, and a `jit` that is handed a config
compiles once for all learning rates. A leaf may be traced, so no code may branch on it.
"""

from dataclasses import fields
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import jax

_MARK = "a leaf"
Traced = Annotated[float, _MARK]
Config = TypeVar("Config", bound=type)


def traceable(config: Config) -> Config:
    """Registers a frozen dataclass as a pytree; for `Traced | None`, None is structure, too.

    Unflattened, it is not checked again: its leaves may be tracers, or anything that a
    transformation puts in their place.
    """
    hints = get_type_hints(config, include_extras=True)
    names = [field.name for field in fields(config)]
    leaves = [name for name in names if _is_traced(hints[name])]
    rest = [name for name in names if name not in leaves]

    def flatten(value: Any) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(value, name) for name in leaves], tuple(getattr(value, n) for n in rest)

    def unflatten(structure: tuple[Any, ...], values: Any) -> Any:
        new = object.__new__(config)
        new.__dict__.update(zip((*rest, *leaves), (*structure, *values), strict=True))
        return new

    jax.tree_util.register_pytree_node(config, flatten, unflatten)
    return config


def _is_traced(hint: Any) -> bool:
    return _MARK in getattr(hint, "__metadata__", ()) or any(map(_is_traced, get_args(hint)))
