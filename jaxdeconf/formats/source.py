"""What every reader gives: an opened dataset whose frames have not been read yet.

Shapes: N episodes, n steps of all, T steps of one, H × W pixels, A action, S state.
"""

import contextlib
import importlib
import json
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np

from jaxdeconf import checks

# From uint8 RGB frames [T, H, W, 3] to the same.
Redraw = Callable[[np.ndarray], np.ndarray]

_DAMAGE = (OSError, BadZipFile, EOFError, zlib.error, struct.error)
_NOT_DATA = {
    b"version https://git-lfs": "a Git LFS pointer; fetch the file itself with `git lfs pull`",
    b"<!doctype html": "a web page; download the file itself",
    b"<html": "a web page; download the file itself",
}


@dataclass(frozen=True)
class Names:
    """What of a dataset to take; None: what its format calls so."""

    frames: str | None = None  # the camera's key
    actions: str | None = None
    initial_states: str | None = None  # a key, or a file NAME.npy of [N, S]


class Source(NamedTuple):
    """A dataset: its numbers, and its frames an episode at a time."""

    lengths: np.ndarray  # [N] steps
    actions: np.ndarray  # [n, A], of all episodes one after another, in the data's own units
    limit: np.ndarray | None  # [A] no action is larger; None: nobody says so
    initial_states: np.ndarray | None  # [N, S]
    state_names: list[str]  # [S]
    frames: str  # the camera's key
    size: tuple[int, int]  # (H, W)
    episodes: Callable[[], Iterator[np.ndarray]]  # uint8 [T, H, W, 3], one after another
    write: Callable[[Path, Redraw], None]  # the same dataset at a new path, its frames redrawn
    notes: tuple[str, ...] = ()  # sentences on what was taken, where that is not obvious


def choose(path: Path, what: str, asked: str | None, found: Iterable[str], there: Iterable[str]):
    """The key that is asked for, or the only one that may be meant.

    Args:
      path: of the dataset.
      what: the flag's name.
      asked: the key, or None.
      found: those that may be meant.
      there: all keys.
    Raises:
      ValueError: if it is not there, or several may be meant.
    """
    found, there = list(found), list(there)
    if asked is None and len(found) == 1:
        return found[0]
    if asked in there:
        return asked
    if asked is not None or not found:
        expected = asked or f"{what.replace('-', ' ')}"
        raise ValueError(f"{path}: expected {expected}, got only {_few(there)}; say --{what} KEY")
    raise ValueError(f"{path}: expected one --{what} of {_few(found)}, got none")


def _few(names: list[str]) -> str:
    more = f" and {len(names) - 12} more" if len(names) > 12 else ""
    return (", ".join(names[:12]) + more) or "nothing"


def library(path: Path, module: str, extra: str) -> Any:
    """A module that reads a format, imported late.

    Raises:
      ValueError: if it is not installed; says how to.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        name = module.partition(".")[0]
        raise ValueError(
            f"{path}: expected {name} to read it, got none; pip install 'jaxdeconf[{extra}]'"
        ) from None


@contextlib.contextmanager
def reading(path: Path, kind: str, *damage: type[Exception]) -> Iterator[None]:
    """Says in one line what is wrong with a file that cannot be read as what it should be.

    Args:
      path: of the file.
      kind: what it should be.
      damage: what else its reader raises for a damaged one.
    """
    try:
        yield
    except (*_DAMAGE, *damage) as error:
        raise ValueError(f"{path}: expected {kind}, got {lies_there(path)}") from error


def read_json(path: Path) -> Any:
    """What a JSON file holds."""
    with reading(path, "a JSON file", json.JSONDecodeError):
        return json.loads(path.read_text(encoding="utf-8"))


def lies_there(path: Path) -> str:
    """What a file that cannot be read seems to be."""
    if not path.exists():
        return "no file of that name"
    if path.is_dir():
        return f"a folder of {_few(sorted(entry.name for entry in path.iterdir()))}"
    with path.open("rb") as file:
        head = file.read(64).lstrip().lower()
    known = (words for start, words in _NOT_DATA.items() if head.startswith(start))
    return next(known, f"{path.stat().st_size} bytes that are damaged, cut off or something else")


def states_of(asked: str | None, count: int) -> np.ndarray | None:
    """Initial states [N, S] of a file of their own, if that is asked for.

    Raises:
      ValueError: if it cannot be read, or has not a row an episode.
    """
    if asked is None or not asked.endswith(".npy"):
        return None
    path = Path(asked)
    with reading(path, "an npy file"):
        try:
            values = np.load(path)
        except ValueError as error:  # of objects, or no npy file at all
            raise ValueError(
                f"{path}: expected numbers [N, S] in an npy file, got {error}"
            ) from None
    return checks.array(str(path), values, f"[{count}, S]", (count, None))


def bounds(lengths: np.ndarray) -> Iterator[tuple[int, int]]:
    """(first, end) of each episode."""
    ends = np.cumsum(lengths)
    yield from zip((ends - lengths).tolist(), ends.tolist(), strict=True)


def is_camera(shape: tuple[int, ...], dtype: Any) -> bool:
    """Whether an array [T, ...] may hold a camera's frames."""
    channels = len(shape) == 4 and (shape[-1] in (1, 3, 4) or shape[1] in (1, 3, 4))
    return channels and min(sorted(shape[1:])[1:]) >= 16 and np.dtype(dtype).kind in "uf"
