"""A run directory: its config, its checkpoints, and nothing that is not on disk.

    DIR/config.json                      what was asked for, and of which version of jaxdeconf
    DIR/owner.json                       who works there now; see `owner`
    DIR/checkpoints/STAGE/STEP/          the latest state of each stage, and its notes
    DIR/results.json, report.html, ...   written at the end

A checkpoint notes which run it belongs to and what it was made from, so that none is ever taken for
another's. Until the first one is there, the directory is free: a start that came to nothing leaves
no claim.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax

from jaxdeconf.pipeline import checkpoint
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.plain import PARTIAL, UNREADABLE, from_plain, to_plain, write_json
from jaxdeconf.version import __version__

Asked = TypeVar("Asked")

CONFIG = "config.json"
OWNER = "owner.json"
_STAMP = b'{\n "jaxdeconf":'  # how a file begins that says what a run or a sweep is to do


class StoreError(RuntimeError):
    """A run directory cannot be used; the message names the file and what to do."""


class WriteError(RuntimeError):
    """A run in progress cannot write; the message names the file and what to do."""


class Store:
    """Saves and loads the stages of one run."""

    def __init__(self, directory: Path, config: Any, resume: bool, home: Path | None = None):
        """Opens a run directory.

        Args:
          directory: made if it is not there.
          config: what the run is to do, a dataclass as of `Config`.
          resume: whether it goes on with what is there; the config must then be the same.
          home: what --resume goes on with, if not the directory: the sweep that it is a part of.
        Raises:
          StoreError: if the directory holds a run or anything else and `resume` is not asked for,
            if it holds no run and it is, if the configs or the versions differ, or if it cannot be
            written.
        """
        self.directory = directory
        self._home = home or directory
        wanted = json.dumps([__version__, to_plain(config)])
        self._identity = hashlib.sha256(wanted.encode()).hexdigest()
        (require_same if resume else begin)(directory, config)

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
        about = {"run": self._identity, "made_from": dict(made_from), "notes": to_plain(notes)}
        folder = self._folder(stage) / str(step)
        try:
            checkpoint.write(folder, state, about)
        except OSError as error:
            raise _write_error(self._home, folder, error) from error

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
        pass

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


def begin(directory: Path, config: Any, seeds: int = 1) -> None:
    """Makes the directory of a new run, or of several that differ in their seeds.

    Raises:
      StoreError: if anything is there, or it cannot be written.
    """
    require_free(directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_json(directory / CONFIG, stamped({"seeds": seeds, **to_plain(config)}))
    except OSError as error:
        raise StoreError(
            f"{directory}: cannot be written ({error.strerror}); use another --out"
        ) from error


def require_same(directory: Path, config: Any) -> None:
    """Refuses to go on with a run otherwise than it was begun.

    Raises:
      StoreError: if the directory holds a run of another config, or none.
    """
    changed = differences(to_plain(begun(directory, type(config))[0]), to_plain(config))
    if changed:
        shown = [f"--{name.replace('_', '-')} was {old}, is {new}" for name, old, new in changed]
        raise StoreError(
            f"{directory / CONFIG}: resumed with another config: {', '.join(shown)}; "
            "leave those flags out, or start a new run with --out"
        )


def require_free(directory: Path) -> None:
    """Refuses to put a new run, or a sweep, where anything is.

    Raises:
      StoreError: if the directory holds a run, or other files.
    """
    if kind := held(directory):
        raise StoreError(f"{directory}: holds a {kind}; use --resume {directory}, or another --out")
    if file := _beyond_claims(directory):
        raise StoreError(
            f"{file}: is no run's, and would be among one's files; use an empty or a new --out"
        )


def held(directory: Path) -> str | None:
    """`run` or `sweep`, if a directory holds one that has saved anything."""
    kinds = {"run": CONFIG, "sweep": "sweep.json"}
    found = [kind for kind, name in kinds.items() if (directory / name).exists()]
    return found[0] if found and not free(directory) else None


def free(directory: Path) -> bool:
    """Whether a new run may go there: nothing has been saved, and there is nothing else."""
    return _beyond_claims(directory) is None


def _beyond_claims(directory: Path) -> Path | None:
    """A file that is more than what a start, or a save, leaves that comes to nothing."""
    files = (path for path in directory.rglob("*") if not path.is_dir())
    return next((file for file in files if not _is_claim(file)), None)


def _is_claim(file: Path) -> bool:
    if file.name.startswith("owner") or PARTIAL in (file.suffix, file.parent.suffix):
        return True
    try:
        with file.open("rb") as opened:
            return opened.read(len(_STAMP)) == _STAMP
    except OSError:
        return False


def read_config(directory: Path) -> Config:
    """The config of the run in a directory; of several, the first one's. Raises as `begun` does."""
    return begun(directory)[0]


def begun(directory: Path, kind: type[Asked] = Config) -> tuple[Asked, int]:
    """What `begin` wrote: a config of that kind, and of how many seeds.

    Raises:
      StoreError: if there is none, or it is not one of this version's.
    """
    file = directory / CONFIG
    plain = read_stamped(file, "run")
    with reading(file, "run"):
        seeds = plain.pop("seeds", 1)
        return from_plain(kind, plain), seeds


def stamped(plain: dict[str, Any]) -> dict[str, Any]:
    """What a run or a sweep is to do, with what it must go on with."""
    return {"jaxdeconf": __version__, "x64": _x64(), **plain}


def _x64() -> bool:
    return jax.config.jax_enable_x64  # type: ignore


def read_stamped(file: Path, kind: str) -> dict[str, Any]:
    """What `stamped` was given, of a file.

    Raises:
      StoreError: if it cannot be read, or must be gone on with otherwise.
    """
    with reading(file, kind):
        plain = json.loads(file.read_text(encoding="utf-8"))
        version, x64 = plain.pop("jaxdeconf", "unknown"), plain.pop("x64", False)
    if version != __version__:
        raise StoreError(
            f"{file}: a {kind} of jaxdeconf {version}, not of this version, {__version__}; "
            f"finish it with its own, or start a new {kind} with --out"
        )
    if x64 != _x64():
        raise StoreError(
            f"{file}: a {kind} begun with JAX_ENABLE_X64={x64:d}, which is {not x64:d} now; "
            f"go on with what it was, or start a new {kind} with --out"
        )
    return plain


@contextlib.contextmanager
def reading(file: Path, kind: str) -> Iterator[None]:
    """Turns what is wrong with the file that says what a run or a sweep is into a StoreError."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{file}: no {kind} to resume there ({error.strerror}); start one with --out"
        ) from error
    except UNREADABLE as error:
        raise StoreError(
            f"{file}: not a {kind} of jaxdeconf {__version__} ({cause(error)}); "
            f"start a new {kind} with --out"
        ) from error


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
