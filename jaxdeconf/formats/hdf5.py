"""HDF5 files, of which robomimic's and Minari's are: opened late, and copied but for a camera.

Shapes: T steps of one episode, H × W pixels.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdeconf.formats import pixels
from jaxdeconf.formats.source import Redraw, is_camera, library, reading


def fits(path: Path) -> bool:
    """Whether a file is one, whole or not."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n" or path.suffix in (".hdf5", ".h5")


def look(path: Path, extra: str, see: Callable[[Any], Any]) -> Any:
    """What a function sees in an opened file.

    Raises:
      ValueError: if the file cannot be read; names its size, or what it is instead.
    """
    h5py = library(path, "h5py", extra)
    with reading(path, "an HDF5 file"), h5py.File(path, "r") as file:
        return see(file)


def numbered(group: Any, start: str) -> list[str]:
    """The keys demo_0, demo_1, ..., demo_10 of a group, by their number."""
    names = [name for name in group if name.startswith(start) and name[len(start) :].isdecimal()]
    return sorted(names, key=lambda name: int(name[len(start) :]))


def arrays(group: Any) -> dict[str, Any]:
    """All arrays in a group, and in those in it, by path."""
    found: dict[str, Any] = {}
    group.visititems(
        lambda name, value: found.update({name: value} if hasattr(value, "shape") else {})
    )
    return found


def cameras(group: Any) -> list[str]:
    """The keys, of a group, whose arrays may be a camera's frames."""
    arrays = {key: value for key, value in group.items() if hasattr(value, "shape")}
    return [key for key, value in arrays.items() if is_camera(value.shape, value.dtype)]


def episodes(path: Path, extra: str, keys: Sequence[str]) -> Iterator[np.ndarray]:
    """uint8 [T, H, W, 3] of the arrays with these names, one at a time."""
    h5py = library(path, "h5py", extra)
    with reading(path, "an HDF5 file"), h5py.File(path, "r") as file:
        for key in keys:
            yield pixels.rgb(f"{path}: {key}", file[key][:])


def write(path: Path, extra: str, to: Path, keys: Sequence[str], redraw: Redraw) -> None:
    """Copies a file byte for byte, and in the copy redraws the arrays with these names in place."""
    h5py = library(path, "h5py", extra)
    shutil.copyfile(path, to)
    with h5py.File(to, "r+") as file:
        for key in keys:
            file[key][...] = pixels.redrawn(key, file[key][:], redraw)


def replace(path: Path, extra: str, changed: Iterable[tuple[str, dict[str, np.ndarray]]]) -> None:
    """Puts arrays of another type or shape in place of some, (group, {name in it: the new one})."""
    h5py = library(path, "h5py", extra)
    with h5py.File(path, "r+") as file:
        for group, new in changed:
            for name, values in new.items():
                del file[group][name]
                file[group].create_dataset(
                    name, data=values, compression="gzip", compression_opts=1
                )
