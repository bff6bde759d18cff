"""A sweep's plots. Matplotlib is slow to import: only the sweep's report imports this, to write.

Shapes: O latents, P points.
"""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxdeconf.pipeline.figures import COLORS, FAINT, INK, STYLE, log_losses, save
from jaxdeconf.pipeline.grid import SEED, Axis, shown
from jaxdeconf.pipeline.sweep_log import Row, Sweep

# Light to dark, for the values of a second axis.
_SHADES = colormaps["viridis"]


def draw(folder: Path, sweep: Sweep, rows: Sequence[Row]) -> list[Path]:
    """Writes the figures for which there are rows; returns their files."""
    found = [row for row in rows if "mask" in row]
    axes = [axis for axis in sweep.axes if len(axis.values) > 1]
    of_mask = sorted(
        (axis for axis in axes if axis.name.startswith("mask.")),
        key=lambda axis: axis.name != "mask.threshold",
    )
    drawn = {}
    if found and sweep.policies:
        drawn["rollout_loss"] = rollout_loss(axes, sweep.policies, found)
    if found and of_mask:
        drawn["mask"] = mask(of_mask, found)
        drawn["precision_recall"] = precision_recall(of_mask, found)
    files = []
    for name, figure in drawn.items():
        files.append(folder / f"{name}.png")
        save(figure, files[-1])
    return files


def rollout_loss(axes: Sequence[Axis], policies: Sequence[str], rows: Sequence[Row]) -> Figure:
    """A panel a swept field: a dot a seed, their mean and standard deviation."""
    swept = [*axes] or [Axis(SEED, tuple(sorted({row["values"][SEED] for row in rows})))]
    with rc_context(STYLE):
        figure = Figure((1.2 + 3.0 * len(swept), 3.4), layout="constrained")
        panels = figure.subplots(1, len(swept), sharey=True, squeeze=False)[0]
        for panel, axis in zip(panels, swept, strict=True):
            for policy in policies:
                _losses(panel, axis, policy, rows)
            _ticks(panel, axis)
        expert = np.mean([row["expert"] for row in rows])
        for panel in panels:
            panel.axhline(expert, color=COLORS["Expert"], linewidth=0.9, label="Expert")
            log_losses(panel)
        panels[0].set_ylabel("rollout loss (mean stage cost a step)")
        panels[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _losses(panel: Axes, axis: Axis, policy: str, rows: Sequence[Row]) -> None:
    by_seed: dict[tuple[int, int], list[float]] = defaultdict(list)
    for row in rows:
        loss = row["policies"].get(policy, {}).get("rollout_loss")
        if loss is not None:
            by_seed[_place(axis, row), row["values"][SEED]].append(loss)
    places = sorted({place for place, _ in by_seed})
    seeds = {p: [np.mean(v) for (q, _), v in by_seed.items() if q == p] for p in places}
    mean = np.array([np.mean(seeds[p]) for p in places])
    spread = np.array([np.std(seeds[p]) for p in places])
    color = COLORS[policy]
    for place in places:
        panel.plot([place] * len(seeds[place]), seeds[place], "o", color=color, ms=3, alpha=0.5)
    panel.plot(places, mean, color=color, linewidth=1.9, label=policy)
    panel.fill_between(
        places, np.maximum(mean - spread, 0.3 * mean), mean + spread, color=color, alpha=0.16, lw=0
    )


def _place(axis: Axis, row: Row) -> int:
    return axis.values.index(row["values"][axis.name])


def _ticks(panel: Axes, axis: Axis) -> None:
    panel.set_xticks(range(len(axis.values)), [shown(value) for value in axis.values])
    if len(axis.values) > 5:
        panel.tick_params(axis="x", labelrotation=60)
    panel.set_xlabel(_name(axis))
    panel.grid(axis="y", color="#E6E6E6", linewidth=0.7)


def _name(axis: Axis) -> str:
    symbols = {"mask.threshold": "γ (mask.threshold)", "mask.reaction_horizon": "H"}
    return symbols.get(axis.name, axis.name)


def _cells(across: Axis, rows: Sequence[Row]) -> list[list[int]]:
    """For each value of an axis, the places of its rows."""
    places = [_place(across, row) for row in rows]
    return [
        [i for i, place in enumerate(places) if place == value]
        for value in range(len(across.values))
    ]


def _groups(axes: Sequence[Axis], rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    """Rows by the value of the second axis, with its name; all of them if there is none."""
    if len(axes) < 2:
        return [("", list(rows))]
    return [
        (f"{_name(axes[1])} = {shown(value)}", [rows[i] for i in cells])
        for value, cells in zip(axes[1].values, _cells(axes[1], rows), strict=True)
    ]


def _mean(values: Sequence[Any]) -> Any:
    """Mean over the first axis; NaN of nothing."""
    return np.mean(values, axis=0) if len(values) else np.nan


def mask(axes: Sequence[Axis], rows: Sequence[Row]) -> Figure:
    """Share of points in which each latent is masked: columns one field, panels the other."""
    across, groups = axes[0], _groups(axes, rows)
    latents = len(rows[0]["mask"])
    shares = np.mean([np.asarray(row["nuisance_share"])[_order(row)] for row in rows], axis=0)
    with rc_context(STYLE):
        width = 1.8 + len(groups) * (0.4 + 0.3 * len(across.values))
        figure = Figure((max(5.0, width), 1.3 + 0.28 * latents), layout="constrained")
        panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
        for (title, own), panel in zip(groups, panels, strict=True):
            mesh = _masked(panel, across, own, latents)
            panel.set_title(title)
        labels = [f"{rank + 1}. ({share:.2f})" for rank, share in enumerate(np.maximum(shares, 0))]
        panels[0].set_yticks(np.arange(latents) + 0.5, labels)
        panels[0].set_ylim(latents, 0)
        panels[0].set_ylabel("latent (share)")
        figure.colorbar(mesh, ax=list(panels), label="masked", pad=0.02, aspect=14)
    return figure


def _order(row: Row) -> np.ndarray:
    """[O] a point's latents, the nuisance's first."""
    return np.argsort(-np.asarray(row["nuisance_share"]), kind="stable")


def _masked(panel: Axes, across: Axis, rows: Sequence[Row], latents: int) -> Any:
    """One panel of `mask`; returns what its colours mean."""
    masked = [(np.asarray(r["mask"]) & np.asarray(r["active"]))[_order(r)] for r in rows]
    columns = [_mean([masked[i] for i in cell]) for cell in _cells(across, rows)]
    shares = np.stack([np.broadcast_to(column, latents) for column in columns], axis=1)
    style = {"cmap": "Greens", "vmin": 0, "vmax": 1, "ec": "white", "lw": 1.5}
    mesh = panel.pcolormesh(np.ma.masked_invalid(shares), **style)
    places = np.arange(len(across.values)) + 0.5
    panel.set_xticks(places, [shown(value) for value in across.values], rotation=60)
    panel.set_xlabel(_name(across))
    panel.spines[:].set_visible(False)
    panel.tick_params(length=0)
    return mesh


def precision_recall(axes: Sequence[Axis], rows: Sequence[Row]) -> Figure:
    """Precision and recall of the mask against one field, a line a value of the other."""
    across, groups = axes[0], _groups(axes, rows)
    last = max(1, len(groups) - 1)
    with rc_context(STYLE):
        figure = Figure((7.6, 3.0), layout="constrained")
        panels = figure.subplots(1, 2, sharey=True)
        for panel, score in zip(panels, ("precision", "recall"), strict=True):
            for place, (label, own) in enumerate(groups):
                scores = [[own[i][score] for i in cell] for cell in _cells(across, own)]
                means = [_mean([v for v in values if v is not None]) for values in scores]
                color = _SHADES(0.1 + 0.75 * place / last) if label else INK
                # Thinner and thinner: equal lines lie on each other.
                width = 5.0 - 4.0 * place / last
                panel.plot(means, "o-", color=color, ms=1.5 + width, lw=width, label=label)
            _ticks(panel, across)
            panel.set_title(score, color=FAINT)
            panel.set_ylim(-0.05, 1.05)
        if len(groups) > 1:
            panels[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
