"""The command line of the experiments: presets, flags for every field, exit codes."""

import argparse
import contextlib
import dataclasses
import io
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from jax.errors import JaxRuntimeError

from jaxdeconf import checks
from jaxdeconf.pipeline import findings
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.interruption import Interrupted, Interruption
from jaxdeconf.pipeline.store import StoreError, WriteError, read_config, require_empty, writing

_NO_MEMORY = "RESOURCE_EXHAUSTED|Out of memory"  # how XLA says so, on one platform or another


@dataclass(frozen=True)
class Arguments:
    """What can be said on the command line."""

    config: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    seeds: int = 1  # how many runs, from --seed on; each in its own folder, with a summary beside
    out: Path | None = None  # the run directory; runs/SYSTEM-PRESET-seedK by default
    resume: Path | None = None  # go on with the run in this directory

    def __post_init__(self):
        checks.integer("seeds", self.seeds, most=2**32 - self.config.seed)
        if self.out is not None and self.resume is not None:
            raise ValueError(f"out: expected only one of --out and --resume, got {self.out}")


def main(
    description: str, presets: Mapping[str, Config], arguments: Sequence[str] | None = None
) -> int:
    """Runs an experiment as the command line asks.

    Args:
      description: shown by --help.
      presets: the configs by name; "laptop" is the default.
      arguments: those of the command line.
    Returns:
      The exit code: 0; 1 if training diverges, the disk is full or memory too small; 2 for a wrong
      argument or run directory; 130 or 143 if stopped by SIGINT or SIGTERM.
    """
    try:
        asked = parse(description, presets, arguments)
    except (ValueError, StoreError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return _run(asked)


def parse(
    description: str, presets: Mapping[str, Config], arguments: Sequence[str] | None
) -> Arguments:
    """The arguments, on top of the preset that they name.

    Raises:
      ValueError: one line that says what is wrong.
    """
    rest = list(sys.argv[1:] if arguments is None else arguments)
    default = _default(presets, rest)
    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            return tyro.cli(
                Arguments,
                prog=f"python -m experiments.{default.system}",
                description=description,
                args=rest,
                default=Arguments(default),
            )
    except SystemExit as stop:
        if stop.code == 0:  # --help
            raise
        raise ValueError(_one_line(messages.getvalue())) from None


def _default(presets: Mapping[str, Config], arguments: list[str]) -> Config:
    """What flags change: the config of the run to resume, or the preset."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?", default="laptop", const="")
    first.add_argument("--resume", nargs="?", type=Path)
    known = first.parse_known_args(arguments)[0]
    if known.preset not in presets:
        raise ValueError(f"--preset: expected one of {', '.join(presets)}, got {known.preset!r}")
    if known.resume is None:
        return presets[known.preset]
    runs = [known.resume, *sorted(known.resume.glob("seed-*"))]
    run = next((run for run in runs if (run / "config.json").exists()), runs[0])
    config, known_systems = read_config(run), {preset.system for preset in presets.values()}
    if config.system not in known_systems:
        raise StoreError(
            f"{run / 'config.json'}: a run of {config.system}, not of "
            f"{', '.join(sorted(known_systems))}; use python -m experiments.{config.system}"
        )
    return config


def _one_line(box: str) -> str:
    """tyro's boxed message, without the box and its advice on what to read next."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", box)
    lines = [re.sub(r"^[\s│|]+|[\s│|]+$", "", line) for line in plain.splitlines()]
    words = [line for line in lines if line and not re.match(r"^[╭╰─]", line)]
    text = " ".join(word for word in words if not set(word) <= {"─", "-"})
    text = re.split(r" ?(?:Argument helptext:|For full helptext)", text)[0]
    return re.sub(r"^Error parsing (?:config\.|Arguments: |--)?", "--", text)


def _run(asked: Arguments) -> int:
    directory = asked.resume or asked.out or _default_directory(asked)
    return guarded(lambda interruption: _run_seeds(asked, directory, interruption), directory)


def guarded(work: Callable[[Interruption], None], directory: Path) -> int:
    """Does the work of a command line in a run's directory; says in one line what stops it.

    Returns:
      The exit code, as `main` does.
    """
    advice, interruption = f"go on with --resume {directory}", Interruption()
    try:
        with interruption.listening(f"stopped at once; {advice}"):
            work(interruption)
    except Interrupted as stop:
        print(f"interrupted; {advice}", file=sys.stderr)
        return stop.exit_code
    except (ValueError, StoreError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except WriteError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except (MemoryError, JaxRuntimeError) as error:
        if not isinstance(error, MemoryError) and not re.search(_NO_MEMORY, str(error)):
            raise
        words = "not enough memory; make sizes smaller, or"
        print(f"error: {words} with more of it {advice}", file=sys.stderr)
        return 1
    except FloatingPointError as error:
        print(f"error: {error}; the last good checkpoint is in {directory}", file=sys.stderr)
        return 1
    return 0


def _run_seeds(asked: Arguments, directory: Path, interruption: Interruption) -> None:
    # Imported late: --help and a mistyped flag do not wait for the rest to load.
    from jaxdeconf.pipeline.progress import Reporter
    from jaxdeconf.pipeline.report import write_summary
    from jaxdeconf.pipeline.run import run

    cache_compilations()
    config, reporter, several, done = asked.config, Reporter(), asked.seeds > 1, []
    if asked.resume is None:
        require_empty(directory)
    for seed in range(config.seed, config.seed + asked.seeds):
        interruption.check()
        place = directory / f"seed-{seed}" if several else directory
        resume = asked.resume is not None and (not several or (place / "config.json").is_file())
        one = dataclasses.replace(config, seed=seed)
        done.append(run(one, place, reporter, resume, interruption))
        print(summary(done[-1], place))
    if several:
        with writing(directory):
            write_summary(directory, done)
        print(f"summary: {directory / 'report.html'}")


def summary(results: dict, directory: Path) -> str:
    """A few lines for the terminal: what was masked, how each policy drove, where the report is."""
    share = results["nuisance_share"]
    shown = ", ".join(
        f"{findings.subscript('o', latent + 1)} ({share[latent]:.0%} the previous action's)"
        for latent in findings.masked(results)
    )

    def drove(name: str, loss: float, judged: dict) -> str:
        came_to = f"{results['outcome']['name']} {findings.outcome(results, judged)}"
        return f"  {name:<14} rollout loss {loss:8.3f}   {came_to:>14}"

    lines = [
        f"{results['system']}, {results['preset']}, seed {results['seed']}: "
        f"masked latents: {shown or 'none'}",
        drove("Expert", results["expert"]["rollout_loss"], results["expert"]),
    ]
    for name, policy in results["policies"].items():
        judged = f"   copycat {policy['copycat']:.3f}   leakage {policy['leakage']:.2f}"
        lines.append(drove(name, policy["rollout_loss"]["mean"], policy) + judged)
    return "\n".join([*lines, f"  report: {directory / 'report.html'}"])


def _default_directory(asked: Arguments) -> Path:
    config = asked.config
    seeds = f"{config.seed}" + (f"-{config.seed + asked.seeds - 1}" if asked.seeds > 1 else "")
    return Path("runs") / f"{config.system}-{config.preset}-seed{seeds}"


def cache_compilations() -> None:
    """Keeps compiled programs between runs; only command lines do so, never an import."""
    import jax

    home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    # By version and machine: XLA's programs for another processor would not run on this one.
    where = home / "jaxdeconf" / f"jax-{jax.__version__}-{os.uname().nodename}"
    jax.config.update("jax_compilation_cache_dir", str(where))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
