"""A run directory: its config, its checkpoints (Orbax), and nothing that is not on disk.

    DIR/config.json                      what was asked for
    DIR/checkpoints/STAGE/STEP/          the latest state of each stage, and its notes
    DIR/results.json, report.html, ...   written at the end

Orbax writes a checkpoint beside its place and renames it, so what stands there is whole.
"""

import json
import logging
import os
from collections.abc import Callable
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdeconf import __version__
from jaxdeconf.pipeline.config import Config


class StoreError(RuntimeError):
    """A run directory cannot be used; the message names the file and what to do."""


class Store:
    """Saves and loads the stages of one run."""

    def __init__(self, directory: Path, config: Config, resume: bool):
        """Opens a run directory.

        Args:
          directory: made if need be.
          config: what the run is to do.
          resume: whether it goes on with what is there; the config must then be the same.
        Raises:
          StoreError: if the directory holds a run and `resume` is not asked for, if it holds none
            and it is, if the configs differ, or if it cannot be written.
        """
        self.directory = directory
        file, wanted = directory / "config.json", _plain(asdict(config))
        if resume:
            changed = _differences(_plain(asdict(read_config(directory))), wanted)
            if changed:
                raise StoreError(f"{file}: resumed with another config: {', '.join(changed)}")
            return
        if file.exists():
            raise StoreError(
                f"{directory}: holds a run; use --resume {directory}, or another --out"
            )
        try:
            directory.mkdir(parents=True, exist_ok=True)
            write_json(file, wanted)
        except OSError as error:
            raise StoreError(f"{directory}: cannot be written ({error.strerror})") from error

    def save(self, stage: str, step: int, state: Any, notes: dict[str, Any]) -> None:
        """Makes `state`, a pytree of jax arrays, the stage's latest, with notes for JSON."""
        with self._checkpointer(stage) as checkpointer:
            checkpointer.save(step, state, custom_metadata=_plain(notes), overwrite=True)

    def load(self, stage: str, template: Callable[[], Any]) -> tuple[Any, dict[str, Any]] | None:
        """The stage's latest state and notes, or None if it has none.

        Args:
          stage: its name.
          template: makes such a state; it is only traced, and only if there is one to load.
        Raises:
          StoreError: if what is there cannot be read as the template.
        """
        if not self._folder(stage).is_dir():
            return None
        with self._checkpointer(stage) as checkpointer:
            latest = checkpointer.latest
            if latest is None:
                return None
            device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
            like = jax.tree.map(
                lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=device),
                jax.eval_shape(template),
            )
            try:
                state = checkpointer.load(latest, like)
                return state, checkpointer.metadata(latest).custom_metadata
            except Exception as error:
                folder = self._folder(stage)
                cause = str(error.__cause__ or error).splitlines()[0]
                raise StoreError(
                    f"{folder / str(latest.step)}: not a checkpoint of this run ({cause}); "
                    f"delete {folder} to redo the stage"
                ) from error

    def _folder(self, stage: str) -> Path:
        return self.directory.absolute() / "checkpoints" / stage

    def _checkpointer(self, stage: str):
        # Orbax takes a second to import: only runs that save pay for it.
        from orbax.checkpoint import v1 as ocp

        logging.getLogger("absl").setLevel(logging.ERROR)  # it narrates every save
        keep = ocp.training.preservation_policies.LatestN(1)
        return ocp.training.Checkpointer(
            str(self._folder(stage)),
            preservation_policy=keep,  # pyright: ignore[reportArgumentType] (its own class)
        )


def read_config(directory: Path) -> Config:
    """The config of the run in a directory.

    Raises:
      StoreError: if there is none, or it is not one of this version's.
    """
    file = directory / "config.json"
    try:
        return _structure(Config, json.loads(file.read_text()))
    except OSError as error:
        raise StoreError(f"{file}: no run to resume there ({error.strerror})") from error
    except (ValueError, TypeError) as error:
        raise StoreError(f"{file}: not a config of jaxdeconf {__version__} ({error})") from error


def _structure(kind: Any, plain: dict[str, Any]) -> Any:
    """The dataclass `kind` from its `asdict`, after a passage through JSON."""
    defaults = kind()

    def value(name: str, plain: Any) -> Any:
        default = getattr(defaults, name, None)
        if is_dataclass(default):
            return _structure(type(default), plain)
        return tuple(plain) if isinstance(plain, list) else plain

    return kind(**{name: value(name, v) for name, v in plain.items()})


def write_json(file: Path, value: Any) -> Any:
    """Replaces a JSON file in one step: a reader, or a crash, finds the old or the new one.

    Returns:
      The value as the file gives it back: arrays are lists.
    """
    partial, plain = file.with_name(file.name + ".partial"), _plain(value)
    partial.write_text(json.dumps(plain, indent=1) + "\n")
    os.replace(partial, file)
    return plain


def _plain(value: Any) -> Any:
    """Arrays, tuples and NumPy scalars as what JSON gives back."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.asarray(value).tolist()
    return value


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
