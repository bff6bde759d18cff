"""A sweep's table and plots: report.html, figures/, and a few lines for the terminal."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxdeconf.methods import METHODS
from jaxdeconf.pipeline.results import Row
from jaxdeconf.pipeline.store import writing
from jaxdeconf.report import canvas, page, words
from jaxdeconf.sweep.log import Sweep

_SHOWN = 5  # points in the terminal


def write(directory: Path, sweep: Sweep, rows: Sequence[Row]) -> str:
    """Writes the report of the rows that there are; returns lines for the terminal.

    Raises:
      WriteError: if the disk does not take it.
    """
    canvas.import_matplotlib()
    from jaxdeconf.report.sweep_figures import FIGURES

    with writing(directory):
        drawn = canvas.write(directory / "figures", FIGURES, sweep, rows)
        count = len(sweep.points)
        left = [f"{count - len(rows)} points are not done yet."] if len(rows) < count else []
        diverged = [str(row.point) for row in rows if row.diverged]
        if diverged:
            left.append(f"Diverged: {', '.join(diverged)}.")
        body = [
            *([page.paragraph(left, "strong")] if left else []),
            *page.images(drawn),
            page.heading("Points"),
            page.table(*table(sweep, rows)),
        ]
        subject = words.subject(sweep.base.system, sweep.base.preset, sweep.base)
        page.write(directory / "report.html", f"{subject}: a sweep of {count} points", body)
    return summary(directory, sweep, rows)


def ranked(sweep: Sweep, rows: Sequence[Row]) -> list[Row]:
    """By the rollout loss of the first method that needs a mask, else of the first; NaN last."""
    methods = words.ordered(sweep.base.methods)
    needing = [name for name in methods if name in METHODS and "mask" in METHODS[name].needs]
    first = [row.policies.get((needing or methods or [""])[0]) for row in rows]
    losses = [judged.rollout_loss.mean if judged else np.nan for judged in first]
    return [rows[place] for place in np.argsort(losses, kind="stable")]


def table(sweep: Sweep, rows: Sequence[Row]) -> tuple[list[str], list[list[str]], str]:
    """Head, cells and note of the table of points, best first."""
    names = ["seed", *(axis.name for axis in sweep.axes)]
    methods = words.ordered(sweep.base.methods)
    head = ["point", *names, "masked", "precision", "recall", *methods, words.EXPERT]
    cells = []
    for row in ranked(sweep, rows):
        values = [words.shown(row.values[name]) for name in names]
        mask = "β-VAE diverged" if row.mask is None else words.listing(words.masked(row))
        scores = [words.number(score) for score in (row.precision, row.recall)]
        policies = [row.policies.get(name) for name in methods]
        losses = [words.spread(one.rollout_loss) if one else "diverged" for one in policies]
        expert = words.loss(row.expert.rollout_loss) if row.expert else "–"
        cells.append([str(row.point), *values, mask, *scores, *losses, expert])
    note = "Sorted by rollout loss (mean stage cost a step, ± standard error over rollouts)."
    return head, cells, note


def summary(directory: Path, sweep: Sweep, rows: Sequence[Row]) -> str:
    """The best points, and where the rest is."""
    head, cells, _ = table(sweep, rows)
    rest = len(cells) - _SHOWN
    more = [f"... {rest} more"] if rest > 0 else []
    lines = words.aligned(head, cells[:_SHOWN])
    return "\n".join([*lines, *more, f"report: {directory / 'report.html'}"])
