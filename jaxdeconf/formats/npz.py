"""One npz file, the reference: arrays of all episodes one after another.

    frames            [n, H, W, 3]  frame t is what the expert saw when it chose action t
    actions           [n, A]
    episode_lengths   [N]           they sum to n
    initial_states    [N, S]        what the system was set to; not needed of exploration
    state_names [S], action_limit [A], and anything else: used if it is there, and copied

The frames are read and written as a stream: they never stand in memory together. Nothing is
unpickled.
"""

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from jaxdeconf import checks
from jaxdeconf.formats import pixels
from jaxdeconf.formats.source import (
    Names,
    Redraw,
    Source,
    bounds,
    choose,
    is_camera,
    reading,
    states_of,
)

_KIND = "an npz file"
_USUAL = "frames"
Header = tuple[tuple[int, ...], np.dtype]


def fits(path: Path) -> bool:
    """Whether it is one, whole or not."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(4) == b"PK\x03\x04" or path.suffix == ".npz"


def source(path: Path, names: Names) -> Source:
    """Opens one; see `formats.find`."""
    with reading(path, _KIND), zipfile.ZipFile(path) as archive:
        headers = {
            name.removesuffix(".npy"): _header(path, archive, name)
            for name in archive.namelist()
            if name.endswith(".npy")
        }
    cameras = [key for key, header in headers.items() if is_camera(*header)]
    cameras = [_USUAL] if _USUAL in headers else cameras
    frames = choose(path, "frames", names.frames, cameras, headers)
    actions = choose(path, "actions", names.actions, headers.keys() & {"actions"}, headers)
    if "episode_lengths" not in headers:
        raise ValueError(f"{path}: expected episode_lengths, got only {', '.join(headers)}")
    small = {key for key in headers if key not in cameras and key != frames}
    with reading(path, _KIND), np.load(path) as arrays:
        given = {key: arrays[key] for key in small & {*_NEEDED, actions, names.initial_states}}
    count, lengths = headers[frames][0][0], given["episode_lengths"]
    if lengths.ndim != 1 or lengths.dtype.kind not in "iu" or lengths.sum() != count:
        total = lengths.sum() if lengths.dtype.kind in "iu" else lengths.dtype
        raise ValueError(f"{path}: expected episode_lengths of {count} frames in all, got {total}")
    key = names.initial_states or "initial_states"
    states = states_of(names.initial_states, len(lengths))
    states = given.get(key) if states is None else states

    def episodes() -> Iterator[np.ndarray]:
        for stored in _stream(path, frames, lengths):
            yield pixels.rgb(f"{path}: {frames}", stored)

    first = next(_stream(path, frames, lengths[:1]))
    return Source(
        lengths=lengths.astype(int),
        actions=checks.array(f"{path}: {actions}", given[actions], f"[{count}, A]", (count, None)),
        limit=given.get("action_limit"),
        initial_states=states,
        state_names=[str(name) for name in given.get("state_names", ())],
        frames=frames,
        size=pixels.rgb(f"{path}: {frames}", first).shape[1:3],
        episodes=episodes,
        write=lambda to, redraw: _write(path, to, frames, lengths, redraw),
    )


_NEEDED = {"episode_lengths", "initial_states", "state_names", "action_limit"}


def _write(path: Path, to: Path, frames: str, lengths: np.ndarray, redraw: Redraw) -> None:
    """Copies every array byte for byte, but the frames."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(to, "w") as new:
        for entry in old.infolist():
            if entry.filename != f"{frames}.npy":
                new.writestr(entry, old.read(entry))
                continue
            shape, dtype = _header(path, old, entry.filename)
            copy = zipfile.ZipInfo(entry.filename, entry.date_time)
            copy.compress_type = entry.compress_type
            with new.open(copy, "w", force_zip64=True) as file:
                about = {"descr": dtype.str, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(file, about)
                for stored in _stream(path, frames, lengths):
                    file.write(pixels.redrawn(frames, stored, redraw).tobytes())


def _stream(path: Path, key: str, lengths: np.ndarray) -> Iterator[np.ndarray]:
    """An array's rows, an episode at a time."""
    with reading(path, _KIND), zipfile.ZipFile(path) as archive, archive.open(f"{key}.npy") as file:
        shape, dtype = _read_header(path, key, file)
        row = int(np.prod(shape[1:])) * dtype.itemsize
        for first, end in bounds(lengths):
            data = file.read((end - first) * row)
            if len(data) < (end - first) * row:
                raise EOFError
            yield np.frombuffer(data, dtype).reshape(-1, *shape[1:])


def _header(path: Path, archive: zipfile.ZipFile, name: str) -> Header:
    with archive.open(name) as file:
        return _read_header(path, name.removesuffix(".npy"), file)


def _read_header(path: Path, key: str, file: IO[bytes]) -> Header:
    """An array's shape and type.

    Raises:
      ValueError: if it holds Python objects, or is not in rows.
    """
    form = np.lib.format
    first = form.read_magic(file) == (1, 0)
    read = form.read_array_header_1_0 if first else form.read_array_header_2_0
    shape, columns, dtype = read(file)
    if dtype.hasobject:
        raise ValueError(
            f"{path}: expected numbers in {key}, got Python objects, which are pickled; save "
            "np.concatenate of the episodes, and their lengths as episode_lengths"
        )
    if columns and len(shape) > 1:
        words = f"expected {key} in C order, got Fortran order"
        raise ValueError(f"{path}: {words}; save np.ascontiguousarray of it")
    return shape, dtype
