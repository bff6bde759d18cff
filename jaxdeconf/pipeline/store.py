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
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax

from jaxdeconf.pipeline import checkpoint
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.plain import PARTIAL, UNREADABLE, from_plain, to_plain, write_json
from jaxdeconf.version import __version__


class StoreError(RuntimeError):
    """A run directory cannot be used; the message names the file and what to do."""


class WriteError(RuntimeError):
    """A run in progress cannot write; the message names the file and what to do."""


class Store:
    """Saves and loads the stages of one run."""

    def __init__(self, directory: Path, config: Config, resume: bool, home: Path | None = None):
        """Opens a run directory.

        Args:
          directory: made if it is not there.
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
        wanted = to_plain(config)
        self._identity = hashlib.sha256(json.dumps([__version__, wanted]).encode()).hexdigest()
        if resume:
            changed = differences(to_plain(read_config(directory)), wanted)
            if changed:
                shown = ", ".join(
                    f"--{name.replace('_', '-')} was {old}, is {new}" for name, old, new in changed
                )
                raise StoreError(
                    f"{directory / 'config.json'}: resumed with another config: {shown}; "
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
        made_from: Mapping[str, str],
    ) -> None:
        """Makes `state`, a pytree of jax arrays, the stage's latest.

        Args:
          stage: its name.
          step: higher than that of the stage's last save.
          state: what is saved.
          notes: values for JSON, beside it.
          made_from: what it follows from: names, and fingerprints as of `checkpoint`.
        Raises:
          WriteError: if the disk does not take it, or not give it back; what was saved before is
            still there.
        """
        about = {
            "run": self._identity,
            "made_from": dict(made_from),
            "notes": to_plain(notes),
        }
        folder = self._folder(stage) / str(step)
        try:
            checkpoint.write(folder, state, about)
        except OSError as error:
            raise _write_error(self._home, folder, error) from error
        self.saved_at = time.monotonic()

    def load(
        self, stage: str, template: Callable[[], Any], made_from: Mapping[str, str]
    ) -> tuple[Any, dict[str, Any]] | None:
        """The stage's latest state and notes, or None if it has none.

        Args:
          stage: its name.
          template: makes such a state; it is only traced, and only if there is one to load.
          made_from: as it was saved with.
        Raises:
          StoreError: if what is there is damaged, is of another run, or was made from other
            numbers than there are now.
        """
        folder = checkpoint.latest(self._folder(stage))
        if folder is None:
            return None
        like = jax.eval_shape(template)
        try:
            about = checkpoint.read_notes(folder)
            if about["run"] != self._identity:
                raise ValueError("made with another config, or another version, than config.json's")
            for name, now in made_from.items():
                if about["made_from"].get(name) != now:
                    raise ValueError(f"made from another {name} than is there now")
            state = checkpoint.read_state(folder, like)
        except UNREADABLE as error:
            raise StoreError(
                f"{folder}: not a checkpoint of this run ({cause(error)}); "
                f"delete {folder.parent} to redo the stage"
            ) from error
        return state, about["notes"]

    def _folder(self, stage: str) -> Path:
        return self.directory.absolute() / "checkpoints" / stage


class Nowhere(Store):
    """A store that keeps nothing."""

    def __init__(self) -> None:
        self.saved_at = time.monotonic()

    def save(self, *_: Any, **__: Any) -> None:  # noqa: D102
        pass

    def load(self, *_: Any, **__: Any) -> None:  # noqa: D102
        pass


@contextlib.contextmanager
def writing(directory: Path) -> Iterator[None]:
    """Turns what keeps a run's files from being written into a WriteError."""
    try:
        yield
    except OSError as error:
        raise _write_error(directory, Path(error.filename or directory), error) from error


def _write_error(directory: Path, place: Path, error: Exception) -> WriteError:
    return WriteError(
        f"{place}: cannot be written ({cause(error)}); "
        f"see to the disk, then go on with --resume {directory}"
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
        others = {entry.name for entry in directory.iterdir()} - {"config.json" + PARTIAL}
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
    plain = read_versioned(file, "run", "config")
    with reading(file, "run", "config"):
        return from_plain(Config, plain)


def read_versioned(file: Path, kind: str, what: str) -> dict[str, Any]:
    """What the file that says what a run or a sweep is holds, but for its version.

    Raises:
      StoreError: if it cannot be read, or is of another version.
    """
    with reading(file, kind, what):
        plain = json.loads(file.read_text(encoding="utf-8"))
        version = plain.pop("jaxdeconf", "unknown")
    if version != __version__:
        raise StoreError(
            f"{file}: a {kind} of jaxdeconf {version}, not of this version, {__version__}; "
            f"finish it with its own, or start a new {kind} with --out"
        )
    return plain


@contextlib.contextmanager
def reading(file: Path, kind: str, what: str) -> Iterator[None]:
    """Turns what is wrong with the file that says what a run or a sweep is into a StoreError."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{file}: no {kind} to resume there ({error.strerror}); start one with --out"
        ) from error
    except UNREADABLE as error:
        raise StoreError(
            f"{file}: not a {what} of jaxdeconf {__version__} ({cause(error)}); "
            f"start a new {kind} with --out"
        ) from error


def write_config(directory: Path, config: Config) -> None:
    """Writes the config.json that `read_config` reads."""
    write_json(directory / "config.json", {"jaxdeconf": __version__, **to_plain(config)})


def cause(error: Exception) -> str:
    """An error in one line."""
    words = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return words.splitlines()[0]


def differences(old: Any, new: Any, path: str = "") -> list[tuple[str, Any, Any]]:
    """(`clone.learning_rate`, old, new) of every leaf in which two nested dicts differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            line
            for key in sorted(old.keys() | new.keys())
            for line in differences(old.get(key), new.get(key), f"{path}.{key}" if path else key)
        ]
    return [] if old == new else [(path, old, new)]
