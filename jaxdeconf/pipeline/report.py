"""A run's figures and one self-contained report.html: numbers, pictures, config, versions.

Shapes: S state, A action, O latent, H reaction horizon, T time, V traversal values, n frames.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdeconf.pipeline import findings, page
from jaxdeconf.pipeline.findings import fixed, loss, number, percent, subscript

POLICIES = ("BcVanilla", "BcManual", "Masked", "Reconstructed")


class Pictures(NamedTuple):
    """What the figures show, as NumPy arrays; images are uint8 RGB."""

    strips: dict[str, np.ndarray]  # view -> [n, 64, 64, 3], of the same expert trajectory
    traversals: np.ndarray  # [O, V, 64, 64, 3] one latent at each value, the others at their mean
    traversal_values: np.ndarray  # [V] in prior standard deviations
    rollouts: dict[str, np.ndarray]  # policy -> [T, 64, 64, 3], from the same start
    alive: dict[str, np.ndarray]  # policy -> bool [T], False once it has ended out of bounds
    dt: float  # s a frame


_CAPTIONS = {
    "rollouts.gif": "The policies from the same start, in real time. A rollout that leaves the "
    "bounds ends there and is greyed.",
    "rollout_loss.png": "Evaluation rollout loss across training epochs.",
    "dependence.png": "Algorithm 1: Hoeffding's D between the initial state and the latents of the "
    "first frame, and between the initial state and the expert's first actions. Cells above γ are "
    "hatched. A latent is masked if no state is hatched both in its column and in an action's.",
    "frames.png": "The same moments of one expert trajectory, in order, as each policy sees them; "
    "Frame is what the camera sees, and BcVanilla.",
    "traversals.png": "What each latent draws: it alone moves, all others at their prior mean.",
}


def write_report(directory: Path, results: dict, pictures: Pictures) -> None:
    """Writes `figures/` (four PNGs and a GIF) and `report.html` of one run.

    Args:
      directory: of the run; made if it is not there.
      results: what results.json holds.
      pictures: what the figures show.
    """
    folder = directory / "figures"
    _write_figures(folder, results, pictures)
    *sentences, verdict = findings.paragraph(results)
    body = [
        page.paragraph(["Initial-state interventions for deconfounded imitation learning"], "note"),
        page.paragraph(sentences),
        page.paragraph([verdict], "strong"),
        page.heading("Policies"),
        *_policies(results),
        page.heading("Figures"),
        *(page.image(folder / name, caption) for name, caption in _CAPTIONS.items()),
        page.heading("Latents and actions"),
        *_dependences(results),
        page.heading("This run"),
        *_run(results),
    ]
    title = f"{results['system']}, preset {results['preset']}, seed {results['seed']}"
    page.write(directory / "report.html", title, body)


def write_summary(directory: Path, runs: Sequence[dict]) -> None:
    """Writes `figures/rollout_loss.png` and a short `report.html` over several seeds.

    Args:
      directory: of the seeds' runs; made if it is not there.
      runs: what each seed's results.json holds.
    """
    from jaxdeconf.pipeline import figures  # late, as in _write_figures

    curves = {name: over_seeds(runs, name) for name in POLICIES}
    expert = float(np.mean([findings.mean_loss(run, "Expert") for run in runs]))
    file = directory / "figures" / "rollout_loss.png"
    figures.save(figures.rollout_loss(curves, expert, f"{len(runs)} seeds' means"), file)
    body = [*_seeds(runs), page.image(file, "Evaluation rollout loss across training epochs.")]
    title = f"{runs[0]['system']}, preset {runs[0]['preset']}, {len(runs)} seeds"
    page.write(directory / "report.html", title, body)


def _write_figures(folder: Path, results: dict, pictures: Pictures) -> None:
    # Late: matplotlib takes a second to import that a run without a report need not spend.
    from jaxdeconf.pipeline import animation, figures

    curves = {name: _per_epoch(results, name) for name in POLICIES}
    expert, views = findings.mean_loss(results, "Expert"), list(pictures.strips)
    drawn = {
        "dependence": figures.dependence(results),
        "rollout_loss": figures.rollout_loss(curves, expert, "rollouts"),
        "frames": figures.contact_sheet(np.stack([pictures.strips[view] for view in views]), views),
        "traversals": figures.traversals(results, pictures.traversals, pictures.traversal_values),
    }
    for name, figure in drawn.items():
        figures.save(figure, folder / f"{name}.png")
    shown = [name for name in ("Expert", *POLICIES[:3]) if name in pictures.rollouts]
    clips = {name: pictures.rollouts[name] for name in shown}
    animation.write_rollouts(folder / "rollouts.gif", clips, pictures.alive, pictures.dt)


def _per_epoch(results: dict, policy: str) -> list[list[float]]:
    return results["policies"].get(policy, {}).get("rollout_loss", {}).get("per_epoch") or []


def over_seeds(runs: Sequence[dict], policy: str) -> list[list[float]]:
    """[[epoch, mean, std], ...] of the seeds' means, at the epochs that every seed has."""
    means = [{point[0]: point[1] for point in _per_epoch(run, policy)} for run in runs]
    curve = []
    for epoch in sorted(set.intersection(*(set(mean) for mean in means))):
        values = np.array([mean[epoch] for mean in means], float)
        with np.errstate(invalid="ignore"):  # the spread of infinities is NaN
            curve.append([epoch, float(values.mean()), float(values.std())])
    return curve


def _policies(results: dict) -> Iterator[str]:
    rows, form = [], results["outcome"]
    for name in [name for name in POLICIES if name in results["policies"]]:
        policy = results["policies"][name]
        rollout = policy.get("rollout_loss", {})
        mean, std = loss(rollout.get("mean")), number(rollout.get("std"))
        scores = [fixed(policy.get(score), 3) for score in ("copycat", "leakage")]
        rest = [findings.outcome(results, policy), *scores, loss(policy.get("train_loss"))]
        rows.append([name, f"{mean} ± {std}", *rest])
    expert = results["expert"]
    came_to = findings.outcome(results, expert)
    rows.append(["Expert", loss(expert["rollout_loss"]), came_to, "–", "–", "–"])
    yield page.table(
        ["", "rollout loss", form["name"], "copycat", "leakage R²", "train loss"],
        rows,
        "Rollout loss: mean stage cost a step, ± standard deviation over rollouts. "
        f"{form['note']} "
        "Copycat: mean change of the action over its limit, "
        "0 to 2, when only the nuisance is redrawn. Leakage: share of the previous action's "
        "variance that a regression finds in what the policy sees, on held-out frames.",
    )
    yield page.paragraph(
        [
            f"The expert is outside its soft limits in {percent(expert.get('violation_rate'))} of "
            "its steps; its solver did not converge in "
            f"{percent(expert.get('unconverged'))} of them."
        ]
    )


def _dependences(results: dict) -> Iterator[str]:
    gamma, p_values = results["threshold"], results["p_values"]
    statistics = np.asarray(results["state_observation"], float)
    tests = np.asarray(p_values["state_observation"], float)
    head = [f"D, {name}" for name in results["state_names"]]
    rows: list[list[page.Cell]] = []
    for latent, kl in enumerate(results["kl"]):
        became = findings.status(results, latent)
        known = [fixed(results[f"nuisance_{of}"][latent], 2) for of in ("share", "correlation")]
        about = [subscript("o", latent + 1), (became, became), fixed(kl, 2), *known]
        rows.append([*about, *_cells(statistics[:, latent], tests[:, latent], gamma)])
    yield page.table(
        ["latent", "", "KL (nats)", "share", "|Spearman|", *head],
        rows,
        "Share: of its variance, what a regression on the previous action explains; |Spearman|: "
        "with the previous action; both on held-out random-policy frames. D: Hoeffding's "
        f"statistic, with its p-value under independence; bold above γ = {gamma:.3g}.",
    )
    statistics = np.asarray(results["state_action"], float)
    tests = np.asarray(p_values["state_action"], float)
    names = enumerate(results["action_names"])
    steps = range(statistics.shape[1])
    yield page.table(
        ["expert action", *head],
        [
            [
                f"{subscript('a', t + 1)}  {name}",
                *_cells(statistics[:, t, a], tests[:, t, a], gamma),
            ]
            for a, name in names
            for t in steps
        ],
    )


def _cells(statistics: np.ndarray, tests: np.ndarray, gamma: float) -> Iterator[page.Cell]:
    """D (p) of every state; bold above γ."""
    for statistic, p in zip(statistics, tests, strict=True):
        chance = "p < 0.001" if p < 1e-3 else f"p = {fixed(p, 3)}"
        yield f"{fixed(statistic, 5)}\n{chance}", "strong" if statistic > gamma else ""


def _run(results: dict) -> Iterator[str]:
    seconds = {**results["seconds"], "total": sum(results["seconds"].values())}
    yield page.table(["stage", "seconds"], [[stage, f"{s:.1f}"] for stage, s in seconds.items()])
    error = results["reconstruction"]
    about = {
        **results["versions"],
        "peak memory": f"{results['peak_memory_mb']:.0f} MB",
        "reconstruction error, nuisance's pixels": number(error["nuisance"]),
        "reconstruction error, elsewhere": number(error["elsewhere"]),
    }
    note = "Reconstruction error: summed squared error a frame, colours in [0, 1]."
    yield page.table(["made with", ""], [[k, str(v)] for k, v in about.items()], note, "words")
    fields = [list(leaf) for leaf in _leaves(results["config"])]
    yield page.folded("Config", page.table(["field", "value"], fields, kind="words"))


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """(`bc.learning_rate`, `0.001`) of every leaf of a nested dict."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, f"{name}.{key}" if name else str(key))
    else:
        yield name, str(value)


def _seeds(runs: Sequence[dict]) -> Iterator[str]:
    """The rollout losses, the masks and the ratios of every seed, and their means."""
    names = ["Expert", *POLICIES]
    losses = np.array([[findings.mean_loss(run, name) for name in names] for run in runs])
    seeds = [str(run["seed"]) for run in runs]
    rows = [[seed, *map(loss, row)] for seed, row in zip(seeds, losses, strict=True)]
    rows.append(["mean", *map(loss, losses.mean(axis=0))])
    yield page.table(["seed", *names], rows, "Rollout loss: mean stage cost a step.")
    judged: list[list[page.Cell]] = []
    ratios = [findings.ratios(run) for run in runs]
    for seed, run, found in zip(seeds, runs, ratios, strict=True):
        right = findings.of_mask(run)[1]
        mask = (findings.listing(findings.masked(run)), "" if right else "missed")
        minutes = fixed(sum(run["seconds"].values()) / 60.0, 1)
        cells = [(number(ratio.value), "" if ratio.reached else "missed") for ratio in found]
        judged.append([seed, mask, *cells, minutes])
    mean = np.array([[ratio.value for ratio in found] for found in ratios]).mean(axis=0)
    judged.append(["mean", "", *map(number, mean), ""])
    head = [f"{ratio.above} / {ratio.below}\n({ratio.goal})" for ratio in ratios[0]]
    yield page.table(
        ["seed", "masked", *head, "minutes"],
        judged,
        "Ratios of rollout losses and their goals; of the latents, exactly the nuisance's are to "
        "be masked. What misses its goal is in red.",
    )
