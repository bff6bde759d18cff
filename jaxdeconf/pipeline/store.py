"""A run directory: its config, its checkpoints, and nothing that is not on disk.

    DIR/config.json                      what was asked for, and of which version of jaxdeconf
    DIR/checkpoints/STAGE/STEP/          the latest state of each stage, and its notes
    DIR/results.json, report.html, ...   written at the end

A checkpoint notes which run it belongs to and what it was made from, so that none is ever taken for
another's.
"""

import contextlib
import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdeconf import __version__
from jaxdeconf.pipeline import checkpoint
from jaxdeconf.pipeline.config import Config

_PARTIAL = ".partial"  # of a file that is being written


class StoreError(RuntimeError):
    """A run directory cannot be used; the message names the file and what to do."""


class WriteError(RuntimeError):
    """A run in progress cannot write; the message names the file and what to do."""


class Store:
    """Saves and loads the stages of one run."""

    def __init__(self, directory: Path, config: Config, resume: bool, home: Path | None = None):
        """Opens a run directory.

        Args:
          directory: made if need be.
          config: what the run is to do.
          resume: whether it goes on with what is there; the config must then be the same.
          home: what --resume goes on with, if not the directory: the sweep that it is a part of.
        Raises:
          StoreError: if the directory holds a run or anything else and `resume` is not asked for,
            if it holds no run and it is, if the configs or the versions differ, or if it cannot be
            written.
        """
        self.directory = directory
        self._home = home or directory
        self.saved_at = time.monotonic()  # when it last saved
        self._fingerprints: dict[str, str] = {}  # of the stages loaded or saved so far
        file, wanted = directory / "config.json", to_plain(asdict(config))
        self._identity = hashlib.sha256(json.dumps([__version__, wanted]).encode()).hexdigest()
        if resume:
            changed = _differences(to_plain(asdict(read_config(directory))), wanted)
            if changed:
                raise StoreError(
                    f"{file}: resumed with another config: {', '.join(changed)}; "
                    "leave those flags out, or start a new run with --out"
                )
            return
        require_empty(directory)
        try:
            directory.mkdir(parents=True, exist_ok=True)
            write_config(directory, config)
        except OSError as error:
            raise StoreError(
                f"{directory}: cannot be written ({error.strerror}); use another --out"
            ) from error

    def save(
        self,
        stage: str,
        step: int,
        state: Any,
        notes: dict[str, Any],
        made_from: Sequence[str] = (),
    ) -> None:
        """Makes `state`, a pytree of jax arrays, the stage's latest.

        Args:
          stage: its name.
          step: higher than that of the stage's last save.
          state: what is saved.
          notes: values for JSON, beside it.
          made_from: the stages, loaded or saved before, that it follows from.
        Raises:
          WriteError: if the disk does not take it; what was saved before is still there.
        """
        self._fingerprints[stage] = checkpoint.fingerprint(state)
        notes = {
            "run": self._identity,
            "fingerprint": self._fingerprints[stage],
            "made_from": self._ancestors(made_from),
            "notes": to_plain(notes),
        }
        folder = self._folder(stage) / str(step)
        try:
            checkpoint.write(folder, state, notes)
        except Exception as error:
            raise _write_error(self._home, folder, error) from error
        self.saved_at = time.monotonic()

    def load(
        self, stage: str, template: Callable[[], Any], made_from: Sequence[str] = ()
    ) -> tuple[Any, dict[str, Any]] | None:
        """The stage's latest state and notes, or None if it has none.

        Args:
          stage: its name.
          template: makes such a state; it is only traced, and only if there is one to load.
          made_from: as it was saved with.
        Raises:
          StoreError: if what is there is damaged, is of another run, or was made from other
            numbers than the stages that it follows from hold by now.
        """
        folder = checkpoint.latest(self._folder(stage))
        if folder is None:
            return None
        try:
            notes = checkpoint.read_notes(folder)
            self._check(notes, made_from)
            state = checkpoint.read_state(folder, template)
            if checkpoint.fingerprint(state) != notes["fingerprint"]:
                raise ValueError("its arrays are not of the types that were saved")
        except Exception as error:
            raise StoreError(
                f"{folder}: not a checkpoint of this run ({_cause(error)}); "
                f"delete {folder.parent} to redo the stage"
            ) from error
        self._fingerprints[stage] = notes["fingerprint"]
        return state, notes["notes"]

    def _check(self, notes: dict[str, Any], made_from: Sequence[str]) -> None:
        if notes["run"] != self._identity:
            raise ValueError("made with another config, or another version, than config.json says")
        for stage, now in self._ancestors(made_from).items():
            if notes["made_from"].get(stage) != now:
                raise ValueError(f"made from another {stage} than is there now")

    def _ancestors(self, stages: Sequence[str]) -> dict[str, str]:
        return {stage: self._fingerprints[stage] for stage in stages}

    def _folder(self, stage: str) -> Path:
        return self.directory.absolute() / "checkpoints" / stage


class Nowhere(Store):
    """A store that keeps nothing."""

    def __init__(self) -> None:
        """Of no directory."""
        self.saved_at = time.monotonic()

    def save(self, *_: Any, **__: Any) -> None:
        """Forgets it."""

    def load(self, *_: Any, **__: Any) -> None:
        """Has none."""


@contextlib.contextmanager
def writing(directory: Path) -> Iterator[None]:
    """Turns what keeps a run's files from being written into a WriteError."""
    try:
        yield
    except OSError as error:
        raise _write_error(directory, Path(error.filename or directory), error) from error


def _write_error(directory: Path, place: Path, error: Exception) -> WriteError:
    return WriteError(
        f"{place}: cannot be written ({_cause(error)}); "
        f"make room, then go on with --resume {directory}"
    )


def require_empty(directory: Path) -> None:
    """Refuses to put a new run where anything is.

    Raises:
      StoreError: if the directory holds a run, or other files.
    """
    if (directory / "config.json").exists():
        raise StoreError(f"{directory}: holds a run; use --resume {directory}, or another --out")
    try:
        # A run killed in its first moment may have left a part of its config.
        others = {entry.name for entry in directory.iterdir()} - {"config.json" + _PARTIAL}
    except FileNotFoundError:
        return
    except OSError as error:
        raise StoreError(
            f"{directory}: cannot be written ({error.strerror}); use another --out"
        ) from error
    if others:
        raise StoreError(
            f"{directory / min(others)}: is no run's, and would be among one's files; "
            "use an empty or a new --out"
        )


def read_config(directory: Path) -> Config:
    """The config of the run in a directory.

    Raises:
      StoreError: if there is none, or it is not one of this version's.
    """
    file = directory / "config.json"
    with reading(file, "run", "config"):
        plain = json.loads(file.read_text())
        version = plain.pop("jaxdeconf", "unknown")
        if version != __version__:
            raise StoreError(
                f"{file}: a run of jaxdeconf {version}, not of this version, {__version__}; "
                "finish it with its own, or start a new run with --out"
            )
        return structure(Config, plain)


@contextlib.contextmanager
def reading(file: Path, kind: str, what: str) -> Iterator[None]:
    """Turns what is wrong with the file that says what a run or a sweep is into a StoreError."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{file}: no {kind} to resume there ({error.strerror}); start one with --out"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(
            f"{file}: not a {what} of jaxdeconf {__version__} ({_cause(error)}); "
            f"start a new {kind} with --out"
        ) from error


def write_config(directory: Path, config: Config) -> None:
    """Writes the config.json that `read_config` reads."""
    write_json(directory / "config.json", {"jaxdeconf": __version__, **asdict(config)})


def structure(kind: Any, plain: dict[str, Any]) -> Any:
    """The dataclass `kind` from its `asdict`, after a passage through JSON."""
    defaults = kind()

    def value(name: str, plain: Any) -> Any:
        default = getattr(defaults, name, None)
        if is_dataclass(default):
            return structure(type(default), plain)
        return from_plain(plain)

    return kind(**{name: value(name, v) for name, v in plain.items()})


def write_json(file: Path, value: Any) -> Any:
    """Replaces a JSON file in one step: a reader, or a crash, finds the old or the new one.

    Returns:
      The value as the file gives it back: arrays are lists.
    """
    partial, value = file.with_name(file.name + _PARTIAL), to_plain(value)
    partial.write_text(json.dumps(value, indent=1) + "\n")
    os.replace(partial, file)
    return value


def to_plain(value: Any) -> Any:
    """Arrays, tuples and NumPy scalars as what JSON gives back."""
    if isinstance(value, dict):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.asarray(value).tolist()
    return value


def from_plain(value: Any) -> Any:
    """What `to_plain` made of a config's field: its lists are tuples."""
    return tuple(value) if isinstance(value, list) else value


def _cause(error: Exception) -> str:
    """An error in one line; Orbax wraps the one that says what is wrong."""
    cause = error.__cause__ or error
    words = getattr(cause, "strerror", None) or str(cause) or type(cause).__name__
    system = re.search(r": ([^:]*) \[os_error_code", words)  # within much that Orbax adds
    return system[1] if system else words.splitlines()[0]


def _differences(old: Any, new: Any, path: str = "") -> list[str]:
    """`--flag old -> new` of every leaf that differs."""
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            line
            for key in sorted(old.keys() | new.keys())
            for line in _differences(old.get(key), new.get(key), f"{path}.{key}" if path else key)
        ]
    flag = "--" + path.replace("_", "-")
    return [] if old == new else [f"{flag} was {old}, is {new}"]
