"""The paper's figures from one run: dependence, rollout loss, frame strips, latent traversals.

Matplotlib is slow to import: only `report` imports this module, and only when it writes. Figures
are built as objects, never through pyplot, so they need no display and leave no state behind.
Shapes: S state, A action, O latent, H reaction horizon, V traversal values, n frames.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from jaxdeconf.pipeline.findings import SAME, fixed, status, subscript

# Okabe & Ito's palette, safe for the colour-blind; a policy has one colour everywhere.
COLORS = {
    "Expert": "#555555",
    "BcVanilla": "#D55E00",
    "BcManual": "#0072B2",
    "Masked": "#009E73",
    "Reconstructed": "#B55D92",
}
INK, FAINT = "#222222", "#8A8A8A"
MASKED = COLORS["Masked"]
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "xtick.color": INK,
    "ytick.color": INK,
    "hatch.linewidth": 0.7,
    "legend.frameon": False,
    "savefig.dpi": 150,
    "figure.dpi": 150,
}
Curve = Sequence[Sequence[float]]  # [[epoch, mean, std], ...]


def save(figure: Figure, path: Path) -> None:
    """Writes a figure as PNG, in this module's style whatever the user's matplotlibrc says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with rc_context(STYLE):
        figure.savefig(path)


def _plain(text: str) -> str:
    # Matplotlib reads what is between two dollar signs as mathematics.
    return text.replace("$", r"\$")


def dependence(results: dict) -> Figure:
    """Hoeffding's D of every state against every latent and every action in the horizon."""
    latents = np.asarray(results["state_observation"], float)
    actions = np.asarray(results["state_action"], float)
    states, horizon, width = actions.shape
    gamma = results["threshold"]
    floor = gamma / 100.0 or 1e-5
    with rc_context(STYLE):
        columns = [latents.shape[1], horizon * width]
        size = (max(6.4, 2.9 + 0.62 * sum(columns)), 1.9 + 0.5 * states + 0.9 * (width > 1))
        figure = Figure(size, layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=columns)
        _heat(left, latents, gamma, floor)
        mesh = _heat(right, actions.reshape(states, -1), gamma, floor)
        left.set_yticks(range(states), [_plain(name) for name in results["state_names"]])
        left.set_title("Latents of the first frame", pad=52)
        left.set_ylabel("state at t = 1")
        _latent_header(left, results)
        right.set_title("Expert's actions", pad=52)
        names = [_plain(name) for name in results["action_names"]]
        steps = [subscript("a", step + 1) for step in range(horizon)]
        one = width == 1
        labels = steps if one else [f"{step}  {name}" for step in steps for name in names]
        right.set_xticks(range(columns[1]), labels, rotation=0 if one else 90)
        right.set_xlabel(names[0] if one else "")
        bar = figure.colorbar(mesh, ax=[left, right], extend="min", pad=0.02, aspect=14)
        bar.set_label("Hoeffding's D (D ≤ 0 is drawn as the floor)", fontsize=8)
        level = max(gamma, floor)  # a threshold of 0 has no place on a log scale
        bar.ax.axhline(level, color=INK, linewidth=1.4)
        bar.ax.text(-0.3, level, f"γ = {gamma:.3g}", ha="right", va="center", fontsize=8)
    return figure


def _heat(axes: Axes, values: np.ndarray, gamma: float, floor: float):
    """A heat map [rows, columns]; cells above γ are hatched and framed, undefined ones grey."""
    shown = np.ma.masked_invalid(np.where(values <= 0.0, floor, values))
    palette = colormaps["YlGnBu"].with_extremes(bad="#DDDDDD", under=colormaps["YlGnBu"](0.0))
    norm = LogNorm(floor, max(1.0, gamma))
    cells = {"shading": "nearest", "edgecolors": "white", "linewidth": 2.5}
    columns, rows = np.arange(shown.shape[1]), np.arange(shown.shape[0])
    mesh = axes.pcolormesh(columns, rows, shown, cmap=palette, norm=norm, **cells)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    for row, column in np.argwhere(values > gamma):
        box = {"xy": (column - 0.46, row - 0.46), "width": 0.92, "height": 0.92, "fill": False}
        axes.add_patch(Rectangle(**box, hatch="////", edgecolor="#FFFFFF90", linewidth=0))
        axes.add_patch(Rectangle(**box, edgecolor=INK, linewidth=1.0))
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    return mesh


def _latent_header(axes: Axes, results: dict) -> None:
    """Over each latent's column: what became of it, the previous action's share of it, its KL."""
    style = {
        "masked": {"color": "white", "bbox": {"fc": MASKED, "ec": MASKED, "boxstyle": "round"}},
        "kept": {"color": INK, "bbox": {"fc": "white", "ec": INK, "boxstyle": "round"}},
        "inactive": {"color": FAINT},
    }
    across = axes.get_xaxis_transform()

    def write(text: str, x: float, height: float, align: str = "center", **kwargs) -> None:
        offset = {"textcoords": "offset points", "fontsize": 7.5, "ha": align, "va": "center"}
        axes.annotate(text, (x, 1), (0, height), xycoords=across, **offset, **kwargs)

    latents = range(len(results["mask"]))
    axes.set_xticks(latents, [subscript("o", latent + 1) for latent in latents])
    rows = {38: "Algorithm 1", 22: "share of it that is the previous action's", 9: "KL (nats)"}
    for height, label in rows.items():
        write(label, -0.6, height, "right", color=FAINT)
    for latent in latents:
        became, share = status(results, latent), results["nuisance_share"][latent]
        write(became, latent, 38, **style[became])
        write(fixed(share, 2), latent, 22, weight="bold" if share >= SAME else "normal")
        write(fixed(results["kl"][latent], 2), latent, 9)


def rollout_loss(curves: Mapping[str, Curve], expert: float, spread: str) -> Figure:
    """Rollout loss against epoch: mean and standard deviation of each policy, and the expert's own.

    Where the standard deviation exceeds 1 the mean is dashed and not shaded, as in the paper. An
    epoch whose loss is not finite is a cross at the top.

    Args:
      curves: policy -> [[epoch, mean, std], ...]; may be empty.
      expert: the expert's rollout loss on the same initial states.
      spread: what the standard deviation is over, for the label.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(6.8, 3.9), layout="constrained")
        axes = figure.subplots()
        seen = [expert]
        for name, curve in curves.items():
            points = np.asarray([point for point in curve if point[1] is not None], float)
            if points.size:
                seen.extend(_curve(axes, name, points[np.argsort(points[:, 0])]))
        axes.axhline(expert, color=COLORS["Expert"], linewidth=0.9, label="Expert")
        seen = [value for value in seen if np.isfinite(value) and value > 0.0]
        if seen and max(seen) > 10.0 * min(seen):
            log_losses(axes)
        else:
            axes.set_ylim(bottom=0.0)
        axes.set_xlabel("training epoch")
        axes.set_ylabel("rollout loss (mean stage cost a step)")
        axes.set_title(
            f"Line: mean; shade: std over {spread}; dashed, unshaded: std > 1", color=FAINT
        )
        axes.grid(axis="y", color="#E6E6E6", linewidth=0.7)
        axes.xaxis.set_major_locator(MaxNLocator(steps=[1, 2, 5, 10], integer=True))
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def log_losses(axes: Axes) -> None:
    """A logarithmic axis of losses, labelled in plain numbers."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def _curve(axes: Axes, name: str, points: np.ndarray) -> np.ndarray:
    """One policy's line and shade from points [E, 3]; returns the means."""
    epoch, mean, std = np.where(np.isfinite(points), points, np.nan).T
    color, thin = COLORS.get(name, INK), name == "Reconstructed"
    style = {"color": color, "linewidth": 1.0 if thin else 1.9, "solid_capstyle": "round"}
    wide = ~(std <= 1.0)
    for end in range(2, len(epoch) + 1):  # a segment is dashed if either of its ends is wide
        part = slice(end - 2, end)
        look = (0, (3.2, 1.8)) if wide[part].any() else "solid"
        axes.plot(epoch[part], mean[part], linestyle=look, **style)
    size = 2.0 if thin else 3.5
    axes.plot(epoch, mean, "o", color=color, markersize=size)
    axes.plot([], [], label=name, marker="o", markersize=size, **style)
    if not thin:
        shade = {"where": ~wide, "color": color, "alpha": 0.16, "linewidth": 0}
        axes.fill_between(epoch, mean - std, mean + std, **shade)
    diverged = epoch[np.isnan(mean)]
    across = axes.get_xaxis_transform()
    if diverged.size:
        top = np.full(diverged.shape, 0.98)
        axes.plot(diverged, top, "x", color=color, transform=across, label=f"{name} diverged")
    return mean


def contact_sheet(
    images: np.ndarray, rows: Sequence[str], columns: Sequence[str] = (), title: str = ""
) -> Figure:
    """Images uint8 [R, C, 64, 64, 3] in a labelled grid, every pixel a square of 2 x 2.

    Args:
      images: the pictures.
      rows: [R] labels.
      columns: [C] labels, or none at all.
      title: over the columns.
    """
    count, across, size = images.shape[:3]
    gap, zoom = 6, 2
    pitch = zoom * size + gap
    sheet = np.full((count * pitch - gap, across * pitch - gap, 3), 255, np.uint8)
    for row, column in np.ndindex(count, across):
        y, x = row * pitch, column * pitch
        image = images[row, column].repeat(zoom, axis=0).repeat(zoom, axis=1)
        sheet[y : y + zoom * size, x : x + zoom * size] = image
    left, top, margin, dpi = 190, 64 if columns else 8, 8, STYLE["figure.dpi"]
    height, width = sheet.shape[0] + top + margin, sheet.shape[1] + left + margin
    with rc_context(STYLE):
        figure = Figure(figsize=(width / dpi, height / dpi))
        box = (left / width, margin / height, sheet.shape[1] / width, sheet.shape[0] / height)
        axes = figure.add_axes(box)
        axes.imshow(sheet, interpolation="none", aspect="auto")
        centers = np.arange(max(count, across)) * pitch + zoom * size / 2
        axes.set_yticks(centers[:count], [_plain(label) for label in rows])
        axes.set_xticks(centers[: len(columns)], [_plain(label) for label in columns])
        axes.tick_params(length=0, labeltop=True, labelbottom=False)
        axes.set_title(title, color=FAINT)
        axes.spines[:].set_visible(False)
        for row, column in np.ndindex(count, across):
            corner = (column * pitch - 0.5, row * pitch - 0.5)
            frame = {"fill": False, "edgecolor": "#C8C8C8", "linewidth": 0.5, "clip_on": False}
            axes.add_patch(Rectangle(corner, zoom * size, zoom * size, **frame))
    return figure


def traversals(results: dict, images: np.ndarray, values: np.ndarray) -> Figure:
    """Decoded images uint8 [O, V, 64, 64, 3] as each latent takes values [V] (prior std)."""
    rows = [
        f"{subscript('o', latent + 1)}  {status(results, latent)}\nKL {fixed(kl, 2)} nats"
        for latent, kl in enumerate(results["kl"])
    ]
    columns = [f"{value:+.3g}".replace("-", "−") if value else "0" for value in values]
    return contact_sheet(images, rows, columns, "latent value (prior standard deviations)")
