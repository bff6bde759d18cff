"""`jaxdeconf sweep`: a grid of fields and seeds; what points share is done once, models together.

    jaxdeconf sweep --system cartpole --seeds 4 \\
        --grid mask.threshold=1e-3,3e-3,1e-2 mask.reaction_horizon=1,3,5

Prints a plan, does it, and leaves rows, a table and plots in the directory. Every flag of the
experiment (--clone.epochs 0.5, --methods ...) changes all points.
"""

import contextlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import jax
from jax.experimental import multihost_utils

from jaxdeconf import checks, systems, threads
from jaxdeconf.commands.guard import cache_compilations, complain, guarded
from jaxdeconf.commands.parse import Flags, Where, choose, first, parse, parse_value
from jaxdeconf.methods import masking
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.owner import owned
from jaxdeconf.pipeline.results import Row
from jaxdeconf.pipeline.store import StoreError, require_free
from jaxdeconf.presets import PRESETS
from jaxdeconf.sweep.grid import Axis, read_axis
from jaxdeconf.sweep.log import Log, Sweep, read_sweep, require_same, write_sweep

# Writes the report of a sweep's rows to a directory; returns lines for the terminal.
Draw = Callable[[Path, Sweep, Sequence[Row]], str]


@dataclass(frozen=True)
class Arguments(Where):
    """What can be said on the command line."""

    config: Flags = field(default_factory=Config)
    grid: tuple[str, ...] = ()  # fields and their values, STAGE.FIELD=V,V
    seeds: int = 1  # how many, from --seed on
    shard: str = "1/1"  # I/N: do the I-th of N parts of the points
    memory: float | None = None  # GB of a batch; half of what is free by default
    plan: bool = False  # print the plan and stop
    devices: int | None = None  # CPU devices of this process; its cores by default
    coordinator: str | None = None  # HOST:PORT of several processes; `auto` in a cluster
    process_id: int | None = None  # of this one, from 0 on
    num_processes: int | None = None  # how many there are

    def __post_init__(self):
        super().__post_init__()
        if self.memory is not None:
            checks.positive("memory", self.memory)
        if self.devices is not None:
            checks.integer("devices", self.devices, most=1024)


Asked = TypeVar("Asked", bound=Arguments)


def main(arguments: Sequence[str], presets: Mapping[str, Mapping[str, Config]] = PRESETS) -> int:
    """Does a sweep as the command line asks; presets by system and name.

    Returns:
      The exit code, as of `guard.guarded`.
    """
    return perform("sweep", lambda: read(arguments, presets), _draw)


def _draw(directory: Path, sweep: Sweep, rows: Sequence[Row]) -> str:
    from jaxdeconf.report.sweep import write  # late: see `_run`

    return write(directory, sweep, rows)


def perform(name: str, read: Callable[[], tuple[Arguments, Sweep]], draw: Draw) -> int:
    """Does a sweep, and draws what came of it.

    Args:
      name: of the directory, where none is named.
      read: the arguments, and the sweep that they ask for; ValueError or StoreError if they cannot.
      draw: writes the report.
    Returns:
      The exit code, as of `guard.guarded`.
    """
    try:
        asked, sweep = read()
        shard = _shard(asked.shard)
        _devices(asked)
    except (ValueError, StoreError) as error:
        return complain(error, 2)
    base = asked.config
    fallback = Path("runs") / f"{base.system}-{base.preset}-{name}"
    directory = asked.resume or asked.out or fallback
    log = Log(directory, shard)
    return guarded(lambda stop: _run(asked, sweep, log, shard, draw, stop), directory)


def read(
    words: Sequence[str], presets: Mapping[str, Mapping[str, Config]]
) -> tuple[Arguments, Sweep]:
    """The arguments, on top of the preset that they name, or of the sweep to resume.

    Raises:
      ValueError: one line that says what is wrong.
      StoreError: if there is no sweep to resume, or another one.
    """
    asked, held = begin(Arguments, "jaxdeconf sweep", __doc__ or "", words, presets, masking()[:1])
    axes = named_axes(asked)
    return asked, agreed(asked, held.axes if held and not axes else axes)


def begin(
    kind: type[Asked],
    program: str,
    description: str,
    words: Sequence[str],
    presets: Mapping[str, Mapping[str, Config]],
    methods: tuple[str, ...],
) -> tuple[Asked, Sweep | None]:
    """The arguments, and the sweep to resume, if one is.

    Args:
      kind: a dataclass of the arguments.
      program, description, words: as `parse` takes them.
      presets: by system and name.
      methods: of a sweep that begins, where none are named.
    Raises:
      ValueError, StoreError: as `read` does.
    """
    early = first(words)
    checks.one_of("--system", early.system, tuple(presets))
    if early.held is None:
        held, preset = None, choose(presets[early.system], early.preset)
        default = kind(config=replace(preset, methods=methods))
    else:
        held = read_sweep(early.held)
        default = kind(config=held.base, seeds=held.seeds)
    return parse(kind, program, description, words, default), held


def named_axes(asked: Arguments) -> tuple[Axis, ...]:
    """Those of --grid."""
    return tuple(read_axis(word, asked.config, parse_value) for word in asked.grid)


def agreed(asked: Arguments, axes: tuple[Axis, ...]) -> Sweep:
    """The sweep over these axes, if its points are valid and it is the one that is resumed.

    Raises:
      ValueError, StoreError: if they are not, or it is another one.
    """
    sweep = Sweep(asked.config, axes, asked.seeds)
    assert sweep.points  # every combination is a valid config, or this raises
    if asked.held is not None:
        require_same(asked.held, sweep)
    return sweep


def _shard(word: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)/(\d+)", word)
    shard = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= shard[0] <= shard[1]:
        raise ValueError(f"--shard: expected I/N with 1 <= I <= N, got {word!r}")
    return shard


def _devices(asked: Arguments) -> None:
    """What must be said before JAX looks for devices."""
    several = asked.coordinator is not None
    if not several and (asked.process_id is not None or asked.num_processes is not None):
        raise ValueError("--coordinator: expected HOST:PORT beside --process-id, got none")
    count = asked.devices or (1 if several else threads.cores())
    jax.config.update("jax_num_cpu_devices", count)
    if asked.coordinator == "auto":
        jax.distributed.initialize()
    elif several:
        if asked.process_id is None or asked.num_processes is None:
            raise ValueError("--coordinator: expected --process-id and --num-processes, too")
        jax.distributed.initialize(asked.coordinator, asked.num_processes, asked.process_id)


def _run(
    asked: Arguments,
    sweep: Sweep,
    log: Log,
    shard: tuple[int, int],
    draw: Draw,
    interruption: Interruption,
) -> None:
    """Does a sweep, or a part of it, and says what came of it."""
    # Imported late: --help and a mistyped flag do not wait for the rest to load.
    from jaxdeconf.pipeline.progress import Reporter
    from jaxdeconf.sweep import plan
    from jaxdeconf.sweep import sweep as sweeping

    cache_compilations()
    system, alone = systems.get(sweep.base.system), jax.process_index() == 0
    budget = asked.memory * 1e9 if asked.memory else plan.half_of_free_memory()
    if alone:
        print(plan.describe(sweep, system, shard, budget), flush=True)
    if asked.plan:
        return
    with owned(log.owner, asked.take_over) if alone else contextlib.nullcontext():
        if alone:
            _open(asked, sweep, log, shard)
        if jax.process_count() > 1:  # the others read its rows
            multihost_utils.sync_global_devices("opened")
        rows = sweeping.sweep(sweep, log, Reporter(), interruption, budget, shard, system)
        if alone:
            print(_drawn(draw, sweep, log, rows))


def _drawn(draw: Draw, sweep: Sweep, log: Log, rows: Sequence[Row]) -> str:
    """Draws until no row has come meanwhile: of two shards that end at once, either may be last."""
    said = draw(log.directory, sweep, rows)
    while len(now := log.rows()) > len(rows):
        rows, said = now, draw(log.directory, sweep, now)
    return said


def _open(asked: Arguments, sweep: Sweep, log: Log, shard: tuple[int, int]) -> None:
    """A new directory, one with the same sweep, or a StoreError."""
    if asked.held is None:
        if shard == (1, 1):
            require_free(log.directory)
            (log.directory / "sweep.json").unlink(missing_ok=True)  # a start that saved nothing
        write_sweep(log.directory, sweep)  # or finds the one of another shard
    require_same(log.directory, sweep)
    log.mend()


def submit(executor: Any, sweep: Sweep, directory: Path, shards: int) -> list[Any]:
    """Starts a sweep as jobs of their own, a shard each.

    Args:
      executor: submitit's, or any with a `submit(function, *arguments)` that starts a process.
      sweep: the grid.
      directory: of the sweep, as all jobs see it.
      shards: how many jobs.
    Returns:
      The jobs; the result of each is an exit code, as of the command line.
    """
    checks.integer("shards", shards)
    write_sweep(directory, sweep)
    require_same(directory, sweep)
    own = ["--resume", str(directory), "--shard"]
    return [executor.submit(main, [*own, f"{i}/{shards}"]) for i in range(1, shards + 1)]
