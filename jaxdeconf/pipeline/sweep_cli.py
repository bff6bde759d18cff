"""The command line of `experiments.sweep`."""

import argparse
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import jax
from jax.experimental import multihost_utils

from jaxdeconf import checks
from jaxdeconf.pipeline import cli
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.grid import read_axis
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.report import POLICIES
from jaxdeconf.pipeline.store import StoreError, require_empty
from jaxdeconf.pipeline.sweep_log import Log, Sweep, read_sweep, require_same, write_sweep


@dataclass(frozen=True)
class Asked:
    """What a command line asks for."""

    sweep: Sweep
    directory: Path
    resume: bool
    shard: tuple[int, int]
    memory: float | None  # GB
    plan_only: bool


# What decides a sweep, and is not said again to resume it.
_OF_A_SWEEP: dict[str, Any] = {
    "system": "cartpole",
    "preset": "laptop",
    "grid": [],
    "seed": 0,
    "seeds": 1,
    "policies": ["Masked"],
}


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        """As `cli.parse` does."""
        raise ValueError(re.sub(r"^argument ", "", message))


def main(
    description: str,
    presets: Mapping[str, Mapping[str, Config]],
    arguments: Sequence[str] | None = None,
) -> int:
    """Does a sweep as the command line asks.

    Args:
      description: shown by --help.
      presets: system -> preset -> config.
      arguments: those of the command line.
    Returns:
      The exit code, as `cli.main`.
    """
    parser = _parser(description, list(presets))
    try:
        known, rest = parser.parse_known_args(arguments)
        asked = _read(known, rest, presets)
        _devices(known)
    except (ValueError, StoreError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return cli.guarded(lambda interruption: run(asked, interruption), asked.directory)


def _parser(description: str, systems: Sequence[str]) -> argparse.ArgumentParser:
    parser = _Parser(
        prog="python -m experiments.sweep",
        description=description,
        epilog="Every flag of the experiment (--bc.epochs 0.5, --collect.expert-trajectories 500) "
        "changes all points.",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("--system", choices=systems, help="default: cartpole")
    add("--preset", help="as the experiment's; default: laptop")
    add("--grid", nargs="*", metavar="STAGE.FIELD=V,V", help="fields and their values")
    add("--seed", type=int, help="the first seed; default: 0")
    add("--seeds", type=int, help="how many; default: 1")
    add("--policies", nargs="*", choices=POLICIES, help="default: Masked; none: masks alone")
    add("--out", type=Path, help="a new directory (default: runs/SYSTEM-PRESET-sweep)")
    add("--resume", type=Path, help="go on with the sweep in this directory")
    add("--shard", default="1/1", metavar="I/N", help="do the I-th of N parts of the points")
    add("--memory", type=float, metavar="GB", help="of a batch (default: half of what is free)")
    add("--plan", action="store_true", help="print the plan and stop")
    add("--devices", type=int, help="CPU devices of this process (default: its cores)")
    add("--coordinator", metavar="HOST:PORT", help="of several processes; or `auto` in a cluster")
    add("--process-id", type=int, help="of this one, from 0 on")
    add("--num-processes", type=int, help="how many there are")
    return parser


def _devices(known: argparse.Namespace) -> None:
    """What must be said before JAX looks for devices."""
    several = known.coordinator is not None
    if not several and (known.process_id is not None or known.num_processes is not None):
        raise ValueError("--coordinator: expected HOST:PORT beside --process-id, got none")
    count = known.devices
    if count is None:
        count = 1 if several else len(os.sched_getaffinity(0))
    if count < 1:
        raise ValueError(f"--devices: expected a positive integer, got {count}")
    jax.config.update("jax_num_cpu_devices", count)
    if known.coordinator == "auto":
        jax.distributed.initialize()
    elif several:
        if known.process_id is None or known.num_processes is None:
            raise ValueError("--coordinator: expected --process-id and --num-processes, too")
        jax.distributed.initialize(known.coordinator, known.num_processes, known.process_id)


def _read(
    known: argparse.Namespace, rest: list[str], presets: Mapping[str, Mapping[str, Config]]
) -> Asked:
    shard = _shard(known.shard)
    if known.memory is not None and not known.memory > 0.0:
        raise ValueError(f"--memory: expected a positive number of GB, got {known.memory}")
    rest_of = shard, known.memory, known.plan
    asked = {n: v for n, v in vars(known).items() if n in _OF_A_SWEEP and v is not None}
    if known.resume is not None and not (asked or rest):
        return Asked(read_sweep(known.resume), known.resume, True, *rest_of)
    if known.resume is not None and known.out is not None:
        raise ValueError(f"--out: expected only one of --out and --resume, got {known.out}")
    asked = _OF_A_SWEEP | asked
    system, preset = asked["system"], asked["preset"]
    flags = ["--preset", preset, "--seed", str(asked["seed"]), *rest]

    def parse(*more: str) -> Config:
        return cli.parse("", presets[system], [*flags, *more]).config

    base = parse()

    def parse_value(field: str, value: str) -> Config:
        return parse(f"--{field.replace('_', '-')}", *value.split())

    axes = tuple(read_axis(word, base, parse_value) for word in asked["grid"])
    sweep = Sweep(base, axes, asked["seeds"], tuple(asked["policies"]))
    assert sweep.points  # every combination is a valid config, or this raises
    default = Path("runs") / f"{system}-{preset}-sweep"
    directory = known.resume or known.out or default
    return Asked(sweep, directory, known.resume is not None, *rest_of)


def _shard(word: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)/(\d+)", word)
    shard = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= shard[0] <= shard[1]:
        raise ValueError(f"--shard: expected I/N with 1 <= I <= N, got {word!r}")
    return shard


def run(asked: Asked, interruption: Interruption) -> None:
    """Does a sweep, and says what came of it."""
    # Imported late: --help and a mistyped flag do not wait for the rest to load.
    from jaxdeconf.pipeline import plan, sweep_report
    from jaxdeconf.pipeline.progress import Reporter
    from jaxdeconf.pipeline.sweep import sweep

    cli.cache_compilations()
    budget = asked.memory * 1e9 if asked.memory else plan.half_of_free_memory()
    log, first = Log(asked.directory, asked.shard), jax.process_index() == 0
    if first:
        print(plan.describe(asked.sweep, asked.shard, budget), flush=True)
    if asked.plan_only:
        return
    if first:
        _open(asked, log)
    if jax.process_count() > 1:  # the others read its rows
        multihost_utils.sync_global_devices("opened")
    rows = sweep(asked.sweep, log, Reporter(), interruption, budget, asked.shard)
    if first:
        print(sweep_report.write(asked.directory, asked.sweep, rows))


def _open(asked: Asked, log: Log) -> None:
    """A new directory, one with the same sweep, or a StoreError."""
    directory, alone = asked.directory, asked.shard == (1, 1)
    held = (directory / "sweep.json").exists()
    if held and alone and not asked.resume:
        raise StoreError(f"{directory}: holds a sweep; use --resume {directory}, or another --out")
    if not held and not asked.resume:
        if alone:
            require_empty(directory)
        write_sweep(directory, asked.sweep)  # or finds the one of another shard
    require_same(directory, asked.sweep)
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
    return [
        executor.submit(_shard_job, sweep, Path(directory), (i, shards))
        for i in range(1, shards + 1)
    ]


def _shard_job(sweep: Sweep, directory: Path, shard: tuple[int, int]) -> int:
    jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))
    asked = Asked(sweep, directory, False, shard, None, False)
    return cli.guarded(lambda interruption: run(asked, interruption), directory)
