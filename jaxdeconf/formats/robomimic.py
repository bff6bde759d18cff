"""robomimic's HDF5 files, which LIBERO, robosuite, MimicGen and Isaac Lab write too.

    data/demo_K/actions          [T, A], in [-1, 1] by convention
    data/demo_K/obs/CAMERA       [T, H, W, 3]; of several, one is named with --frames
    data/demo_K/states           [T, D]: its first row is what the simulator was set to
    data/demo_K/initial_state/…  Isaac Lab's, a group of arrays [1, ·] in place of that row

The rows of `states` are flattened by robosuite as time, positions, velocities: many columns never
change, and are left out by who tests them. `mask/` and all else is copied as it is.
"""

from pathlib import Path
from typing import Any

import numpy as np

from jaxdeconf import checks
from jaxdeconf.formats import hdf5
from jaxdeconf.formats.source import Names, Source, choose, states_of

_EXTRA = "robomimic"


def source(path: Path, names: Names) -> Source:
    """Opens one; see `formats.find`."""
    return hdf5.look(path, _EXTRA, lambda file: _source(path, names, file))


def _source(path: Path, names: Names, file: Any) -> Source:
    data = file.get("data", {})
    demos = hdf5.numbered(data, "demo_")
    if not demos:
        raise ValueError(f"{path}: expected data/demo_0, got only {', '.join(file) or 'nothing'}")
    first = data[demos[0]]
    if "obs" not in first:
        raise ValueError(
            f"{path}: expected data/{demos[0]}/obs, got only {', '.join(first)}; "
            "run robomimic's dataset_states_to_obs.py first"
        )
    camera = choose(path, "frames", names.frames, hdf5.cameras(first["obs"]), first["obs"])
    key = choose(path, "actions", names.actions, {"actions"} & {*first}, first)
    for name in demos:
        for needed in (f"obs/{camera}", key):
            if needed not in data[name]:
                raise ValueError(f"{path}: expected {needed} in {name}, got none")
    lengths = np.array([len(data[name]["obs"][camera]) for name in demos])
    for name, length in zip(demos, lengths.tolist(), strict=True):
        checks.same_length(f"{path}: {key} of {name}", len(data[name][key]), length, "steps")
    states, columns = states_of(names.initial_states, len(demos)), []
    if states is None:
        states, columns = _states(data, demos, names.initial_states)
    arrays = [f"data/{name}/obs/{camera}" for name in demos]
    after = [f"data/{name}/next_obs/{camera}" for name in demos]
    written = arrays + [array for array in after if array in file]
    shown = next(hdf5.episodes(path, _EXTRA, arrays[:1]))
    return Source(
        lengths=lengths,
        actions=np.concatenate([data[name][key][:] for name in demos]),
        limit=None,
        initial_states=states,
        state_names=columns,
        frames=camera,
        size=shown.shape[1:3],
        episodes=lambda: hdf5.episodes(path, _EXTRA, arrays),
        write=lambda to, redraw: hdf5.write(path, _EXTRA, to, written, redraw),
    )


def _states(data: Any, demos: list[str], key: str | None) -> tuple[np.ndarray | None, list[str]]:
    """[N, S] what each demonstration was set to, and the names of columns that have one."""
    if key is None and all("initial_state" in data[name] for name in demos):
        rows = [_flat(data[name]["initial_state"]) for name in demos]
        return np.array([[*row.values()] for row in rows]), [*rows[0]]
    key = key or "states"
    if not all(key in data[name] and len(data[name][key]) for name in demos):
        return None, []
    return np.stack([np.ravel(data[name][key][0]) for name in demos]), []


def _flat(group: Any) -> dict[str, float]:
    """The numbers of a tree of arrays, by path and place."""
    return {
        f"{path}.{place}": number
        for path, array in hdf5.arrays(group).items()
        for place, number in enumerate(np.ravel(array).tolist())
    }
