"""The pictures of a comparison on disk: what the first seed's policies see, and where they look.

DIR/sights/POINT.npz, of points whose policy is another's, too, of the first of them alone.
"""

from pathlib import Path

import numpy as np

from jaxdeconf.pipeline.plain import UNREADABLE, write_arrays
from jaxdeconf.pipeline.results import Sight
from jaxdeconf.pipeline.store import writing
from jaxdeconf.sweep.grid import Point
from jaxdeconf.sweep.log import Sweep


def asked(sweep: Sweep, point: Point) -> bool:
    """Whether a point's are to be kept: those that a comparison's report shows."""
    return sweep.compares and point.config.seed == sweep.base.seed


def keep(directory: Path, point: int, sight: Sight) -> None:
    """Writes a point's, in one step.

    Raises:
      WriteError: if the disk does not take it.
    """
    file = _file(directory, point)
    with writing(directory):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(file, sight._asdict())


def kept(directory: Path, point: int) -> Sight | None:
    """A point's, if it was kept and can be read: a report does without."""
    try:
        with np.load(_file(directory, point)) as arrays:
            return Sight(**arrays)
    except UNREADABLE:
        return None


def _file(directory: Path, point: int) -> Path:
    return directory / "sights" / f"{point}.npz"
