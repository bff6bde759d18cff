"""`jaxdeconf SYSTEM`: one run, or one a seed, from a preset and flags to its report."""

import contextlib
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from jaxdeconf import checks, systems
from jaxdeconf.commands.guard import cache_compilations, complain, guarded
from jaxdeconf.commands.parse import Flags, Where, choose, first, parse
from jaxdeconf.pipeline.config import Config, fitting
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.owner import owned
from jaxdeconf.pipeline.store import OWNER, StoreError, begin, begun, free, require_same, writing
from jaxdeconf.systems import System


@dataclass(frozen=True)
class Arguments(Where):
    """What can be said on the command line."""

    config: Flags = field(default_factory=Config)
    seeds: int = 1  # how many runs, from --seed on; each in its own folder, with a summary beside

    def __post_init__(self):
        super().__post_init__()
        checks.integer("seeds", self.seeds, most=2**32 - self.config.seed)


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

    def work(interruption: Interruption) -> None:
        with owned(directory / OWNER, asked.take_over):
            _seeds(asked, known, directory, interruption)

    return guarded(work, directory)


def read(description: str, presets: Mapping[str, Config], words: Sequence[str]) -> Arguments:
    """The arguments, on top of the preset that they name, or of the run to resume.

    Raises:
      ValueError: one line that says what is wrong.
      StoreError: if there is no run to resume, or one of another system.
    """
    early = first(words)
    place, default = early.held, choose(presets, early.preset)
    config, seeds = (default, 1) if place is None else begun(place)
    if config.system != default.system:
        raise StoreError(
            f"{place}: a run of {config.system}, not of {default.system}; "
            f"use jaxdeconf {config.system}"
        )
    held = Arguments(config=config, seeds=seeds)
    asked = parse(Arguments, f"jaxdeconf {default.system}", description, words, held)
    if asked.config.system != default.system:
        raise ValueError(f"--system: expected {default.system}, got {asked.config.system!r}")
    if place is not None and asked.seeds != seeds:
        raise ValueError(f"--seeds: expected {seeds}, as was begun there, got {asked.seeds}")
    return asked


def _seeds(asked: Arguments, system: System, directory: Path, interruption: Interruption) -> None:
    # Imported late: --help and a mistyped flag do not wait for the rest to load.
    from jaxdeconf.pipeline import results
    from jaxdeconf.pipeline.progress import Reporter
    from jaxdeconf.pipeline.run import run
    from jaxdeconf.report.run import write_report, write_summary
    from jaxdeconf.report.words import summary

    cache_compilations()
    config, reporter, several, done = asked.config, Reporter(), asked.seeds > 1, []
    held = asked.held is not None
    if held:
        require_same(directory, config)
    else:
        begin(directory, config, asked.seeds)
    for seed in range(config.seed, config.seed + asked.seeds):
        interruption.check()
        place = directory / f"seed-{seed}" if several else directory
        resume = held and not (several and free(place))
        one = dataclasses.replace(config, seed=seed)
        # Somebody may go on with that seed alone.
        alone = owned(place / OWNER, asked.take_over) if several else contextlib.nullcontext()
        with alone:
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
