"""A comparison's figure; see `canvas`. Loads matplotlib."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxdeconf.report import canvas, words
from jaxdeconf.report.figures import LOSS, log_losses
from jaxdeconf.report.standing import Standing


def losses(found: Sequence[Standing]) -> Figure | None:
    """Rollout loss against training loss: a large mark a method, small ones its seeds.

    What imitates best need not drive best: a copycat stands far left and high up.
    """
    known = [one for one in found if np.isfinite(one.losses).any()]
    if not known:
        return None
    figure = Figure((7.2, 4.4), layout="constrained")
    axes = figure.subplots()
    for name, look in canvas.looks([one.method for one in known]).items():
        one = next(one for one in known if one.method == name)
        trained = np.array([judged.train_loss for judged in one.judged])
        style: dict[str, Any] = {"color": look.color, "marker": look.marker, "linestyle": "none"}
        axes.plot(trained, one.losses, markersize=3, alpha=0.45, **style)
        face = "white" if words.kind(name) != "fair" else look.color
        style |= {"markersize": 8, "markerfacecolor": face, "label": name}
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


FIGURES = (losses,)
