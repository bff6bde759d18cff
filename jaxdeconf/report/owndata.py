"""A masking's figures and one self-contained report.html: the verdict first, then the evidence."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdeconf.formats.source import Source
from jaxdeconf.owndata.check import Check
from jaxdeconf.owndata.config import Masking
from jaxdeconf.owndata.cost import Cost
from jaxdeconf.owndata.results import Found
from jaxdeconf.pipeline.results import Pictures, load
from jaxdeconf.pipeline.store import writing
from jaxdeconf.report import canvas, page, words
from jaxdeconf.report.about import about
from jaxdeconf.report.words import fixed, number, percent, subscript

_LEAKS, _LOST = 0.05, 0.95  # R² that written frames may tell; share of a state's that they must
_TOLD = (
    0.5  # R² from which on recorded frames tell a state; below, it is the regression that varies
)


def write_report(directory: Path, found: Found, pictures: Pictures) -> None:
    """Writes `figures/` and `report.html` of a masking."""
    canvas.import_matplotlib()
    from jaxdeconf.report.figures import dependence, region

    figures = (frames, region, dependence) if len(found.mask) else (frames, region)
    alone = found._replace(mask=found.asked)  # what the figure calls Algorithm 1's
    drawn = canvas.write(directory / "figures", figures, alone, pictures)
    body = [
        page.paragraph(verdict(found)),
        page.heading("Figures"),
        *page.images(drawn),
        page.heading("What was kept and what is gone"),
        *_comparison(found),
        *_clones(found),
        page.heading("Before training"),
        page.paragraph(of_check(found.check)),
        _moves(found),
        page.heading("Latents"),
        *_latents(found),
        page.heading("This masking"),
        *about(found),
    ]
    page.write(directory / "report.html", f"{found.config['demos']}, masked", body)


def redraw(directory: Path) -> Found:
    """Writes the report of a finished masking, again if there is one; returns what it found.

    Raises:
      OSError, ValueError, KeyError, TypeError: if there is none, or it cannot be read.
      WriteError: if the disk does not take what is drawn.
    """
    found, pictures = load(directory, Found)
    with writing(directory):
        write_report(directory, found, pictures)
    return found


def frames(found: Found, pictures: Pictures) -> Any:
    """The same moments of one demonstration, in order: as they were recorded, and as they are
    written.
    """
    from jaxdeconf.report import figures  # late: it loads matplotlib

    return figures.frames(found, pictures)  # type: ignore


def verdict(found: Found) -> list[str]:
    """What became of the dataset, in sentences."""
    if found.refused is not None:
        return [f"Nothing was written: {found.refused}."]
    mask, active, asked, share = found.mask, found.active, found.asked, found.nuisance_share
    chosen, kept = np.flatnonzero(mask).tolist(), np.flatnonzero(asked & ~mask).tolist()
    said = [f"Of {int(active.sum())} active latents, {words.listing(chosen)} masked."]
    if not chosen and not kept:
        said.append("Nothing in the first frames is independent of what moves the expert.")
    for latent in chosen:
        said.append(
            f"The previous action explains {percent(share[latent])} of {words.listing([latent])}."
        )
    if kept:
        said.append(
            f"Algorithm 1 would have masked {words.listing(kept)}; but {found.check.episodes} "
            f"episodes show only correlations from about {found.check.visible:.2g} on, and the "
            "previous action does not explain what is shown there: it is kept."
        )
    if found.written is None or found.leakage is None:
        return said
    raw, _, written = found.leakage
    said.append(
        f"Frames as recorded tell the previous action (R² {fixed(raw, 2)}); as written, "
        + ("nothing of it" if written <= _LEAKS else "still some of it")
        + f" (R² {fixed(written, 2)})."
    )
    told = {name: pair for name, pair in found.retention.items() if pair[0] > _TOLD}
    lost = [name for name, (a, b) in told.items() if b < _LOST * a]
    if lost:
        names = ", ".join(lost)
        said.append(f"Written frames tell less of {names}: too much may be masked.")
    elif told:
        names = ", ".join(told)
        said.append(f"Of what moves the expert, written frames tell as much as recorded: {names}.")
    else:
        said.append("Of the states that move the expert, recorded frames tell a regression none.")
    pixels, size = found.written.region_pixels, found.config["size"]
    where = f"{percent(pixels / size**2)} of the pixels were redrawn"
    whole = "the masked latents' reach is not local: every frame was reconstructed as a whole"
    said.append(f"{(where if found.written.mode == 'inpaint' else whole).capitalize()}.")
    return said


def of_sources(config: Masking, sources: Sequence[Source]) -> list[str]:
    """What was taken of each input, a line an input, and what is to be said of it."""
    said = [_of_source("demonstrations", sources[0]), *sources[0].notes]
    if config.exploration is not None:
        return [*said, _of_source("exploration", sources[1])]
    none = (
        "exploration: none, so the β-VAE learns from the demonstrations; frames under random "
        "actions part the nuisance from the pose better"
    )
    return [*said, none]


def _of_source(name: str, source: Source) -> str:
    height, width = source.size
    low, high = source.lengths.min(), source.lengths.max()
    limit = "their limits" if source.limit is not None else "the largest of each"
    states = source.initial_states
    began = "" if states is None else f", initial states of {states.shape[1]} numbers"
    return (
        f"{name}: {source.frames} {height} × {width}, {len(source.lengths)} episodes of {low} to "
        f"{high} steps, actions of {source.actions.shape[1]} numbers over {limit}{began}"
    )


def of_cost(cost: Cost) -> str:
    """What is to come."""
    return (
        f"A masking takes about {cost.minutes:.1f} min of processor time here, and "
        f"{cost.memory_mb / 1024:.1f} GB of memory."
    )


def of_check(check: Check) -> list[str]:
    """What was seen before training, in sentences."""
    moves = check.state_action.max(axis=2) > check.threshold  # [S, H]
    said = [
        f"{name} from step {int(row.argmax()) + 1} on"
        for name, row in zip(check.state_names, moves, strict=True)
        if row.any()
    ]
    head = f"States that move the actions: {', '.join(said) or 'none'}."
    return [head, f"The reaction horizon is {check.horizon}.", *check.notes]


def summary(found: Found, directory: Path) -> str:
    """Lines for the terminal."""
    return "\n  ".join([*verdict(found), f"report: {directory / 'report.html'}"])


def _comparison(found: Found) -> Iterator[str]:
    if found.leakage is None:
        return
    raw, reconstructed, written = (fixed(value, 3) for value in found.leakage)
    rows = [["previous action", raw, reconstructed, written]]
    rows += [[name, fixed(a, 3), "–", fixed(b, 3)] for name, (a, b) in found.retention.items()]
    note = (
        "R² of a regression from frames that it has not seen: of the previous action or its size, "
        "which is to be gone, and of each initial state that moves an action, which is to be kept."
    )
    yield page.table(["", "recorded", "reconstructed", "written"], rows, note)


def _clones(found: Found) -> Iterator[str]:
    if not found.clones:
        return
    rows = [
        [f"as {name}", number(one.error), number(one.copycat)] for name, one in found.clones.items()
    ]
    note = (
        "Policies cloned from frames as recorded and as written, on a tenth of the episodes, which "
        "they have not seen. Error: mean squared, of the action over its limit. Copycat: mean "
        "change of the action over its limit, 0 to 2, when of a frame only the redrawn pixels are "
        "taken from another one."
    )
    yield page.table(["cloned from frames", "error", "copycat"], rows, note)


def _moves(found: Found) -> str:
    check = found.check
    head = ["state", *(subscript("a", step + 1) for step in range(check.state_action.shape[1]))]
    rows = [
        [name, *((fixed(d, 4), "strong" if d > check.threshold else "") for d in row.max(axis=1))]
        for name, row in zip(check.state_names, check.state_action, strict=True)
    ]
    note = f"Hoeffding's D of each state and action; bold above γ = {check.threshold:.3g}."
    return page.table(head, rows, note)


def _latents(found: Found) -> Iterator[str]:
    if not len(found.mask):
        return
    rows = []
    for latent, kl in enumerate(found.kl):
        became = words.status(found, latent)
        cells = [fixed(kl, 2), words.share(found.nuisance_share[latent])]
        cells += [fixed(value, 2) for value in (found.spread[latent], found.stability[latent])]
        rows.append([subscript("o", latent + 1), (became, became), *cells])
    note = (
        "Share: of its variance, what the previous action explains. Spread: in first frames, over "
        "that in exploration frames; a low one says that first frames do not vary it. Stability: "
        "share of 50 resamples of 63 % of the episodes in which Algorithm 1 says the same."
    )
    head = ["latent", "", "KL (nats)", "share", "spread", "stability"]
    yield page.table(head, rows, note)
    rows = [[name, words.listing(latents)] for name, latents in found.elsewhere.items()]
    yield page.table(["at", "Algorithm 1 masks"], rows, kind="words")
