"""The theory's figures: a function each, whose docstring opens with its caption.

Loads matplotlib; see `canvas`. Shaded: Wilson's intervals of 95 %.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jaxdeconf.pipeline.results import Pictures
from jaxdeconf.pipeline.theory import Theory
from jaxdeconf.report.canvas import FAINT, INK, PALETTE
from jaxdeconf.report.figures import LOSS, contact_sheet
from jaxdeconf.report.words import subscript
from jaxdeconf.theory.claims import ALONE, Rate

_BLUE, _GREEN = PALETTE[1:3]
_COLORS = (_BLUE, PALETTE[0], *PALETTE[2:8])
_HATCHES = ("", "////", "....")


def by_case(rows: Iterable[Rate]) -> dict[str, list[Rate]]:
    """Rates by their case, in order."""
    cases: dict[str, list[Rate]] = {}
    for row in rows:
        if row.n:
            cases.setdefault(row.case, []).append(row)
    return cases


def _curves(axes: Axes, cases: Mapping[str, list[Rate]]) -> None:
    """Rates against N; dashed, and in its case's colour, what has no fixed gamma."""
    colors: dict[str, str] = {}
    for name, rows in cases.items():
        base, alone = name.removesuffix(ALONE), name.endswith(ALONE)
        color = colors.setdefault(base, _COLORS[len(colors) % len(_COLORS)])
        x, low, high = zip(*((row.trajectories, *row.interval) for row in rows), strict=True)
        look = {"color": color, "marker": "o", "markersize": 3, "linewidth": 1.5}
        rates = [row.rate for row in rows]
        axes.plot(x, rates, "--" if alone else "-", label=None if alone else base, **look)
        axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
    axes.set_xscale("log")
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel("trajectories N")
    axes.grid(axis="y", color="#E6E6E6", linewidth=0.7)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), fontsize=7.5)


def _panels(count: int) -> tuple[Figure, Any]:
    figure = Figure((3.9 * count, 3.6), layout="constrained")
    return figure, figure.subplots(1, count, sharey=True, squeeze=False)[0]


def conservative(found: Theory, _: Pictures) -> Figure:
    """Theorem 1. How often Algorithm 1 masks a true cause, with the intervention: by the strength
    of its edges; and with an assumption broken, edges as strong as the strongest. Dashed: by the
    threshold of the tests alone, without a fixed γ.
    """
    cases = by_case(found.conservative)
    kept = {name: rows for name, rows in cases.items() if name.startswith("edges")}
    figure, (left, right) = _panels(2)
    _curves(left, kept)
    _curves(right, {name: rows for name, rows in cases.items() if name not in kept})
    left.set_ylabel("a true cause is masked")
    left.set_title("assumptions hold")
    right.set_title("one is broken")
    return figure


def intervention(found: Theory, _: Pictures) -> Figure:
    """Left, the proposition: how often an observation of the seed alone is masked. Right, Theorem
    2: of what is rightly masked without the intervention, how much is masked with it. Dashed:
    without a fixed γ.
    """
    figure, (left, right) = _panels(2)
    _curves(left, by_case(found.strictly_less))
    _curves(right, by_case(found.no_more_conservative))
    left.set_ylabel("masked")
    return figure


def threshold(found: Theory, _: Pictures) -> Figure:
    """What γ trades: causes that are masked, solid, against marks that are kept, dashed. Crosses:
    the threshold that holds the family-wise error at 5 %.
    """
    figure, (axes,) = _panels(1)
    cases = by_case(found.threshold)
    lengths = sorted({row.trajectories for row in cases["a cause is masked"]})
    for place, n in enumerate(lengths):
        color = _COLORS[place % len(_COLORS)]
        for name, style in (("a cause is masked", "-"), ("the mark is kept", "--")):
            rows = [row for row in cases[name] if row.trajectories == n]
            label = f"N = {n}" if style == "-" else None
            x, y = ([getattr(row, part) for row in rows] for part in ("threshold", "rate"))
            axes.plot(x, y, style, color=color, lw=1.5, label=label)
            held = [row for row in cases[f"{name}, family-wise"] if row.trajectories == n]
            axes.plot([row.threshold for row in held], [row.rate for row in held], "x", color=color)
    axes.set_xscale("log")
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel("γ")
    axes.set_ylabel("share of systems")
    axes.legend(fontsize=7.5)
    return figure


def first_frames(_: Theory, pictures: Pictures) -> Figure | None:
    """First frames by where the cart stands. Without the intervention the square tells it."""
    if not pictures.strips:
        return None
    rows = [f"{_condition(float(name))}" for name in pictures.strips]
    return contact_sheet(np.stack([*pictures.strips.values()]), rows)


def pixels(found: Theory, _: Pictures) -> Figure | None:
    """CartPole, without the intervention and with it. Left: Hoeffding's D of each latent and the
    state that it depends on most; green is masked, the line the threshold. Middle: how often the
    square's latent is masked. Right: the policy behind that mask, and its standard error.
    """
    if not found.driven:
        return None
    names = [_condition(one.coupling) for one in found.driven]
    figure = Figure((9.6, 3.0), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=[2.2, 1, 1])
    count, keys = len(found.driven[0].mask), []
    for place, one in enumerate(found.driven):
        shift = np.arange(count) + 0.25 * (place - (len(names) - 1) / 2)
        d = np.maximum(one.state_observation.max(axis=0), 1e-4)
        colors = [_GREEN if hidden else FAINT for hidden in one.mask]
        look = {"edgecolor": INK, "linewidth": 0.4, "hatch": _HATCHES[place % len(_HATCHES)]}
        left.bar(shift, d, 0.22, color=colors, **look)
        keys.append(Patch(facecolor="white", label=names[place], **look))
    left.axhline(found.driven[0].threshold, color=INK, linewidth=0.9)
    left.set_yscale("log")
    left.set_xticks(range(count), [subscript("o", latent + 1) for latent in range(count)])
    left.set_ylabel("largest D with a state")
    left.legend(
        handles=keys, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(names), fontsize=7.5
    )
    rates = [row for row in found.pixels if row.case.startswith("the square")]
    conditions = [_condition(float(row.case.split()[-1])) for row in rates]
    _bars(middle, conditions, [row.rate for row in rates], [row.interval for row in rates])
    middle.set_ylabel("the square's latent is masked")
    losses = [one.loss for one in found.driven]
    spans = [(one.loss - one.error, one.loss + one.error) for one in found.driven]
    _bars(right, names, losses, spans)
    right.set_ylabel(LOSS)
    return figure


def _bars(axes: Axes, names: list[str], values: list[float], spans: list[tuple]) -> None:
    if not values:
        return
    errors = np.abs(np.array(spans).T - values)
    axes.bar(range(len(values)), values, 0.6, color=_BLUE, yerr=errors, ecolor=INK)
    stacked = ["\n".join(name.rsplit(" ", 1)) for name in names]  # or they would overlap
    axes.set_xticks(range(len(values)), stacked, fontsize=7.5)


def _condition(coupling: float) -> str:
    known = {0.0: "intervened", 1.0: "not intervened"}
    return known.get(coupling, f"{100 * (1 - coupling):.0f} % intervened")


FIGURES = (first_frames, pixels, conservative, intervention, threshold)
