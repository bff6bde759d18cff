"""`jaxdeconf report DIR`: draws figures and pages of what was finished in a directory again."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from jaxdeconf.commands.guard import complain
from jaxdeconf.commands.parse import parse
from jaxdeconf.pipeline.plain import UNREADABLE
from jaxdeconf.pipeline.store import StoreError, WriteError, cause


@dataclass(frozen=True)
class Arguments:
    """What can be said on the command line."""

    # Of a run, several seeds' runs, a masking, the theory's experiments, a sweep or a comparison.
    directory: tyro.conf.Positional[Path]


def main(arguments: Sequence[str]) -> int:
    """Redraws a report; returns the exit code."""
    try:
        asked = parse(Arguments, "jaxdeconf report", __doc__ or "", arguments, tyro.MISSING)
        print(f"report: {_redraw(asked.directory)}")
    except WriteError as error:
        return complain(error, 1)
    except (ValueError, StoreError) as error:
        return complain(error, 2)
    return 0


def _redraw(directory: Path) -> Path:
    from jaxdeconf.owndata.results import Found
    from jaxdeconf.pipeline.results import finished
    from jaxdeconf.pipeline.theory import Theory
    from jaxdeconf.report import compare, owndata, run, sweep, theory
    from jaxdeconf.sweep.log import Log, read_sweep

    if (directory / "sweep.json").exists():
        held = read_sweep(directory)
        (compare if held.compares else sweep).write(directory, held, Log(directory).rows())
        return directory / "report.html"
    kinds = {Found: owndata, Theory: theory}
    found = (report for kind, report in kinds.items() if finished(directory, kind))
    try:
        next(found, run).redraw(directory)
    except UNREADABLE as error:
        raise StoreError(f"{directory}: no finished run there ({cause(error)})") from error
    return directory / "report.html"
