"""LeRobot's datasets, v3 and v2: a folder of parquet files, with videos where a camera is one.

    meta/info.json                    the features, and how the files below are called
    meta/episodes/…parquet, or .jsonl an episode a row: its length, and in v3 where its frames are
    data/…parquet                     a frame a row: action, observation.state, …, a camera's PNG
    videos/…mp4                       a camera's video, of many episodes (v3) or of one (v2)

Frame t is what the expert saw when it chose action t. LeRobot's videos smear a mark, and a new one
would do so again: a camera that was a video is written as PNG images in the rows, which LeRobot
trains on as well. What of the metadata speaks of the camera's frames is made anew.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdeconf.formats import pixels
from jaxdeconf.formats.lerobot.layout import INFO, Opened, episodes, frames, numbers
from jaxdeconf.formats.lerobot.writing import write
from jaxdeconf.formats.source import Names, Source, choose, read_json, states_of

_STATES = ("observation.environment_state", "observation.state")


def fits(path: Path) -> bool:
    """Whether a folder is one."""
    return (path / INFO).is_file()


def source(path: Path, names: Names) -> Source:
    """Opens one; see `formats.find`."""
    try:
        return _source(path, names)
    except KeyError as error:
        raise ValueError(f"{path}: expected {error.args[0]} in meta or data, got none") from error


def _source(path: Path, names: Names) -> Source:
    info = read_json(path / INFO)
    features = info["features"]
    cameras = [key for key, feature in features.items() if feature["dtype"] in ("image", "video")]
    camera = choose(path, "frames", names.frames, cameras, features)
    action = choose(path, "actions", names.actions, features.keys() & {"action"}, features)
    opened = Opened(path, info, camera, episodes(path, info, camera))
    lengths = np.array([episode.length for episode in opened.episodes])
    states = states_of(names.initial_states, len(lengths))
    keys = [] if states is not None else [key for key in _STATES if key in features]
    if states is None and names.initial_states is not None:
        keys = [choose(path, "initial-states", names.initial_states, (), features)]
    known = numbers(opened, [action, *keys])
    if keys:
        first = np.cumsum(lengths) - lengths
        states = np.concatenate([known[key][first] for key in keys], axis=1)
    return Source(
        lengths=lengths,
        actions=known[action],
        limit=None,
        initial_states=states,
        state_names=[name for key in keys for name in _names(key, features[key])],
        frames=camera,
        size=pixels.rgb(f"{path}: {camera}", next(frames(opened))).shape[1:3],
        episodes=lambda: (pixels.rgb(f"{path}: {camera}", one) for one in frames(opened)),
        write=lambda to, redraw: write(opened, to, redraw),
        notes=_notes(opened, keys),
    )


def _names(key: str, feature: dict[str, Any]) -> list[str]:
    """Of a feature's columns; older files have them a level down, some have none."""
    names, count = feature.get("names"), int(np.prod(feature["shape"]))
    names = next(iter(names.values()), None) if isinstance(names, dict) else names
    return names if names and len(names) == count else [f"{key}.{i}" for i in range(count)]


def _notes(opened: Opened, keys: Sequence[str]) -> tuple[str, ...]:
    notes = []
    if keys == [_STATES[1]]:
        notes.append(
            f"{_STATES[1]} is all that is known of how episodes began: if it is the robot's joints "
            "only, what objects were set to is not in it, and what the frames show of them may be "
            "masked; give it with --initial-states"
        )
    if opened.is_video:
        notes.append(
            f"{opened.camera} is a video, which has lost some detail; it is written as images, "
            "which lose none"
        )
    return tuple(notes)
