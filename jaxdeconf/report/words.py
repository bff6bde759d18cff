"""What a run found, in words computed from its numbers; and how a report writes numbers and names.

A number that is not finite is said to be so, never left out.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdeconf.methods import METHODS
from jaxdeconf.owndata.results import Found
from jaxdeconf.pipeline.plain import to_plain
from jaxdeconf.pipeline.results import APART, SAME, Judged, JudgedExpert, Losses, Results, Row
from jaxdeconf.pipeline.store import differences
from jaxdeconf.presets import PRESETS

EXPERT = "Expert"  # named as the methods are, in tables and pictures
_STATISTICS = {"hoeffding": ("D", "Hoeffding's D"), "refined": ("R", "R, refined")}
_CHANGES = 4  # that a title names


def number(value: float | None, undefined: str = "undefined") -> str:
    """A number to three significant digits; `–` for None, and a word where it is not finite."""
    if value is None:
        return "–"
    if not math.isfinite(value):
        return undefined
    if value != 0.0 and not 1e-3 <= abs(value) < 1e4:
        return f"{value:.1e}"
    return f"{value:#.3g}".rstrip(".")


def fixed(value: float, places: int) -> str:
    """A number to so many decimal places, so that a column lines up."""
    return f"{value:z.{places}f}" if math.isfinite(value) else number(value)


def loss(value: float) -> str:
    """A loss; one that is not finite has diverged."""
    return number(value, "diverged")


def spread(losses: Losses) -> str:
    """Mean and its standard error, where there is one."""
    known = math.isfinite(losses.mean) and math.isfinite(losses.error)
    return f"{loss(losses.mean)} ± {number(losses.error)}" if known else loss(losses.mean)


def mean(values: np.ndarray) -> str:
    """Mean of several seeds' numbers, and its standard error."""
    return spread(Losses.of(values))


def percent(share: float) -> str:
    """A share in [0, 1] as a percentage; an R² below 0 explains nothing."""
    return f"{100.0 * max(share, 0.0):.3g} %" if math.isfinite(share) else number(share)


def share(value: float) -> str:
    """An R² in a column; one below 0 explains nothing."""
    return fixed(max(value, 0.0), 2)


def outcome(results: Results, judged: Judged | JudgedExpert) -> str:
    """What the rollouts of a policy, or of the expert, came to, in its system's own form."""
    return formed(judged.outcome, results.outcome.form)


def formed(value: float, form: str) -> str:
    """A number by a format specification, if there is one to show."""
    return format(value, form) if math.isfinite(value) else number(value)


def statistic(results: Results) -> tuple[str, str]:
    """The symbol and the name of the mask's statistic."""
    return _STATISTICS.get(results.statistic, ("statistic", results.statistic))


def subscript(symbol: str, index: int) -> str:
    """`o` and 12 as o₁₂; counted from 1, as in the paper."""
    return symbol + str(index).translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


def listing(latents: Sequence[int]) -> str:
    """Latents by name: `o₁, o₂ and o₅`, or `none`."""
    names = [subscript("o", latent + 1) for latent in latents]
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]])) or "none"


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """(`clone.epochs`, 50) of every leaf of a nested dict."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f"{name}.{key}" if name else str(key))
    else:
        yield name, value


def shown(value: Any) -> str:
    """The value of a config's field, as a flag takes it."""
    if isinstance(value, list | tuple):
        return " ".join(map(shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def subject(system: str, preset: str, config: Any) -> str:
    """A system and a preset, and the fields of a config, typed or plain, that differ from it.

    Where there is no such preset, the system is all that can be said.
    """
    usual = PRESETS.get(system, {}).get(preset)
    if usual is None:
        return system
    found = differences(to_plain(usual), to_plain(config))
    changes = [f"{name} {shown(value)}" for name, _, value in found if name != "seed"]
    more = f" and {len(changes) - _CHANGES} more" if len(changes) > _CHANGES else ""
    words = f" with {', '.join(changes[:_CHANGES])}{more}" if changes else ""
    return f"{system}, preset {preset}{words}"


def title(results: Results) -> str:
    """What was run."""
    return f"{subject(results.system, results.preset, results.config)}, seed {results.seed}"


def ordered(names: Iterable[str]) -> list[str]:
    """Methods in the order of their table; those that are not in it come last."""
    places = {name: place for place, name in enumerate(METHODS)}
    return sorted(names, key=lambda name: places.get(name, len(places)))


def kind(name: str) -> str:
    """A method's kind; one that is not in the table is taken for a fair one."""
    return METHODS[name].kind if name in METHODS else "fair"


def losses(results: Results) -> dict[str, float]:
    """The rollout losses of the expert and of the policies, in the table's order."""
    names = ordered(results.policies)
    policies = {name: results.policies[name].rollout_loss.mean for name in names}
    return {EXPERT: results.expert.rollout_loss} | policies


def ratios(results: Results) -> dict[tuple[str, str], float]:
    """Rollout losses over the first oracle's, and that over the expert's; controls have none.

    Without an oracle, all are over the expert's. NaN is what cannot be compared.
    """
    known = losses(results)
    names = [name for name in known if name != EXPERT and kind(name) != "control"]
    reference = next((name for name in names if kind(name) == "oracle"), EXPERT)
    pairs = [(name, reference) for name in names if name != reference]
    if reference != EXPERT:
        pairs.append((reference, EXPERT))
    return {pair: _over(*(known[name] for name in pair)) for pair in pairs}


def _over(above: float, below: float) -> float:
    return above / below if below and math.isfinite(below) else math.nan


def status(results: Results | Found, latent: int) -> str:
    """What became of a latent: `inactive` (at its prior mean in every view), `masked` or `kept`."""
    if not results.active[latent]:
        return "inactive"
    return "masked" if results.mask[latent] else "kept"


def masked(found: Results | Row) -> list[int]:
    """The active latents that Algorithm 1 masked; none if there is no mask."""
    return [] if found.mask is None else np.flatnonzero(found.mask & found.active).tolist()


def of_mask(results: Results) -> list[str]:
    """Sentences on what was masked, and what of it is the nuisance's."""
    active = np.flatnonzero(results.active).tolist()
    if not active:
        return ["No latent is active: the β-VAE has learnt nothing, and nothing is masked."]
    share, chosen = results.nuisance_share, masked(results)
    nuisance = [latent for latent in active if share[latent] >= SAME]
    mixed = [latent for latent in active if APART < share[latent] < SAME]
    kept = [latent for latent in nuisance if latent not in chosen]
    sentences = [
        f"Of {len(results.active)} latents, {len(active)} are active; of these, Algorithm 1 "
        f"masked {listing(chosen)} (γ = {results.threshold:.3g})."
    ]
    if chosen and results.region is not None:
        whole = "all pixels: their reach is not local" if results.region == 1.0 else ""
        of = whole or f"{percent(results.region)} of the image's pixels"
        sentences.append(f"The masked latents reach {of}.")
    for latent in chosen:
        role = "it is the nuisance's" if latent in nuisance else "it is not the nuisance's alone"
        sentences.append(
            f"The previous action explains {percent(share[latent])} of {listing([latent])} "
            f"(|Spearman| {fixed(results.nuisance_correlation[latent], 2)}): {role}."
        )
    if not nuisance:
        sentences.append(
            f"The previous action explains {percent(SAME)} of no active latent: the nuisance is "
            "not disentangled."
        )
    if kept:
        sentences.append(f"The nuisance's {listing(kept)} was kept.")
    if mixed:
        sentences.append(
            f"A part of the nuisance also shows in {listing(mixed)}: the previous action explains "
            f"more than {percent(APART)}."
        )
    return sentences


def of_policies(results: Results) -> list[str]:
    """A sentence on each ratio of rollout losses."""
    words = []
    for (above, below), value in ratios(results).items():
        times = f"{number(value)} times" if math.isfinite(value) else "not comparable to"
        whose = "the expert" if below == EXPERT else below
        words.append(f"{above}'s rollout loss is {times} {whose}'s.")
    return words


def policies(results: Results) -> tuple[list[str], list[list[str]]]:
    """Head and rows of a table of what policies, and the expert, came to."""
    scores = ["copycat", "leakage R²", "train loss"]
    head = ["", "rollout loss", "median", results.outcome.name, *scores]
    rows = []
    for name in ordered(results.policies):
        judged = results.policies[name]
        scores = [fixed(judged.copycat, 3), fixed(judged.leakage, 3), loss(judged.train_loss)]
        driven = judged.rollout_loss
        drove = [spread(driven), loss(driven.median), outcome(results, judged)]
        rows.append([name, *drove, *scores])
    expert = [loss(results.expert.rollout_loss), "–", outcome(results, results.expert)]
    return head, [*rows, [EXPERT, *expert, "–", "–", "–"]]


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A table for the terminal, a line a row."""
    lines = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join(map(str.rjust, line, widths)) for line in lines]


def summary(results: Results, directory: Path) -> str:
    """Lines for the terminal: what was masked, how each policy drove, where the report is."""
    told = [*of_mask(results), *aligned(*policies(results)), f"report: {directory / 'report.html'}"]
    return "\n  ".join([title(results), *told])
