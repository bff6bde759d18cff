"""What a run found, in words computed from its numbers: the report's opening paragraph.

A goal that is missed, or cannot be judged because a number is not finite, is said to be missed.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

# Share of a latent's variance that the previous action explains: of the nuisance's latents, and of
# every other active one.
SAME, _APART = 0.9, 0.1
# The project's goals for the `laptop` presets, at which the paper's result counts as shown.
_RATIOS = {
    "cartpole": (
        ("Masked", "BcManual", 1.5, "at most"),
        ("BcVanilla", "BcManual", 3.0, "at least"),
        ("BcManual", "Expert", 2.0, "at most"),
    ),
    "reacher": (
        ("Masked", "BcManual", 1.5, "at most"),
        ("BcVanilla", "BcManual", 2.0, "at least"),
    ),
}


class Ratio(NamedTuple):
    """One policy's rollout loss over another's, and whether that reached its goal."""

    above: str
    below: str
    value: float
    goal: str
    reached: bool


def number(value: float | None, undefined: str = "undefined") -> str:
    """A number to three significant digits; `–` for None, and a word where it is not finite."""
    if value is None:
        return "–"
    if not math.isfinite(value):
        return undefined
    if value != 0.0 and not 1e-3 <= abs(value) < 1e4:
        return f"{value:.1e}"
    return f"{value:#.3g}".rstrip(".")


def fixed(value: float | None, places: int) -> str:
    """A number to so many decimal places, so that a column lines up."""
    if value is None or not math.isfinite(value):
        return number(value)
    return f"{value:.{places}f}"


def loss(value: float | None) -> str:
    """A loss; one that is not finite has diverged."""
    return number(value, "diverged")


def percent(share: float | None) -> str:
    """A share in [0, 1] as a percentage."""
    if share is None or not math.isfinite(share):
        return number(share)
    return f"{100.0 * share:.3g} %"


def outcome(results: dict, judged: dict) -> str:
    """What the rollouts of a policy, or of the expert, came to, in its system's own form."""
    value = judged.get("outcome")
    if value is None or not math.isfinite(value):
        return number(value)
    return format(value, results["outcome"]["form"])


def mean_loss(results: dict, policy: str) -> float:
    """The rollout loss of a policy or of the expert; NaN if the run does not have it."""
    if policy == "Expert":
        value = results["expert"]["rollout_loss"]
    else:
        value = results["policies"].get(policy, {}).get("rollout_loss", {}).get("mean")
    return math.nan if value is None else float(value)


def ratios(results: dict) -> list[Ratio]:
    """The ratios of rollout losses that show the paper's result on this system."""
    found = []
    for above, below, bound, side in _RATIOS.get(results["system"], ()):
        denominator = mean_loss(results, below)
        value = mean_loss(results, above) / denominator if denominator else math.nan
        reached = value <= bound if side == "at most" else value >= bound
        reached = reached and math.isfinite(value)
        found.append(Ratio(above, below, value, f"{side} {bound:g}", reached))
    return found


def status(results: dict, latent: int) -> str:
    """What became of a latent: `inactive` (at its prior mean in every view), `masked` or `kept`."""
    if not results["active"][latent]:
        return "inactive"
    return "masked" if results["mask"][latent] else "kept"


def subscript(symbol: str, index: int) -> str:
    """`o` and 12 as o₁₂; counted from 1, as in the paper."""
    return symbol + str(index).translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


def listing(latents: Sequence[int]) -> str:
    """Latents by name: `o₁, o₂ and o₅`, or `none`."""
    names = [subscript("o", latent + 1) for latent in latents]
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]])) or "none"


def masked(results: dict) -> list[int]:
    """The active latents that Algorithm 1 masked."""
    return [o for o in range(len(results["mask"])) if status(results, o) == "masked"]


def of_mask(results: dict) -> tuple[list[str], bool]:
    """Sentences on what was masked, and whether it is the nuisance's latents and nothing else."""
    active = [latent for latent, is_active in enumerate(results["active"]) if is_active]
    if not active:
        return ["No latent is active: the β-VAE has learnt nothing, and the mask is empty."], False
    share, correlation = results["nuisance_share"], results["nuisance_correlation"]
    chosen = masked(results)
    nuisance = [latent for latent in active if share[latent] >= SAME]
    mixed = [latent for latent in active if _APART < share[latent] < SAME]
    sentences = [
        f"Of {len(results['active'])} latents, {len(active)} are active; of these, Algorithm 1 "
        f"masked {listing(chosen)} (γ = {results['threshold']:.3g})."
    ]
    for latent in chosen:
        role = "it is the nuisance's" if latent in nuisance else "it is not the nuisance's alone"
        sentences.append(
            f"The previous action explains {percent(share[latent])} of {listing([latent])} "
            f"(|Spearman| {fixed(correlation[latent], 2)}): {role}."
        )
    if not nuisance:
        sentences.append(
            f"The previous action explains {percent(SAME)} of no active latent: the nuisance is "
            "not disentangled."
        )
    missed = [latent for latent in nuisance if latent not in chosen]
    if missed:
        sentences.append(f"The nuisance's {listing(missed)} was kept.")
    if mixed:
        sentences.append(
            f"A part of the nuisance also shows in {listing(mixed)}: the previous action explains "
            f"more than {percent(_APART)}."
        )
    return sentences, bool(nuisance) and chosen == nuisance


def of_policies(results: dict) -> list[str]:
    """A sentence on each ratio of rollout losses."""
    words = []
    for ratio in ratios(results):
        verdict = "reached" if ratio.reached else "missed"
        below = "the expert" if ratio.below == "Expert" else ratio.below
        times = (
            f"{number(ratio.value)} times" if math.isfinite(ratio.value) else "not comparable to"
        )
        words.append(
            f"{ratio.above}'s rollout loss is {times} {below}'s (goal: {ratio.goal}; {verdict})."
        )
    return words


def paragraph(results: dict) -> list[str]:
    """The whole paragraph, a sentence an item; the last one is the verdict."""
    sentences, right_mask = of_mask(results)
    missed = [f"{ratio.above} / {ratio.below}" for ratio in ratios(results) if not ratio.reached]
    missed = ([] if right_mask else ["mask exactly the nuisance's latents"]) + missed
    verdict = f"Goals missed: {'; '.join(missed)}." if missed else "All goals are reached."
    if results["preset"] != "laptop":
        verdict += " They are set for the laptop preset."
    return [*sentences, *of_policies(results), verdict]
