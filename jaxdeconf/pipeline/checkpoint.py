"""One checkpoint: a folder of arrays (Orbax) and notes (JSON), read back as written or not at all.

    STEP/arrays/      a pytree of arrays, as Orbax writes it
    STEP/notes.json   what belongs to it
    STEP/SHA256SUMS   of every other file, as `sha256sum` writes it

It is written beside its place and renamed: what stands there was whole. Nothing is pickled.
"""

import hashlib
import json
import logging
import os
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf.pipeline.plain import PARTIAL

_SUMS = "SHA256SUMS"


def latest(stage: Path) -> Path | None:
    """The checkpoint of the last step in a stage's folder, if there is any."""
    steps = [entry for entry in stage.glob("*") if entry.name.isdecimal()]
    return max(steps, key=lambda entry: int(entry.name), default=None)


def write(folder: Path, state: Any, notes: dict[str, Any]) -> None:
    """Writes a checkpoint, and only then removes those of other steps beside it.

    Args:
      folder: its place, STAGE/STEP, where nothing is yet.
      state: a pytree of jax arrays.
      notes: plain values for JSON.
    Raises:
      OSError, ValueError: if it cannot be written; what was there before still is.
    """
    partial = folder.with_name(folder.name + PARTIAL)
    shutil.rmtree(partial, ignore_errors=True)  # a killed run's
    try:
        partial.mkdir(parents=True)
        _orbax().save(str(partial / "arrays"), state)
        (partial / "notes.json").write_text(json.dumps(notes, indent=1) + "\n")
        (partial / _SUMS).write_text(_sums(partial))
        os.rename(partial, folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    for other in folder.parent.iterdir():
        if other != folder:
            shutil.rmtree(other, ignore_errors=True)


def read_notes(folder: Path) -> dict[str, Any]:
    """The notes of a checkpoint.

    Raises:
      ValueError: if any byte of the checkpoint differs from what was written.
    """
    found, written = _sums(folder), (folder / _SUMS).read_bytes()
    if found.encode() != written:
        lines = set(found.splitlines()) ^ set(written.decode(errors="replace").splitlines())
        names = sorted({line[66:] for line in lines} - {""})
        raise ValueError(f"{names[0] if names else _SUMS} differs from what was written")
    return json.loads((folder / "notes.json").read_text())


def read_state(folder: Path, like: Any) -> Any:
    """The arrays of a checkpoint, on the first device, in a tree of ShapeDtypeStructs.

    Orbax commits them to that device, and JAX compiles anew for what is committed: copied, they are
    as if they had just been computed, so a resumed run finds the programs of the one before it.
    """
    device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    like = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=device), like)
    loaded = _orbax().load(str(folder / "arrays"), like)
    return jax.tree.map(lambda a: jnp.array(np.asarray(a)), loaded)


def fingerprint(state: Any) -> str:
    """SHA-256 of a pytree's names, types, shapes and values: equal for equal numbers."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape}\n".encode())
        digest.update(array.data.cast("B") if array.size else b"")
    return digest.hexdigest()


def _sums(folder: Path) -> str:
    """`HASH  NAME` of every file in a folder but the list of them, by name."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != _SUMS)
    lines = []
    for path in files:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        lines.append(f"{digest}  {path.relative_to(folder).as_posix()}\n")
    return "".join(lines)


def _orbax():
    # Orbax takes a second to import: only runs that save pay for it.
    from orbax.checkpoint import v1 as ocp

    # It narrates every save, and prints the stacks of the errors that it raises.
    logging.getLogger("absl").setLevel(logging.CRITICAL)
    return ocp
