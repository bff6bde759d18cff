"""The rows of a sweep on disk: one line of JSON a finished point, appended and never rewritten.

DIR/sweep.json                 the grid, and of which version of jaxdeconf
DIR/sweep.jsonl                a row a point; DIR/sweep-1-of-4.jsonl where a shard wrote it
DIR/stages/, DIR/stages-1-of-4 what points share: trajectories and β-VAEs
DIR/owner.json                 who works there now; DIR/owner-1-of-4.json for a shard
"""

import contextlib
import json
import math
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxdeconf import checks
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.plain import UNREADABLE, from_plain, to_plain, write_json
from jaxdeconf.pipeline.results import Row
from jaxdeconf.pipeline.store import StoreError, read_stamped, reading, stamped, writing
from jaxdeconf.sweep.grid import METHODS_AXIS, Axis, Point, points

_MOST_POINTS = 100_000  # beyond, it is a slip: even to plan them would take minutes


@dataclass(frozen=True)
class Sweep:
    """What a sweep is to do; the base's methods are cloned, none for masks alone."""

    base: Config
    axes: tuple[Axis, ...] = ()
    seeds: int = 1  # from the base's seed on

    def __post_init__(self):
        checks.integer("seeds", self.seeds, most=2**32 - self.base.seed)
        count = self.seeds * math.prod(len(axis.values) for axis in self.axes)
        checks.integer("points of the grid", count, most=_MOST_POINTS)

    @property
    def compares(self) -> bool:
        """Whether it puts methods side by side."""
        return any(axis.name == METHODS_AXIS for axis in self.axes)

    @property
    def points(self) -> list[Point]:
        """All points of the grid."""
        return points(self.base, self.axes, self.seeds)


class Log:
    """The rows that this process, or shard, writes, and those that others have written."""

    def __init__(self, directory: Path, shard: tuple[int, int] = (1, 1)):
        """Of a sweep's directory; `shard` is (i, n), 1 <= i <= n."""
        part = "" if shard == (1, 1) else f"-{shard[0]}-of-{shard[1]}"
        self.directory = directory
        self.owner = directory / f"owner{part}.json"
        self.stages = directory / f"stages{part}"
        self._file = directory / f"sweep{part}.jsonl"

    def rows(self) -> list[Row]:
        """All rows of all parts, by point.

        Raises:
          StoreError: if a line is no row.
        """
        found: dict[int, Row] = {}
        for file in sorted(self.directory.glob("sweep*.jsonl")):
            for number, line in enumerate(_whole_lines(file), 1):
                try:
                    row: Row = from_plain(Row, json.loads(line))
                    found[row.point] = row._replace(
                        values={k: _hashable(v) for k, v in row.values.items()}
                    )
                except UNREADABLE as error:
                    raise StoreError(
                        f"{file}: line {number} is no row of a sweep ({error}); delete that line"
                    ) from error
        return [found[point] for point in sorted(found)]

    def mend(self) -> None:
        """Cuts off the line that a killed process was writing."""
        if self._file.exists():
            with writing(self.directory), self._file.open("r+b") as file:
                file.truncate(sum(len(line) + 1 for line in _whole_lines(self._file)))

    def append(self, rows: Sequence[Row]) -> None:
        """Adds rows; they are on disk when it returns.

        Raises:
          WriteError: if the disk does not take them.
        """
        text = "".join(json.dumps(to_plain(row), allow_nan=False) + "\n" for row in rows)
        with writing(self.directory), self._file.open("a") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())


def _whole_lines(file: Path) -> list[bytes]:
    return file.read_bytes().split(b"\n")[:-1]


def _hashable(value: Any) -> Any:
    """A field's value as a config has it: JSON's lists are its tuples."""
    return tuple(value) if isinstance(value, list) else value


def write_sweep(directory: Path, sweep: Sweep) -> None:
    """Writes the sweep.json that `read_sweep` reads, unless there is one: the first shard does.

    Raises:
      WriteError: if the disk does not take it.
    """
    with writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
        own = directory / f"sweep-{platform.node()}-{os.getpid()}.json"
        write_json(own, stamped(_plain(sweep)))
        with contextlib.suppress(FileExistsError):
            os.link(own, directory / "sweep.json")  # whole, and only one
        own.unlink()


def _plain(sweep: Sweep) -> dict[str, Any]:
    axes = {axis.name: list(axis.values) for axis in sweep.axes}
    return to_plain({"base": sweep.base, "axes": axes, "seeds": sweep.seeds})


def read_sweep(directory: Path) -> Sweep:
    """The sweep of a directory.

    Raises:
      StoreError: if there is none, or it is not one of this version's.
    """
    file = directory / "sweep.json"
    found = read_stamped(file, "sweep")
    with reading(file, "sweep"):
        axes = [Axis(k, tuple(map(_hashable, values))) for k, values in found["axes"].items()]
        return Sweep(from_plain(Config, found["base"]), tuple(axes), found["seeds"])


def require_same(directory: Path, sweep: Sweep) -> None:
    """Refuses to add points of one grid to the rows of another.

    Raises:
      StoreError: if the directory holds another sweep, or none.
    """
    held = read_sweep(directory)
    if _plain(held) != _plain(sweep):
        raise StoreError(
            f"{directory / 'sweep.json'}: holds another sweep (see there); "
            "leave out all but --resume, or start a new one with --out"
        )
