"""Minari's datasets, those in HDF5: a folder, data/metadata.json and data/main_data.hdf5.

    episode_K/actions                 [T, A]
    episode_K/observations            [T + 1, H, W, 3], or a group with a camera among its arrays
    episode_K/infos/qpos, infos/qvel  [T + 1, ·]: their first rows are what the simulator was set to

There is a frame after the last action, which is written again and not learnt from. Minari stores
frames as JPEG by default, which smears a mark; they are written without loss.
"""

import io
import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdeconf import checks
from jaxdeconf.formats import hdf5, pixels
from jaxdeconf.formats.source import (
    Names,
    Redraw,
    Source,
    choose,
    is_camera,
    library,
    reading,
    states_of,
)

_EXTRA, _STATES = "minari", ("infos/qpos", "infos/qvel")
_FILE, _ABOUT = Path("data/main_data.hdf5"), Path("data/metadata.json")


def fits(path: Path) -> bool:
    """Whether a folder is one; Arrow's too, to say that it is not read."""
    return (path / _ABOUT).is_file() and not (path / "meta/info.json").is_file()


def source(path: Path, names: Names) -> Source:
    """Opens one; see `formats.find`."""
    if not (path / _FILE).exists():
        raise ValueError(
            f"{path}: expected {_FILE}, got none; write the dataset again with data_format='hdf5'"
        )
    return hdf5.look(path / _FILE, _EXTRA, lambda file: _source(path, names, file))


def _source(path: Path, names: Names, file: Any) -> Source:
    episodes = hdf5.numbered(file, "episode_")
    if not episodes:
        raise ValueError(f"{path}: expected episode_0, got only {', '.join(file) or 'nothing'}")
    first, arrays = file[episodes[0]], _arrays(file[episodes[0]])
    cameras = [key for key in arrays if key.startswith("observations") and _shows(first[key])]
    camera = choose(path, "frames", names.frames, cameras, arrays)
    action = choose(path, "actions", names.actions, {"actions"} & {*arrays}, arrays)
    lengths = np.array([len(file[name][action]) for name in episodes])
    for name, length in zip(episodes, lengths.tolist(), strict=True):
        if camera not in file[name]:
            raise ValueError(f"{path}: expected {camera} in {name}, got none")
        checks.same_length(
            f"{path}: {camera} of {name}", len(file[name][camera]), length + 1, "frames"
        )
    states = states_of(names.initial_states, len(episodes))
    keys = _STATES if names.initial_states is None else (names.initial_states,)
    if states is None and all(key in arrays for key in keys):
        rows = [[np.ravel(file[name][key][0]) for key in keys] for name in episodes]
        states = np.array([np.concatenate(row) for row in rows])
    places = [f"{name}/{camera}" for name in episodes]
    shown = next(_frames(path, places[:1]))
    return Source(
        lengths=lengths,
        actions=np.concatenate([file[name][action][:] for name in episodes]),
        limit=None,
        initial_states=states,
        state_names=[],
        frames=camera,
        size=shown.shape[1:3],
        episodes=lambda: (frames[:-1] for frames in _frames(path, places)),
        write=lambda to, redraw: _write(path, to, places, redraw),
    )


def _arrays(group: Any) -> list[str]:
    """The paths of all arrays in a group."""
    found: list[str] = []
    group.visititems(lambda name, value: found.append(name) if hasattr(value, "shape") else None)
    return found


def _shows(array: Any) -> bool:
    """Whether an array is a camera's: images, or JPEG files."""
    return array.dtype == object or is_camera(array.shape, array.dtype)


def _frames(path: Path, places: Sequence[str]) -> Iterator[np.ndarray]:
    """uint8 [T + 1, H, W, 3] of each array with these names."""
    h5py = library(path, "h5py", _EXTRA)
    with reading(path / _FILE, "an HDF5 file"), h5py.File(path / _FILE, "r") as file:
        for place in places:
            yield pixels.rgb(f"{path}: {place}", _decoded(file[place][:]))


def _decoded(stored: np.ndarray) -> np.ndarray:
    """Images [T, H, W, 3] as they are, or of [T] JPEG files."""
    if stored.dtype != object:
        return stored
    from PIL import Image  # late, as in `owndata.dataset`

    return np.stack([np.asarray(Image.open(io.BytesIO(one.tobytes()))) for one in stored])


def _write(path: Path, to: Path, places: Sequence[str], redraw: Redraw) -> None:
    """Copies the folder, with the camera's frames redrawn and none as JPEG."""
    h5py = library(path, "h5py", _EXTRA)
    shutil.copytree(path, to)
    about = json.loads((to / _ABOUT).read_text(encoding="utf-8"))
    if about.get("jpeg_encoding"):
        text = json.dumps({**about, "jpeg_encoding": False})
        (to / _ABOUT).write_text(text, encoding="utf-8")
    with h5py.File(path / _FILE, "r") as old, h5py.File(to / _FILE, "w") as new:
        new.attrs.update(old.attrs)
        for name in old:
            old.copy(name, new)
        for name in (f"{episode}/{key}" for episode in new for key in _arrays(new[episode])):
            stored = new[name][:]
            if name not in places and stored.dtype != object:
                continue
            frames = _decoded(stored)
            if name in places:  # the last frame by itself: no action follows it
                parts = frames[:-1], frames[-1:]
                frames = np.concatenate([pixels.redrawn(name, part, redraw) for part in parts])
            del new[name]
            new.create_dataset(name, data=frames, compression="gzip", compression_opts=1)
