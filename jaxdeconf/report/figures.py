"""A run's figures, which are the paper's: a function each, whose docstring opens with its caption.

Loads matplotlib; see `canvas`. To add a figure, write its function and name it in FIGURES.
Shapes: S state, A action, O latent, H reaction horizon, V traversal values, E epochs.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps, rcParams
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from jaxdeconf.pipeline.results import Pictures, Results
from jaxdeconf.report import animation, canvas, words
from jaxdeconf.report.canvas import FAINT, INK, Look
from jaxdeconf.report.words import fixed, subscript

LOSS = "rollout loss (mean stage cost a step)"
_MASKED = "#009E73"  # the badge of a masked latent
_METHODS = 3  # that the animation shows beside the expert
_PANEL = 144  # pixels that a contact sheet's pictures come close to


def rollouts(_: Results, pictures: Pictures) -> bytes | None:
    """The policies from the same start, in real time. A rollout that leaves the bounds ends there
    and is greyed.

    The expert and the first methods of the table; controls only where others are few.
    """
    looks = canvas.looks(name for name in pictures.rollouts if name != words.EXPERT)
    methods = sorted(looks, key=lambda name: words.kind(name) == "control")[:_METHODS]
    colors = {words.EXPERT: canvas.EXPERT} if words.EXPERT in pictures.rollouts else {}
    colors |= {name: looks[name].color for name in methods}
    return animation.animate(pictures, colors) if colors else None


def rollout_loss(results: Results, _: Pictures | None = None) -> Figure | None:
    """Rollout loss across training epochs. Line: mean; shade: standard deviation, of a run over its
    rollouts, of several seeds over their means; dashed and without shade where it is above 1.

    As in the paper. An epoch whose loss is not finite is a cross at the top.
    """
    curves = {
        name: np.array(judged.rollout_loss.per_epoch, float).reshape(-1, 3)
        for name, judged in results.policies.items()
    }
    expert = results.expert.rollout_loss
    seen = np.concatenate([[expert], *(curve[:, 1] for curve in curves.values())])
    if not np.isfinite(seen).any():
        return None
    figure = Figure(figsize=(6.8, 3.9), layout="constrained")
    axes = figure.subplots()
    for name, look in canvas.looks(curves).items():
        if len(curves[name]):
            _draw_curve(axes, name, look, curves[name])
    if np.isfinite(expert):
        axes.axhline(expert, color=canvas.EXPERT, linewidth=0.9, label=words.EXPERT)
    seen = seen[np.isfinite(seen) & (seen > 0.0)]
    if seen.size and seen.max() > 10.0 * seen.min():
        log_losses(axes)
    else:
        axes.set_ylim(bottom=0.0)
    axes.set_xlabel("training epoch")
    axes.set_ylabel(LOSS)
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


def _draw_curve(axes: Axes, name: str, look: Look, points: np.ndarray) -> None:
    """One policy's line and shade from points [E, 3] of epoch, mean and standard deviation."""
    epoch, mean, std = np.where(np.isfinite(points), points, np.nan)[points[:, 0].argsort()].T
    color, thin = look.color, look.thin
    style = {"color": color, "linewidth": 1.0 if thin else 1.9, "solid_capstyle": "round"}
    wide = ~(std <= 1.0)
    for end in range(2, len(epoch) + 1):  # a segment is dashed if either of its ends is wide
        part = slice(end - 2, end)
        dashes = (0, (3.2, 1.8)) if wide[part].any() else "solid"
        axes.plot(epoch[part], mean[part], linestyle=dashes, **style)
    dots = {"marker": look.marker, "markersize": 2.0 if thin else 3.5}
    axes.plot(epoch, mean, color=color, linestyle="none", **dots)
    axes.plot([], [], label=name, **dots, **style)
    if not thin:
        shade = {"where": ~wide, "color": color, "alpha": 0.16, "linewidth": 0}
        axes.fill_between(epoch, mean - std, mean + std, **shade)
    diverged = epoch[np.isnan(mean)]
    if diverged.size:
        top, across = np.full(diverged.shape, 0.98), axes.get_xaxis_transform()
        axes.plot(diverged, top, "x", color=color, transform=across, label=f"{name} diverged")


def dependence(results: Results, _: Pictures) -> Figure:
    """Algorithm 1: how strongly the initial state and the latents of the first frame depend on each
    other, and the initial state and the expert's first actions, by the statistic that the bar
    names; where states were tested together, too, a cell is the largest of the state's tests. Cells
    above γ are hatched. A latent is masked if no state is hatched both in its column and in an
    action's.
    """
    latents, actions = results.state_observation, results.state_action
    states, horizon, width = actions.shape
    gamma, (symbol, statistic) = results.threshold, words.statistic(results)
    floor = gamma / 100.0 or 1e-5
    columns = [latents.shape[1], horizon * width]
    size = (max(6.4, 2.9 + 0.62 * sum(columns)), 1.9 + 0.5 * states + 0.9 * (width > 1))
    figure = Figure(size, layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=columns)
    _heat(left, latents, gamma, floor)
    mesh = _heat(right, actions.reshape(states, -1), gamma, floor)
    left.set_yticks(range(states), map(_literal, results.state_names))
    left.set_title("Latents of the first frame", pad=52)
    left.set_ylabel("state at t = 1")
    _latent_header(left, results)
    right.set_title("Expert's actions", pad=52)
    names = [_literal(name) for name in results.action_names]
    steps = [subscript("a", step + 1) for step in range(horizon)]
    one = width == 1
    labels = steps if one else [f"{step}  {name}" for step in steps for name in names]
    right.set_xticks(range(columns[1]), labels, rotation=0 if one else 90)
    right.set_xlabel(names[0] if one else "")
    bar = figure.colorbar(mesh, ax=[left, right], extend="min", pad=0.02, aspect=14)
    bar.set_label(f"{statistic} ({symbol} ≤ 0 is drawn as the floor)", fontsize=8)
    level = max(gamma, floor)  # a threshold of 0 has no place on a log scale
    bar.ax.axhline(level, color=INK, linewidth=1.4)
    bar.ax.text(-0.3, level, f"γ = {gamma:.3g}", ha="right", va="center", fontsize=8)
    return figure


def _literal(text: str) -> str:
    # Matplotlib reads what is between two dollar signs as mathematics.
    return text.replace("$", r"\$")


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


def _latent_header(axes: Axes, results: Results) -> None:
    """Over each latent's column: what became of it, the previous action's share of it, its KL."""
    styles = {
        "masked": {"color": "white", "bbox": {"fc": _MASKED, "ec": _MASKED, "boxstyle": "round"}},
        "kept": {"color": INK},
        "inactive": {"color": FAINT},
    }
    rows = "Algorithm 1\nshare of it that is the previous action's\nKL (nats)"
    heads = [(rows, -0.6, {"color": FAINT, "ha": "right"})]
    for latent, kl in enumerate(results.kl):
        became, share = words.status(results, latent), words.share(results.nuisance_share[latent])
        heads.append((f"{became}\n{share}\n{fixed(kl, 2)}", latent, styles[became]))
    for text, x, style in heads:
        above = {"xycoords": axes.get_xaxis_transform(), "textcoords": "offset points"}
        font = {"fontsize": 7.5, "linespacing": 1.5, "ha": "center", "va": "bottom", **style}
        axes.annotate(text, (x, 1), (0, 9), **above, **font)
    axes.set_xticks(range(len(heads) - 1), [subscript("o", o + 1) for o in range(len(heads) - 1)])


def frames(_: Results, pictures: Pictures) -> Figure | None:
    """The same moments of one expert trajectory, in order, as each policy sees them; Frame is what
    the camera sees, and a policy that has no row.
    """
    views = pictures.strips
    return contact_sheet(np.stack([*views.values()]), [*views]) if views else None


def region(_: Results, pictures: Pictures) -> Figure | None:
    """The pixels that the masked latents reach, in the same moments; all others are faded."""
    if not pictures.region.any() or "Frame" not in pictures.strips:
        return None
    frames = pictures.strips["Frame"]
    faded = np.where(pictures.region[..., None], frames, 255 - (255 - frames) // 5)
    return contact_sheet(faded[None], ["region"])


def traversals(results: Results, pictures: Pictures) -> Figure | None:
    """What each latent draws: it alone moves, all others at their prior mean."""
    if not pictures.traversals.size:
        return None
    rows = [
        f"{subscript('o', latent + 1)}  {words.status(results, latent)}\nKL {fixed(kl, 2)} nats"
        for latent, kl in enumerate(results.kl)
    ]
    values = pictures.traversal_values
    columns = [f"{value:+.3g}".replace("-", "−") if value else "0" for value in values]
    title = "latent value (prior standard deviations)"
    return contact_sheet(pictures.traversals, rows, columns, title)


def contact_sheet(
    images: np.ndarray, rows: Sequence[str], columns: Sequence[str] = (), title: str = ""
) -> Figure:
    """Images uint8 [R, C, H, W, 3] in a labelled grid, every pixel a square of some pixels.

    Args:
      images: the pictures.
      rows: [R] labels.
      columns: [C] labels, or none at all.
      title: over the columns.
    """
    zoom, gap = canvas.zoom(images.shape[3], _PANEL), 6
    panels = images.repeat(zoom, axis=2).repeat(zoom, axis=3)
    panels[:, :, [0, -1]] = panels[:, :, :, [0, -1]] = 200  # a thin outline
    space = ((0, 0), (0, 0), (0, gap), (0, gap), (0, 0))
    panels = np.pad(panels, space, constant_values=255)
    down, along = panels.shape[2:4]
    sheet = np.concatenate([np.concatenate([*row], axis=1) for row in panels])[:-gap, :-gap]
    longest = max(len(line) for label in rows for line in label.splitlines())
    left, top, margin = max(190, 24 + 11 * longest), 64 if columns else 8, 8
    height, width = sheet.shape[0] + top + margin, sheet.shape[1] + left + margin
    dpi = rcParams["figure.dpi"]
    figure = Figure(figsize=(width / dpi, height / dpi))
    box = (left / width, margin / height, sheet.shape[1] / width, sheet.shape[0] / height)
    axes = figure.add_axes(box)
    axes.imshow(sheet, interpolation="none", aspect="auto")
    axes.set_yticks(np.arange(len(rows)) * down + (down - gap) / 2, map(_literal, rows))
    axes.set_xticks(np.arange(len(columns)) * along + (along - gap) / 2, columns)
    axes.tick_params(length=0, labeltop=True, labelbottom=False)
    axes.set_title(title, color=FAINT)
    axes.spines[:].set_visible(False)
    return figure


FIGURES = (rollouts, rollout_loss, dependence, frames, region, traversals)
