"""A sweep's figures: a function each, whose docstring opens with its caption.

Loads matplotlib; see `canvas`. Shapes: O latents.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxdeconf.pipeline.results import Row
from jaxdeconf.report import canvas, words
from jaxdeconf.report.canvas import FAINT, INK, Look
from jaxdeconf.report.figures import LOSS, log_losses
from jaxdeconf.report.words import shown
from jaxdeconf.sweep.grid import Axis
from jaxdeconf.sweep.log import Sweep

# Light to dark, for the values of a second axis.
_SHADES = colormaps["viridis"]


def rollout_loss(sweep: Sweep, rows: Sequence[Row]) -> Figure | None:
    """Rollout loss against each swept value: a dot a point of the grid, the line their mean."""
    experts = [row.expert.rollout_loss for row in rows if row.expert is not None]
    if not experts or not sweep.base.methods:
        return None
    seeds = Axis("seed", tuple(sorted({row.values["seed"] for row in rows})))
    swept = [axis for axis in sweep.axes if len(axis.values) > 1] or [seeds]
    figure = Figure((1.2 + 3.0 * len(swept), 3.4), layout="constrained")
    panels = figure.subplots(1, len(swept), sharey=True, squeeze=False)[0]
    for panel, axis in zip(panels, swept, strict=True):
        for method, look in canvas.looks(sweep.base.methods).items():
            _losses(panel, axis, method, look, rows)
        _ticks(panel, axis)
        panel.axhline(np.mean(experts), color=canvas.EXPERT, linewidth=0.9, label=words.EXPERT)
        log_losses(panel)
    panels[0].set_ylabel(LOSS)
    panels[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _losses(panel: Axes, axis: Axis, method: str, look: Look, rows: Sequence[Row]) -> None:
    own = [row for row in rows if method in row.policies]
    losses = np.array([row.policies[method].rollout_loss.mean for row in own])
    places = np.array([_place(axis, row) for row in own])
    known = np.unique(places[np.isfinite(losses)])
    means = [np.nanmean(losses[places == place]) for place in known]
    dots = {"marker": look.marker, "markersize": 3.0, "alpha": 0.5, "linestyle": "none"}
    panel.plot(places, losses, color=look.color, **dots)
    panel.plot(known, means, color=look.color, lw=1.0 if look.thin else 1.9, label=method)


def _place(axis: Axis, row: Row) -> int:
    return axis.values.index(row.values[axis.name])


def _ticks(panel: Axes, axis: Axis) -> None:
    panel.set_xticks(range(len(axis.values)), map(shown, axis.values))
    if len(axis.values) > 5:
        panel.tick_params(axis="x", labelrotation=60)
    panel.set_xlim(-0.2, len(axis.values) - 0.8)
    panel.set_xlabel(_name(axis))
    panel.grid(axis="y", color="#E6E6E6", linewidth=0.7)


def _name(axis: Axis) -> str:
    symbols = {"mask.threshold": "γ (mask.threshold)", "mask.reaction_horizon": "H"}
    return symbols.get(axis.name, axis.name)


def _of_masks(sweep: Sweep) -> list[Axis]:
    """The axes that are shown with masks, gamma first."""
    axes = [a for a in sweep.axes if a.name.startswith("mask.") and len(a.values) > 1]
    return sorted(axes, key=lambda axis: axis.name != "mask.threshold")[:2]


def _means(
    axes: Sequence[Axis], rows: Sequence[Row], value: Callable[[Row], Any]
) -> list[tuple[str, list[Any]]]:
    """For each value of the second axis, its name, and means of a value for each of the first's.

    A mean is over the rows in which the value is not None; it is NaN if there are none.
    """
    across, other = axes[0], axes[1] if len(axes) > 1 else None
    groups = [("", rows)]
    if other is not None:
        names = [f"{_name(other)} = {shown(one)}" for one in other.values]
        groups = list(zip(names, _cells(other, rows), strict=True))
    found = []
    for name, own in groups:
        cells = [[value(row) for row in cell] for cell in _cells(across, own)]
        cells = [[one for one in cell if one is not None] for cell in cells]
        found.append((name, [np.mean(cell, axis=0) if cell else np.nan for cell in cells]))
    return found


def _cells(axis: Axis, rows: Sequence[Row]) -> list[list[Row]]:
    """For each value of an axis, its rows."""
    places = range(len(axis.values))
    return [[row for row in rows if _place(axis, row) == place] for place in places]


def mask(sweep: Sweep, rows: Sequence[Row]) -> Figure | None:
    """How often each latent is masked, of all seeds and other axes. Latents are sorted by the share
    of them that the previous action explains, the nuisance's on top; in brackets the mean share.
    """
    rows, axes = [row for row in rows if row.mask is not None], _of_masks(sweep)
    if not rows or not axes:
        return None

    def nuisance_first(row: Row, values: Any) -> np.ndarray:
        return values[np.argsort(-np.asarray(row.nuisance_share), kind="stable")]

    shares = np.mean([nuisance_first(row, row.nuisance_share) for row in rows], axis=0)
    values, latents = axes[0].values, np.arange(len(shares))
    groups = _means(axes, rows, lambda r: nuisance_first(r, np.isin(latents, words.masked(r))))
    width = max(5.0, 1.8 + len(groups) * (0.4 + 0.3 * len(values)))
    figure = Figure((width, 1.3 + 0.28 * len(latents)), layout="constrained")
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for (title, columns), panel in zip(groups, panels, strict=True):
        cells = np.stack([np.broadcast_to(column, latents.shape) for column in columns], axis=1)
        style = {"cmap": "Greens", "vmin": 0, "vmax": 1, "ec": "white", "lw": 1.5}
        mesh = panel.pcolormesh(np.ma.masked_invalid(cells), **style)
        panel.set_xticks(np.arange(len(values)) + 0.5, map(shown, values), rotation=60)
        panel.set_xlabel(_name(axes[0]))
        panel.set_title(title)
        panel.spines[:].set_visible(False)
        panel.tick_params(length=0)
    labels = [f"{rank + 1}. ({share:.2f})" for rank, share in enumerate(np.maximum(shares, 0))]
    panels[0].set_yticks(latents + 0.5, labels)
    panels[0].set_ylim(len(latents), 0)
    panels[0].set_ylabel("latent (share)")
    figure.colorbar(mesh, ax=list(panels), label="masked", pad=0.02, aspect=14)
    return figure


def precision_recall(sweep: Sweep, rows: Sequence[Row]) -> Figure | None:
    """The mask against the known nuisance. Precision: of the latents that are masked, the share
    that is the nuisance's; recall: of the nuisance's latents, the share that is masked. Mean over
    seeds and other axes; precision is undefined where none is masked.
    """
    rows, axes = [row for row in rows if row.mask is not None], _of_masks(sweep)
    if not rows or not axes:
        return None
    figure = Figure((7.6, 3.0), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for panel, score in zip(panels, ("precision", "recall"), strict=True):
        groups = _means(axes, rows, lambda row, score=score: getattr(row, score))
        for place, (name, means) in enumerate(groups):
            last = max(1, len(groups) - 1)
            color = _SHADES(0.1 + 0.75 * place / last) if name else INK
            # Thinner and thinner: equal lines lie on each other.
            width = 5.0 - 4.0 * place / last
            panel.plot(means, "o-", color=color, markersize=1.5 + width, lw=width, label=name)
        _ticks(panel, axes[0])
        panel.set_title(score, color=FAINT)
        panel.set_ylim(-0.05, 1.05)
    if len(axes) > 1:
        panels[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


FIGURES = (rollout_loss, mask, precision_recall)
