"""The theory's page: each claim, in figures and in rates with their counts."""

from collections.abc import Iterator
from pathlib import Path

from jaxdeconf.pipeline.results import Pictures, load
from jaxdeconf.pipeline.store import writing
from jaxdeconf.pipeline.theory import Theory
from jaxdeconf.report import canvas, page, words
from jaxdeconf.report.about import about
from jaxdeconf.theory.claims import Rate

CLAIMS = {
    "conservative": "Theorem 1: a true cause is not masked. How often it is",
    "no_more_conservative": "Theorem 2: what is rightly masked without the intervention is masked "
    "with it. How often it is",
    "strictly_less": "The proposition: in a fork, only the intervention lets the observation be "
    "masked. How often it is",
    "pixels": "CartPole: the seed sets the start and the first square",
    "pairs": "A cause that no state shows alone, by what is tested",
    "threshold": "What the threshold trades, and how many trajectories a dependence takes",
}


def write_report(directory: Path, found: Theory, pictures: Pictures) -> None:
    """Writes `figures/` and `report.html` of the experiments."""
    canvas.import_matplotlib()
    from jaxdeconf.report.theory_figures import FIGURES

    drawn = canvas.write(directory / "figures", FIGURES, found, pictures)
    body = [page.heading("Figures"), *page.images(drawn)]
    for claim, title in CLAIMS.items():
        if rows := getattr(found, claim):
            body += [page.heading(title), table(rows)]
    body += [page.heading("This run"), *_about(found)]
    page.write(directory / "report.html", "What the intervention is for", body)


def redraw(directory: Path) -> str:
    """Writes the report of finished experiments, again if there is one.

    Returns:
      Lines for the terminal.
    Raises:
      OSError, ValueError, KeyError, TypeError: if there are none, or they cannot be read.
      WriteError: if the disk does not take what is drawn.
    """
    found, pictures = load(directory, Theory)
    with writing(directory):
        write_report(directory, found, pictures)
    return summary(found, directory)


def table(rows: list[Rate]) -> str:
    """A row a rate."""
    head = ["", "N", "γ", "tests", "counted", "rate", "95 %", "by theory"]
    lines = [
        [
            row.case,
            str(row.trajectories),
            words.number(row.threshold),
            str(row.tests or "–"),
            f"{row.events} of {row.n}",
            words.fixed(row.rate, 3),
            " to ".join(words.fixed(end, 3) for end in row.interval),
            words.number(row.predicted),
        ]
        for row in rows
    ]
    return page.table(head, lines)


def summary(found: Theory, directory: Path) -> str:
    """Lines for the terminal: each claim at the most trajectories that it was tested with."""
    said = []
    for claim in CLAIMS:
        rows: dict[str, Rate] = {row.case: row for row in getattr(found, claim)}
        lines = [
            f"{row.case}, N = {row.trajectories}: {words.fixed(row.rate, 3)} of {row.n}"
            for row in rows.values()
        ]
        said += [f"{claim}", *(f"  {line}" for line in lines)]
    return "\n".join([*said, f"report: {directory / 'report.html'}"])


def _about(found: Theory) -> Iterator[str]:
    policies = [
        [
            f"{one.coupling:g}",
            words.listing([place for place, hidden in enumerate(one.mask) if hidden]),
            f"{words.loss(one.loss)} ± {words.number(one.error)}",
            words.percent(one.survival),
            words.fixed(one.copycat, 3),
        ]
        for one in found.driven
    ]
    if policies:
        head = ["not intervened", "masked", "rollout loss", "survival", "copycat"]
        yield page.table(head, policies, "Mean and standard error over rollouts.")
    yield from about(found)
