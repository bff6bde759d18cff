"""`jaxdeconf SYSTEM`: one run, or one a seed, from a preset and flags to its report."""

import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from jaxdeconf import checks, systems
from jaxdeconf.commands.guard import cache_compilations, complain, guarded
from jaxdeconf.commands.parse import Flags, choose, first, parse
from jaxdeconf.pipeline.config import Config, fitting
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.plain import write_json
from jaxdeconf.pipeline.store import StoreError, read_config, reading, require_empty, writing
from jaxdeconf.systems import System

SEEDS = "seeds.json"  # in a directory of several runs: which


@dataclass(frozen=True)
class Arguments:
    """What can be said on the command line."""

    config: Flags = field(default_factory=Config)
    seeds: int = 1  # how many runs, from --seed on; each in its own folder, with a summary beside
    out: Path | None = None  # the run directory; runs/SYSTEM-PRESET-seedK by default
    resume: Path | None = None  # go on with the run in this directory

    def __post_init__(self):
        checks.integer("seeds", self.seeds, most=2**32 - self.config.seed)
        if self.out is not None and self.resume is not None:
            raise ValueError(f"out: expected only one of --out and --resume, got {self.out}")


def main(
    description: str,
    presets: Mapping[str, Config],
    arguments: Sequence[str] | None = None,
    system: System | None = None,
) -> int:
    """Runs an experiment as the command line asks.

    Args:
      description: shown by --help.
      presets: the configs by name; "laptop" is the default.
      arguments: those of the command line.
      system: what moves, yours say; None: the one that the presets name.
    Returns:
      The exit code, as of `guard.guarded`.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        asked = read(description, presets, words)
        known = systems.get(asked.config.system) if system is None else system
        fitting(asked.config, known)
    except (ValueError, StoreError) as error:
        return complain(error, 2)
    directory = asked.resume or asked.out or _default_directory(asked)
    return guarded(lambda interruption: _seeds(asked, known, directory, interruption), directory)


def read(description: str, presets: Mapping[str, Config], words: Sequence[str]) -> Arguments:
    """The arguments, on top of the preset that they name, or of the run to resume.

    Raises:
      ValueError: one line that says what is wrong.
      StoreError: if there is no run to resume, or one of another system.
    """
    begun = first(words)
    default = choose(presets, begun.preset)
    held = Arguments(default) if begun.resume is None else _held(begun.resume)
    if held.config.system != default.system:
        raise StoreError(
            f"{begun.resume}: a run of {held.config.system}, not of {default.system}; "
            f"use jaxdeconf {held.config.system}"
        )
    asked = parse(Arguments, f"jaxdeconf {default.system}", description, words, held)
    if asked.config.system != default.system:
        raise ValueError(f"--system: expected {default.system}, got {asked.config.system!r}")
    if begun.resume is not None and asked.seeds != held.seeds:
        raise ValueError(f"--seeds: expected {held.seeds}, as was begun there, got {asked.seeds}")
    return asked


def _held(directory: Path) -> Arguments:
    """What the run, or the runs, in a directory were asked for."""
    if not (directory / SEEDS).exists():
        return Arguments(read_config(directory))
    with reading(directory / SEEDS, "run", "list of seeds"):
        seeds = json.loads((directory / SEEDS).read_text())
        begun = directory / f"seed-{seeds['first']}"
        return Arguments(read_config(begun), seeds["count"])


def _seeds(asked: Arguments, system: System, directory: Path, interruption: Interruption) -> None:
    # Imported late: --help and a mistyped flag do not wait for the rest to load.
    from jaxdeconf.pipeline import results
    from jaxdeconf.pipeline.progress import Reporter
    from jaxdeconf.pipeline.run import run
    from jaxdeconf.report.run import write_report, write_summary
    from jaxdeconf.report.words import summary

    cache_compilations()
    config, reporter, several, done = asked.config, Reporter(), asked.seeds > 1, []
    if asked.resume is None:
        require_empty(directory)
    if several:
        with writing(directory):
            directory.mkdir(parents=True, exist_ok=True)
            write_json(directory / SEEDS, {"first": config.seed, "count": asked.seeds})
    for seed in range(config.seed, config.seed + asked.seeds):
        interruption.check()
        place = directory / f"seed-{seed}" if several else directory
        resume = asked.resume is not None and (not several or (place / "config.json").is_file())
        one = dataclasses.replace(config, seed=seed)
        done.append(run(one, system, place, reporter, resume, interruption))
        if _is_older(place / "report.html", place / results.FILE):
            with writing(directory):
                write_report(place, *results.load(place))
        print(summary(done[-1], place))
    if several:
        with writing(directory):
            write_summary(directory, done)
        print(f"summary: {directory / 'report.html'}")


def _is_older(page: Path, results: Path) -> bool:
    """Whether a page does not show the results: it is not there, or from before them."""
    return not page.exists() or page.stat().st_mtime_ns < results.stat().st_mtime_ns


def _default_directory(asked: Arguments) -> Path:
    config = asked.config
    seeds = f"{config.seed}" + (f"-{config.seed + asked.seeds - 1}" if asked.seeds > 1 else "")
    return Path("runs") / f"{config.system}-{config.preset}-seed{seeds}"
