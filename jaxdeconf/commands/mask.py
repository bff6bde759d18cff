"""`jaxdeconf mask DEMOS`: your dataset again, with the nuisance taken out of every frame.

    jaxdeconf mask DEMOS.npz --exploration MORE.npz --out DIR

DIR then holds the new dataset, a view to put before a policy at run time (`jaxdeconf.load_view`),
and a report with the evidence. `--check` only looks, for some seconds. docs/own-data.md has more.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated

import jax
import tyro

from jaxdeconf.commands.guard import cache_compilations, complain, guarded
from jaxdeconf.commands.parse import Where, first, parse
from jaxdeconf.formats.source import Source
from jaxdeconf.owndata.config import Masking
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.owner import owned
from jaxdeconf.pipeline.store import OWNER, StoreError, begun, require_free


@dataclass(frozen=True)
class Asked(Masking):
    """A masking, as the command line takes it."""

    demos: tyro.conf.Positional[str] = ""  # the demonstrations, a file or a folder


@dataclass(frozen=True)
class Arguments(Where):
    """What can be said on the command line."""

    config: Annotated[Asked, tyro.conf.arg(name="")] = field(default_factory=Asked)
    check: bool = False  # look at the data for some seconds, and stop


def main(words: Sequence[str]) -> int:
    """Masks a dataset as the command line asks.

    Returns:
      The exit code, as of `guard.guarded`; 1, too, if nothing is written for a reason that is said.
    """
    try:
        asked, config = read(words)
    except (ValueError, StoreError) as error:
        return complain(error, 2)
    name = Path(config.demos).name
    directory = asked.resume or asked.out or Path("runs") / f"{name}-masked"
    refused: list[str] = []

    def work(interruption: Interruption) -> None:
        cache_compilations()
        if asked.check:
            refused.extend(_look(config))
            return
        with owned(directory / OWNER, asked.take_over):
            refused.extend(_mask(asked, config, directory, interruption))

    code = guarded(work, directory)
    return complain(refused[0], 1) if refused else code


def read(words: Sequence[str]) -> tuple[Arguments, Masking]:
    """The arguments, on top of the defaults, or of the masking to resume; and the masking's config.

    Raises:
      ValueError: one line that says what is wrong.
      StoreError: if there is no masking to resume.
    """
    early = first(words, Where)
    held = Asked() if early.held is None else begun(early.held, Asked)[0]
    asked = parse(Arguments, "jaxdeconf mask", __doc__ or "", words, Arguments(config=held))
    if not asked.config.demos:
        raise ValueError("DEMOS: expected the demonstrations, a file or a folder, got none")
    out, demos = asked.out, Path(asked.config.demos)
    if out is not None and demos.is_dir() and out.resolve().is_relative_to(demos.resolve()):
        raise ValueError(f"--out: expected a place outside of {demos}, got {out}")
    plain = {one.name: getattr(asked.config, one.name) for one in fields(Masking)}
    return asked, Masking(**plain)


def _look(config: Masking) -> list[str]:
    """Says what the data look like; returns why they cannot be masked, if they cannot."""
    from jaxdeconf.owndata import run
    from jaxdeconf.owndata.check import check
    from jaxdeconf.report import owndata

    sources = run.opened(config)
    print(*_said(config, sources), sep="\n")
    demos, exploration = run.read(config, sources)
    checked = check(demos, exploration.frames, config, jax.random.key(config.seed))
    print(*owndata.of_check(checked), sep="\n")
    return [] if checked.refused is None else [checked.refused]


def _said(config: Masking, sources: tuple[Source, Source]) -> list[str]:
    """What was taken of each input, and what is to come."""
    from jaxdeconf.owndata.cost import expected
    from jaxdeconf.report import owndata

    return [*owndata.of_sources(config, sources), owndata.of_cost(expected(config, *sources))]


def _mask(
    asked: Arguments, config: Masking, directory: Path, interruption: Interruption
) -> list[str]:
    # Imported late: --help and a mistyped flag do not wait for the rest to load.
    from jaxdeconf.owndata import run
    from jaxdeconf.pipeline.progress import Reporter
    from jaxdeconf.report import owndata

    resume = asked.held is not None
    if not resume:
        require_free(directory)
    print(*_said(config, run.opened(config)), sep="\n", file=sys.stderr)
    run.mask_dataset(config, directory, Reporter(), resume, interruption)
    found = owndata.redraw(directory)
    print(owndata.summary(found, directory))
    return [] if found.refused is None else [found.refused]
