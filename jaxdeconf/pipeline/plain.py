"""Typed values as what JSON has, and back: configs, results and rows, each defined once, as types.

Numbers that are not finite are null on disk, which is valid JSON, and NaN again where a float is
expected.
"""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Union, cast, get_args, get_origin, get_type_hints
from zipfile import BadZipFile

import jax
import numpy as np

# What reading a file that is not what it should be raises. Not MemoryError, nor XLA's own errors:
# they say nothing of the file.
UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError, BadZipFile, EOFError)
PARTIAL = ".partial"  # of a file that is being written


def to_plain(value: Any) -> Any:
    """Dataclasses, NamedTuples, arrays and tuples as dicts, lists and numbers."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return to_plain(value._asdict())  # type: ignore
    if isinstance(value, dict):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return to_plain(np.asarray(value).tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def from_plain(kind: Any, plain: Any) -> Any:
    """The value of a type that `to_plain` made plain.

    Args:
      kind: a dataclass, NamedTuple, array, list, tuple or dict type, a union of one with None, or
        a type that JSON has.
      plain: what JSON gave back.
    Raises:
      TypeError, ValueError, KeyError, AttributeError: if it is nothing of that type.
    """
    if get_origin(kind) in (Union, UnionType):  # of a type and None: nothing else is in use
        rest = [one for one in get_args(kind) if one is not type(None)]
        return None if plain is None else from_plain(rest[0], plain)
    if hasattr(kind, "__metadata__"):  # Annotated
        return from_plain(get_args(kind)[0], plain)
    if is_dataclass(kind) or hasattr(kind, "_fields"):
        hints, make = get_type_hints(kind, include_extras=True), cast(Any, kind)
        return make(**{name: from_plain(hints[name], value) for name, value in plain.items()})
    if kind is float:
        return math.nan if plain is None else plain
    if kind is np.ndarray:
        return np.array(plain, float) if _has_null(plain) else np.array(plain)
    if get_origin(kind) is list:
        return [from_plain(get_args(kind)[0], value) for value in plain]
    if get_origin(kind) is tuple:
        return tuple(plain)
    if get_origin(kind) is dict:
        return {key: from_plain(get_args(kind)[1], value) for key, value in plain.items()}
    return plain


def _has_null(plain: Any) -> bool:
    return plain is None or (isinstance(plain, list) and any(map(_has_null, plain)))


def write_json(file: Path, value: Any) -> None:
    """Replaces a JSON file in one step: a reader, or a crash, finds the old or the new one."""
    partial = file.with_name(file.name + PARTIAL)
    text = json.dumps(to_plain(value), indent=1, allow_nan=False)
    partial.write_text(text + "\n", encoding="utf-8")
    os.replace(partial, file)


def write_arrays(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Replaces an npz file of arrays, as `write_json` does."""
    partial = file.with_name(file.name + PARTIAL)
    named: dict[str, Any] = dict(arrays)
    with partial.open("wb") as opened:
        np.savez_compressed(opened, **named)
    os.replace(partial, file)
