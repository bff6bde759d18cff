"""One checkpoint: a folder of arrays (NumPy) and notes (JSON), read back as written or not at all.

    STEP/arrays.npz   the leaves of a pytree, by their paths in it
    STEP/notes.json   what belongs to it
    STEP/SHA256SUMS   of both, as `sha256sum` writes it

It is written beside its place, read back, and renamed: what stands there was whole, and nothing is
removed before. Nothing is pickled.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf.pipeline.plain import PARTIAL, UNREADABLE

_ARRAYS, _SUMS = "arrays.npz", "SHA256SUMS"


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
      OSError: if it cannot be written and read again; what was there before still is.
    """
    partial = folder.with_name(folder.name + PARTIAL)
    shutil.rmtree(partial, ignore_errors=True)  # a killed run's
    try:
        partial.mkdir(parents=True)
        named: dict[str, Any] = named_arrays(state)
        np.savez(partial / _ARRAYS, **named)
        (partial / "notes.json").write_text(json.dumps(notes, indent=1) + "\n")
        (partial / _SUMS).write_text(_sums(partial))
        if not _reads_back(partial, state):
            raise OSError("what was written does not read back")
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
    """The arrays of a checkpoint; see `read_arrays`."""
    return read_arrays(folder / _ARRAYS, like)


def read_arrays(file: Path, like: Any) -> Any:
    """What `named_arrays` gave, of an npz file, in a tree like another.

    Raises:
      KeyError: if it has no array for one of its leaves.
    """
    with file.open("rb") as opened, np.load(opened) as arrays:
        return jax.tree_util.tree_map_with_path(
            lambda path, _: jnp.array(arrays[jax.tree_util.keystr(path)]), like
        )


def fingerprint(state: Any) -> str:
    """SHA-256 of a pytree's names, types, shapes and values: equal for equal numbers."""
    digest = hashlib.sha256()
    for name, array in named_arrays(state).items():
        digest.update(f"{name} {array.dtype} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def named_arrays(state: Any) -> dict[str, np.ndarray]:
    """The leaves of a pytree, by their paths in it, as NumPy writes them."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def _reads_back(folder: Path, state: Any) -> bool:
    try:
        return fingerprint(read_state(folder, state)) == fingerprint(state)
    except UNREADABLE:
        return False


def _sums(folder: Path) -> str:
    """`HASH  NAME` of every file in a folder but the list of them, by name."""
    files = sorted(path for path in folder.iterdir() if path.name != _SUMS)
    sums = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    return "".join(f"{digest}  {name}\n" for name, digest in sums.items())
