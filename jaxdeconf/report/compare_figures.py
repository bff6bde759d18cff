"""A comparison's figures; see `canvas`. Loads matplotlib."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxdeconf.pipeline.results import Sight
from jaxdeconf.report import canvas, words
from jaxdeconf.report.figures import LOSS, log_losses
from jaxdeconf.report.standing import Standing


def losses(found: Sequence[Standing], _: Mapping[str, Sight]) -> Figure | None:
    """Rollout loss against training loss: a large mark a method, small ones its seeds.

    What imitates best need not drive best: a copycat stands far left and high up.
    """
    known = [one for one in found if np.isfinite(one.losses).any()]
    if not known:
        return None
    figure = Figure((7.2, 4.4), layout="constrained")
    axes = figure.subplots()
    looks = canvas.looks([one.method for one in known])
    for names in _alike(known, list(looks)):
        one = next(one for one in known if one.method == names[0])
        look, trained = looks[names[0]], _trained(one)
        style: dict[str, Any] = {"color": look.color, "marker": look.marker, "linestyle": "none"}
        axes.plot(trained, one.losses, markersize=3, alpha=0.45, **style)
        face = "white" if words.kind(names[0]) != "fair" else look.color
        style |= {"markersize": 8, "markerfacecolor": face, "label": ", ".join(names)}
        axes.plot(trained.mean(), one.losses.mean(), **style)
    axes.axhline(
        float(np.mean([one.experts.mean() for one in known])),
        color=canvas.EXPERT,
        linewidth=0.9,
        label=words.EXPERT,
    )
    axes.set_xscale("log")
    log_losses(axes)
    axes.set_xlabel("training loss (hollow: oracles and controls)")
    axes.set_ylabel(LOSS)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7)
    return figure


def _alike(found: Sequence[Standing], order: Sequence[str]) -> list[list[str]]:
    """The methods, in order; those together whose policies are the same: a mark would hide one."""
    groups: dict[Any, list[str]] = {}
    for one in sorted(found, key=lambda one: order.index(one.method)):
        where = (*one.losses, *_trained(one))
        groups.setdefault(where, []).append(one.method)
    return list(groups.values())


def _trained(one: Standing) -> np.ndarray:
    """[K] training losses."""
    return np.array([judged.train_loss for judged in one.judged])


def sights(found: Sequence[Standing], seen: Mapping[str, Sight]) -> Figure | None:
    """The first seed: what each policy is shown of the same frames of the expert's, and, darker,
    the pixels of the camera's frame that its action follows, each policy on its own scale. Of
    policies that are the same, the first.
    """
    known = [one.method for one in found if one.method in seen]
    if not known:
        return None
    count = len(seen[known[0]].seen)
    figure = Figure((1.1 + 1.3 * count, 0.68 * len(known) + 0.3), layout="constrained")
    grid = figure.subplots(len(known), 2 * count, squeeze=False)
    for row, name in zip(grid, known, strict=True):
        sight = seen[name]
        # A few pixels may stand far above all others.
        most = float(np.quantile(sight.salient, 0.999)) or 1.0
        for axes, shown in zip(row, [*sight.seen, *sight.salient], strict=True):
            flat = shown.ndim == 2
            axes.imshow(shown, **({"cmap": "Greys", "vmin": 0.0, "vmax": most} if flat else {}))
            axes.set_xticks([])
            axes.set_yticks([])
        row[0].set_ylabel(name, rotation=0, ha="right", va="center", fontsize=8)
    grid[0, 0].set_title("it sees", loc="left", fontsize=8)
    grid[0, count].set_title("it looks at", loc="left", fontsize=8)
    return figure


FIGURES = (losses, sights)
