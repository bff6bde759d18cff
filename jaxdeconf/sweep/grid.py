"""A sweep's grid: which fields of a config take which values, and the points that follow.

An axis is *traced* if points that differ in it run in one compiled program (`Traced` fields, what
Algorithm 1 compares with, seeds), else *static*: a program each.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax

from jaxdeconf.pipeline.config import Config

SEED, METHODS_AXIS = "seed", "methods"


class Axis(NamedTuple):
    """One field and its values."""

    name: str  # dotted, as clone.learning_rate
    values: tuple[Any, ...]


class Point(NamedTuple):
    """One config of the grid."""

    index: int
    values: dict[str, Any]  # of the axes, seed included
    config: Config


def read_axis(word: str, base: Config, parse: Callable[[str, str], Any]) -> Axis:
    """An axis from the command line's `STAGE.FIELD=VALUE,VALUE,...`.

    Args:
      word: what was said.
      base: the config that it changes.
      parse: (field, value) -> the value, as a flag would set it.
    Raises:
      ValueError: naming the axis, if there is no such field, or a value is none of its.
    """
    name, equals, values = word.partition("=")
    name = name.replace("-", "_")
    if not equals or not all(values.split(",")):
        raise ValueError(f"--grid: expected STAGE.FIELD=VALUE,VALUE,..., got {word!r}")
    default = _get(base, name)
    if "." not in name or default is _MISSING or dataclasses.is_dataclass(default):
        raise ValueError(f"--grid: expected a field as clone.learning_rate, got {name!r}")
    found = tuple(parse(name, value) for value in values.split(","))
    if len(set(found)) < len(found):
        raise ValueError(f"--grid: expected different values of {name}, got {values!r}")
    return Axis(name, found)


def points(base: Config, axes: Sequence[Axis], seeds: int) -> list[Point]:
    """Every combination, seed by seed; the index is the place in this order.

    Raises:
      ValueError: if an axis is named twice, or a combination is no valid config.
    """
    names = [axis.name for axis in axes]
    if len(set(names)) < len(names):
        raise ValueError(f"--grid: expected each field once, got {', '.join(names)}")
    found = []
    for seed in range(base.seed, base.seed + seeds):
        for values in itertools.product(*(axis.values for axis in axes)):
            changes = dict(zip(names, values, strict=True))
            config = replace(base, changes | {SEED: seed})
            found.append(Point(len(found), {SEED: seed} | changes, config))
    return found


def is_traced(axis: Axis, base: Config) -> bool:
    """Whether the axis needs no program of its own for each value."""
    stage = axis.name.partition(".")[0]
    if stage == "mask":
        return True  # a few comparisons of statistics that are computed once
    configs = [replace(base, {axis.name: value}) for value in axis.values]
    return len({jax.tree.structure(getattr(config, stage)) for config in configs}) == 1


def replace(config: Config, changes: Mapping[str, Any]) -> Config:
    """The config with dotted fields changed, all of a stage at once.

    Raises:
      ValueError: if what results is no valid config.
    """
    own, nested = {}, {}
    for name, value in changes.items():
        head, _, rest = name.partition(".")
        if rest:
            nested.setdefault(head, {})[rest] = value
        else:
            own[head] = value
    own |= {head: replace(getattr(config, head), inner) for head, inner in nested.items()}
    return dataclasses.replace(config, **own)


def shown(value: Any) -> str:
    """A field's value, for people."""
    if isinstance(value, tuple):
        return " ".join(map(shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


_MISSING = object()


def _get(config: Any, name: str) -> Any:
    for part in name.split("."):
        config = getattr(config, part, _MISSING) if dataclasses.is_dataclass(config) else _MISSING
    return config
