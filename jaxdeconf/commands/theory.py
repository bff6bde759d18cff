"""`jaxdeconf theory`: what the intervention is for, every claim of the paper as an experiment.

    jaxdeconf theory --out DIR        random causal systems, and CartPole with the fork made real
    jaxdeconf theory --no-on-pixels   the random systems alone

DIR then holds a report and results.json, with the rates and counts of each claim. docs/theory.md
says what came of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jaxdeconf.commands.guard import cache_compilations, complain, guarded
from jaxdeconf.commands.parse import Where, first, parse
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.owner import owned
from jaxdeconf.pipeline.store import OWNER, StoreError, begun
from jaxdeconf.pipeline.theory import TheoryConfig


@dataclass(frozen=True)
class Arguments(Where):
    """What can be said on the command line."""

    config: Annotated[TheoryConfig, tyro.conf.arg(name="")] = field(default_factory=TheoryConfig)


def main(words: Sequence[str]) -> int:
    """Runs the experiments as the command line asks.

    Returns:
      The exit code, as of `guard.guarded`.
    """
    try:
        early = first(words, Where)
        held = TheoryConfig() if early.held is None else begun(early.held, TheoryConfig)[0]
        default = Arguments(config=held)
        asked = parse(Arguments, "jaxdeconf theory", __doc__ or "", words, default)
    except (ValueError, StoreError) as error:
        return complain(error, 2)
    directory = asked.resume or asked.out or Path("runs") / f"theory-seed{asked.config.seed}"

    def work(interruption: Interruption) -> None:
        # Imported late: --help and a mistyped flag do not wait for the rest to load.
        from jaxdeconf.pipeline import theory
        from jaxdeconf.pipeline.progress import Reporter
        from jaxdeconf.report.theory import redraw

        cache_compilations()
        with owned(directory / OWNER, asked.take_over):
            resume = asked.held is not None
            theory.run(asked.config, directory, Reporter(), resume, interruption)
            said = redraw(directory)
        print(said)

    return guarded(work, directory)
