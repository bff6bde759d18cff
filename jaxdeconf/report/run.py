"""A run's figures and one self-contained report.html: numbers, pictures, config, versions.

Shapes: S state, A action, O latent, H reaction horizon.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from jaxdeconf.methods import METHODS
from jaxdeconf.pipeline.results import FILE, Losses, Pictures, Results, load
from jaxdeconf.pipeline.store import writing
from jaxdeconf.report import canvas, page, words
from jaxdeconf.report.about import about
from jaxdeconf.report.words import fixed, loss, number, percent, subscript


def write_report(directory: Path, results: Results, pictures: Pictures) -> None:
    """Writes `figures/` and `report.html` of one run.

    Args:
      directory: of the run; made if it is not there.
      results: its numbers.
      pictures: what the figures show.
    """
    canvas.import_matplotlib()
    from jaxdeconf.report.figures import FIGURES

    drawn = canvas.write(directory / "figures", FIGURES, results, pictures)
    body = [
        page.paragraph(["Initial-state interventions for deconfounded imitation learning"], "note"),
        page.paragraph([*words.of_mask(results), *words.of_policies(results)]),
        page.heading("Policies"),
        *_policies(results),
        page.heading("Figures"),
        *page.images(drawn),
        page.heading("Latents and actions"),
        *_dependences(results),
        page.heading("This run"),
        *_run(results),
    ]
    page.write(directory / "report.html", words.title(results), body)


def write_summary(directory: Path, runs: Sequence[Results]) -> None:
    """Writes `figures/rollout_loss.png` and a short `report.html` over several seeds.

    Args:
      directory: of the seeds' runs; made if it is not there.
      runs: one a seed, of the same config.
    """
    canvas.import_matplotlib()
    from jaxdeconf.report.figures import rollout_loss

    drawn = canvas.write(directory / "figures", [rollout_loss], averaged(runs))
    body = [*_seeds(runs), *page.images(drawn)]
    title = words.title(runs[0]).rpartition(", ")[0]
    page.write(directory / "report.html", f"{title}, {len(runs)} seeds", body)


def averaged(runs: Sequence[Results]) -> Results:
    """The first of several seeds, with the mean of all in the place of its rollout losses."""
    policies = {}
    for name, first in runs[0].policies.items():
        losses = [run.policies[name].rollout_loss for run in runs]
        mean = Losses.of(np.array([one.mean for one in losses], float))
        policies[name] = first._replace(rollout_loss=mean._replace(per_epoch=_over_seeds(losses)))
    expert = _mean([run.expert.rollout_loss for run in runs])[0]
    return runs[0]._replace(policies=policies, expert=runs[0].expert._replace(rollout_loss=expert))


def _over_seeds(losses: Sequence[Losses]) -> list[list[float]]:
    """[[epoch, mean, std], ...] of the seeds' means, at the epochs that every seed has."""
    curves = [{epoch: mean for epoch, mean, _ in one.per_epoch} for one in losses]
    epochs = sorted(set.intersection(*map(set, curves)))
    return [[epoch, *_mean([curve[epoch] for curve in curves])] for epoch in epochs]


def _mean(values: Sequence[float]) -> tuple[float, float]:
    """Mean and standard deviation; the latter is NaN where a value is not finite."""
    known = np.array(values, float)  # None, which JSON has for it, is NaN
    with np.errstate(invalid="ignore"):
        return float(known.mean()), float(known.std())


def redraw(directory: Path) -> str:
    """Writes the report of a finished run again; or of each seed, and their summary.

    Returns:
      Lines for the terminal.
    Raises:
      OSError, ValueError, KeyError, TypeError: if there is no finished run, or it cannot be read.
      WriteError: if the disk does not take what is drawn.
    """
    seeds = [file.parent for file in directory.glob(f"seed-*/{FILE}")]
    seeds.sort(key=lambda place: (len(place.name), place.name))  # 2 before 10
    runs, lines = [], []
    for place in seeds or [directory]:
        results, pictures = load(place)
        with writing(place):
            write_report(place, results, pictures)
        runs.append(results)
        lines.append(words.summary(results, place))
    if seeds:
        with writing(directory):
            write_summary(directory, runs)
        lines.append(f"summary: {directory / 'report.html'}")
    return "\n".join(lines)


def _policies(results: Results) -> Iterator[str]:
    expert, (head, rows) = results.expert, words.policies(results)
    note = (
        "Rollout loss: mean stage cost a step, ± standard error over rollouts. "
        f"{results.outcome.note} Copycat: mean change of the action over its limit, 0 to 2, when "
        "only the nuisance is redrawn. Leakage: share of the variance of what the nuisance "
        "shows, or of its square, that a regression finds in what the policy sees, on held-out "
        "frames."
    )
    yield page.table(head, rows, note)
    known = [name for name in words.ordered(results.policies) if name in METHODS]
    rows = [[name, METHODS[name].kind, METHODS[name].note] for name in known]
    note = "Oracle: is told what others must find out. Control: shows what a part does alone."
    yield page.table(["policy", "", "what it is cloned on"], rows, note, "words")
    yield page.paragraph(
        [
            f"The expert is outside its soft limits in {percent(expert.violation_rate)} of its "
            f"steps; its solver did not converge in {percent(expert.unconverged)} of them."
        ]
    )


def _dependences(results: Results) -> Iterator[str]:
    gamma, p_values, (symbol, name) = results.threshold, results.p_values, words.statistic(results)
    states = [f"{symbol}, {state}" for state in results.state_names]
    tests = np.stack([results.state_observation, p_values.state_observation])
    rows: list[list[page.Cell]] = []
    for latent, kl in enumerate(results.kl):
        became, share = words.status(results, latent), words.share(results.nuisance_share[latent])
        known = [fixed(kl, 2), share, fixed(results.nuisance_correlation[latent], 2)]
        cells = _cells(tests[:, :, latent], gamma)
        rows.append([subscript("o", latent + 1), (became, became), *known, *cells])
    note = (
        "Share: of its variance, what a regression on the previous action explains; |Spearman|: "
        f"with the previous action; both on held-out random-policy frames. {symbol}: the statistic "
        f"({name}), with its p-value under independence; bold above γ = {gamma:.3g}. Where a "
        "column takes few values, as an action does at its limit, it is R, on the same scale."
    )
    yield page.table(["latent", "", "KL (nats)", "share", "|Spearman|", *states], rows, note)
    tests = np.stack([results.state_action, p_values.state_action])
    rows = []
    for action, label in enumerate(results.action_names):
        for t in range(tests.shape[2]):
            cells = _cells(tests[:, :, t, action], gamma)
            rows.append([f"{subscript('a', t + 1)}  {label}", *cells])
    yield page.table(["expert action", *states], rows)


def _cells(tests: np.ndarray, gamma: float) -> Iterator[page.Cell]:
    """The statistic and p of every state, from [2, S]; bold above γ."""
    for statistic, p in tests.T:
        chance = "p < 0.001" if p < 1e-3 else f"p = {fixed(p, 3)}"
        yield f"{fixed(statistic, 5)}\n{chance}", "strong" if statistic > gamma else ""


def _run(results: Results) -> Iterator[str]:
    reconstruction = {
        "reconstruction error, nuisance's pixels": number(results.reconstruction.nuisance),
        "reconstruction error, elsewhere": number(results.reconstruction.elsewhere),
    }
    note = "Reconstruction error: summed squared error a frame, colours in [0, 1]."
    return about(results, reconstruction, note)


def _seeds(runs: Sequence[Results]) -> Iterator[str]:
    """The rollout losses, the masks and the ratios of every seed, and their means."""
    names, pairs = [*words.losses(runs[0])], words.ratios(runs[0])
    losses = np.array([[*words.losses(run).values()] for run in runs])
    ratios = np.array([[*words.ratios(run).values()] for run in runs])
    first, second = [], []
    for run, own, over in zip(runs, losses, ratios, strict=True):
        minutes = fixed(sum(run.seconds.values()) / 60.0, 1)
        first.append([str(run.seed), *map(loss, own)])
        second.append([first[-1][0], words.listing(words.masked(run)), *map(number, over), minutes])
    first.append(["mean", *map(words.mean, losses.T)])
    second.append(["mean", "", *map(words.mean, ratios.T), ""])
    head = ["seed", "masked", *(f"{above} / {below}" for above, below in pairs), "minutes"]
    yield page.table(
        ["seed", *names],
        first,
        "Rollout loss: mean stage cost a step; ± standard error over seeds.",
    )
    yield page.table(head, second, "Ratios of rollout losses; ± standard error over seeds.")
