"""Minari's datasets, in HDF5 or Arrow: a folder, data/metadata.json and, of each episode K,

    actions                           [T, A]
    observations                      [T + 1, H, W, 3], or a group with a camera among its arrays
    infos/qpos, infos/qvel            [T + 1, ·]: their first rows are what the simulator was set to

in data/main_data.hdf5 under episode_K, or in data/K/part-0.arrow. There is a frame after the last
action, which is written again and not learnt from. Minari stores frames as JPEG by default, which
smears a mark; they are written without loss.
"""

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdeconf import checks
from jaxdeconf.formats import arrow, hdf5, pixels
from jaxdeconf.formats.source import (
    Names,
    Redraw,
    Source,
    choose,
    is_camera,
    library,
    read_json,
    reading,
    states_of,
)

_EXTRA, _STATES = "minari", ("infos/qpos", "infos/qvel")
_FILE, _PART, _ABOUT = "data/main_data.hdf5", "part-0.arrow", "data/metadata.json"
_PADDED = ("actions", "rewards", "terminations", "truncations")  # in Arrow, to as many as frames


class _Store(NamedTuple):
    """The episodes of an opened dataset."""

    names: list[str]
    arrays: Callable[[str], dict[str, Any]]  # of one, by path; each is read when it is sliced


def fits(path: Path) -> bool:
    """Whether a folder is one."""
    return (path / _ABOUT).is_file()


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[_Store]:
    if (path / _FILE).exists():
        h5py = library(path, "h5py", _EXTRA)
        with reading(path / _FILE, "an HDF5 file"), h5py.File(path / _FILE, "r") as file:
            yield _Store(hdf5.numbered(file, "episode_"), lambda name: hdf5.arrays(file[name]))
        return
    about = read_json(path / _ABOUT)
    if about.get("data_format") != "arrow":
        raise ValueError(
            f"{path}: expected {_FILE} or Arrow files, got data_format {about.get('data_format')}; "
            "write the dataset again with data_format='hdf5'"
        )
    folders = (folder.name for folder in (path / "data").iterdir() if folder.name.isdecimal())
    yield _Store(sorted(folders, key=int), lambda name: _columns(path, about, name))


def _columns(path: Path, about: dict[str, Any], name: str) -> dict[str, Any]:
    """An Arrow file's arrays, as they are in HDF5."""
    found = {}
    for at, array in arrow.leaves(arrow.read(path / "data" / name / _PART, _EXTRA)):
        shown = array[:-1] if at.partition("/")[0] in _PADDED else array
        found[at] = arrow.Column(shown, _shape(about, at))
    return found


def _shape(about: dict[str, Any], at: str) -> tuple[int, ...] | None:
    """Of an observation, which Arrow keeps flat."""
    root, *keys = at.split("/")
    if root != "observations":
        return None
    space = json.loads(about["observation_space"])
    for key in keys:
        within = space["subspaces"]
        space = within[key] if isinstance(within, dict) else within[int(key)]
    return tuple(space["shape"]) if space.get("shape") else None


def source(path: Path, names: Names) -> Source:
    """Opens one; see `formats.find`."""
    with _opened(path) as store:
        return _source(path, names, store)


def _source(path: Path, names: Names, store: _Store) -> Source:
    if not store.names:
        raise ValueError(f"{path}: expected an episode in data, got none")
    arrays = store.arrays(store.names[0])
    cameras = [key for key in arrays if key.startswith("observations") and _shows(arrays[key])]
    camera = choose(path, "frames", names.frames, cameras, arrays)
    action = choose(path, "actions", names.actions, {"actions"} & {*arrays}, arrays)
    states = states_of(names.initial_states, len(store.names))
    keys = _STATES if names.initial_states is None else (names.initial_states,)
    keys = [key for key in keys if states is None and key in arrays]
    actions, rows = [], []
    for name in store.names:
        arrays = store.arrays(name)
        for needed in (camera, action, *keys):
            if needed not in arrays:
                raise ValueError(f"{path}: expected {needed} in {name}, got none")
        length, what = len(arrays[action]) + 1, f"{path}: {camera} of {name}"
        checks.same_length(what, len(arrays[camera]), length, "frames")
        actions.append(arrays[action][:])
        rows.append(np.concatenate([np.ravel(arrays[key][0]) for key in keys] or [[]]))
    return Source(
        lengths=np.array([len(some) for some in actions]),
        actions=np.concatenate(actions),
        limit=None,
        initial_states=np.array(rows) if keys else states,
        state_names=[],
        frames=camera,
        size=next(_frames(path, camera)).shape[1:3],
        episodes=lambda: (frames[:-1] for frames in _frames(path, camera)),
        write=lambda to, redraw: _write(path, to, camera, redraw),
    )


def _shows(array: Any) -> bool:
    """Whether an array is a camera's: images, or JPEG files."""
    return _is_files(array) or is_camera(array.shape, array.dtype)


def _is_files(array: Any) -> bool:
    return (array.dtype.metadata or {}).get("vlen") == np.uint8


def _stored(name: str, array: Any) -> np.ndarray:
    """Images [T + 1, H, W, C] as they are, or of files."""
    return pixels.decoded(name, map(bytes, array[:])) if _is_files(array) else array[:]


def _frames(path: Path, camera: str) -> Iterator[np.ndarray]:
    """uint8 [T + 1, H, W, 3] of each episode."""
    with _opened(path) as store:
        for name in store.names:
            where = f"{path}: {camera} of {name}"
            yield pixels.rgb(where, _stored(where, store.arrays(name)[camera]))


def _write(path: Path, to: Path, camera: str, redraw: Redraw) -> None:
    """Copies the folder, with the camera's frames redrawn and none as JPEG."""
    shutil.copytree(path, to, copy_function=shutil.copyfile)
    about = read_json(path / _ABOUT)
    if about.get("jpeg_encoding"):
        text = json.dumps({**about, "jpeg_encoding": False})
        (to / _ABOUT).write_text(text, encoding="utf-8")
    with _opened(path) as store:
        changed = ((name, _changed(store.arrays(name), camera, redraw)) for name in store.names)
        if (path / _FILE).exists():
            hdf5.replace(to / _FILE, _EXTRA, changed)
            return
        for name, new in changed:
            part = Path("data") / name / _PART
            arrow.write(to / part, arrow.read(path / part, _EXTRA), new)


def _changed(arrays: dict[str, Any], camera: str, redraw: Redraw) -> dict[str, np.ndarray]:
    """The arrays that are to be written anew, by path."""
    found = {}
    for name, array in arrays.items():
        if name != camera and not _is_files(array):
            continue
        frames = _stored(name, array)
        if name == camera:  # the last frame by itself: no action follows it
            parts = frames[:-1], frames[-1:]
            frames = np.concatenate([pixels.redrawn(name, part, redraw) for part in parts])
        found[name] = frames
    return found
