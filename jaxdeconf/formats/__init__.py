"""Datasets of other people's formats: read an episode at a time, and written again with new frames.

A format is one function from a path to a `Source`, and a row of the table below. What reads it is
imported late: a format of which nobody has a file needs nothing installed.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from jaxdeconf import checks
from jaxdeconf.formats import hdf5, lerobot, minari, npz, robomimic
from jaxdeconf.formats.source import Names, Source, lies_there


class Format(NamedTuple):
    """A row of the table."""

    what: str  # in a message
    fits: Callable[[Path], bool]  # by what lies there, not by its name
    source: Callable[[Path, Names], Source]


FORMATS: dict[str, Format] = {
    "npz": Format("an npz file", npz.fits, npz.source),
    "robomimic": Format("a robomimic HDF5 file", hdf5.fits, robomimic.source),
    "lerobot": Format("a LeRobot folder", lerobot.fits, lerobot.source),
    "minari": Format("a Minari folder", minari.fits, minari.source),
}


def find(path: Path, name: str | None, names: Names) -> Source:
    """The dataset at a path.

    Args:
      path: a file or a folder.
      name: of the format; None: by what lies there.
      names: what of it to take, where that is not to be guessed.
    Raises:
      ValueError: one line on what cannot be read there, and what to do.
    """
    if not path.exists():
        raise ValueError(f"{path}: expected a dataset, got no file or folder of that name")
    if name is not None:
        checks.one_of("format", name, tuple(FORMATS))
        return FORMATS[name].source(path, names)
    for row in FORMATS.values():
        if row.fits(path):
            return row.source(path, names)
    known = ", ".join(row.what for row in FORMATS.values())
    raise ValueError(f"{path}: expected {known}, got {lies_there(path)}")
