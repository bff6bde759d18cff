"""A sweep's table and plots: report.html, figures/, and a few lines for the terminal."""

import math
from collections.abc import Sequence
from pathlib import Path

from jaxdeconf.pipeline import findings, grid, page
from jaxdeconf.pipeline.grid import SEED
from jaxdeconf.pipeline.store import writing
from jaxdeconf.pipeline.sweep_log import Row, Sweep

_SHOWN = 5  # points in the terminal

_CAPTIONS = {
    "rollout_loss.png": "Rollout loss against each swept value: a dot a seed (the mean over all "
    "other axes), the line their mean, the shade their standard deviation.",
    "mask.png": "How often each latent is masked, of all seeds and other axes. Latents are sorted "
    "by the share of them that the previous action explains, the nuisance's on top; in brackets "
    "the mean share.",
    "precision_recall.png": "The mask against the known nuisance. Precision: of the latents that "
    "are masked, the share that is the nuisance's; recall: of the nuisance's latents, the share "
    "that is masked. Mean over seeds and other axes; precision is undefined where none is masked.",
}


def write(directory: Path, sweep: Sweep, rows: Sequence[Row]) -> str:
    """Writes the report of the rows that there are; returns lines for the terminal."""
    from jaxdeconf.pipeline import sweep_figures  # late: it imports matplotlib

    with writing(directory):
        drawn = sweep_figures.draw(directory / "figures", sweep, rows)
        count = len(sweep.points)
        title = f"{sweep.base.system}, preset {sweep.base.preset}: a sweep of {count} points"
        left = [] if len(rows) == count else [f"{count - len(rows)} points are not done yet."]
        diverged = [str(row["point"]) for row in rows if row["diverged"]]
        if diverged:
            left.append(f"Diverged: {', '.join(diverged)}.")
        body = [
            *([page.paragraph(left, "strong")] if left else []),
            *(page.image(file, _CAPTIONS[file.name]) for file in drawn),
            page.heading("Points"),
            page.table(*table(sweep, rows)),
        ]
        page.write(directory / "report.html", title, body)
    return summary(directory, sweep, rows)


def _loss(row: Row, policy: str) -> float:
    value = row["policies"].get(policy, {}).get("rollout_loss")
    return math.inf if value is None else value


def ranked(sweep: Sweep, rows: Sequence[Row]) -> list[Row]:
    """By the rollout loss of the first policy, Masked where it is cloned; diverged ones last."""
    policies = sorted(sweep.policies, key=lambda policy: policy != "Masked")
    return sorted(rows, key=lambda row: [_loss(row, policy) for policy in policies[:1]])


def table(sweep: Sweep, rows: Sequence[Row]) -> tuple[list[str], list[list[str]], str]:
    """Head, cells and note of the table of points, best first."""
    names = [SEED, *(axis.name for axis in sweep.axes)]
    head = ["point", *names, "masked", "precision", "recall", *sweep.policies, "Expert"]
    cells = []
    for row in ranked(sweep, rows):
        values = [grid.shown(row["values"][name]) for name in names]
        mask = [findings.listing(findings.masked(row)) if "mask" in row else "β-VAE diverged"]
        judged = [findings.number(row.get(name)) for name in ("precision", "recall")]
        losses = [_with_spread(row, policy) for policy in sweep.policies]
        cells.append(
            [str(row["point"]), *values, *mask, *judged, *losses, findings.loss(row.get("expert"))]
        )
    note = "Sorted by rollout loss (mean stage cost a step, ± standard deviation over rollouts)."
    return head, cells, note


def _with_spread(row: Row, policy: str) -> str:
    judged = row["policies"].get(policy, {})
    if judged.get("rollout_loss") is None:
        return "diverged"
    return f"{findings.loss(judged['rollout_loss'])} ± {findings.number(judged['std'])}"


def summary(directory: Path, sweep: Sweep, rows: Sequence[Row]) -> str:
    """The best points, and where the rest is."""
    head, cells, _ = table(sweep, rows)
    shown = [head, *cells[:_SHOWN]]
    widths = [max(len(line[column]) for line in shown) for column in range(len(head))]
    lines = [
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in shown
    ]
    if len(cells) > _SHOWN:
        lines.append(f"... {len(cells) - _SHOWN} more")
    return "\n".join([*lines, f"report: {directory / 'report.html'}"])
