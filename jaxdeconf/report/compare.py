"""A comparison's table, lines and page: methods by what their policies came to, over seeds.

Shapes: K seeds.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from jaxdeconf import systems
from jaxdeconf.method import Price
from jaxdeconf.methods import METHODS, usual
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.plain import to_plain
from jaxdeconf.pipeline.results import Judged, Losses, OutcomeForm, Row
from jaxdeconf.pipeline.store import writing
from jaxdeconf.report import canvas, page, words
from jaxdeconf.report.standing import Standing
from jaxdeconf.report.words import EXPERT
from jaxdeconf.sweep import sights
from jaxdeconf.sweep.grid import METHODS_AXIS
from jaxdeconf.sweep.log import Sweep

FILE = "compare.jsonl"
_KINDS = ("fair", "oracle", "control")


def write(directory: Path, sweep: Sweep, rows: Sequence[Row]) -> str:
    """Writes compare.jsonl, `figures/` and `report.html`; returns lines for the terminal."""
    canvas.import_matplotlib()
    from jaxdeconf.report.compare_figures import FIGURES

    count, body = len(sweep.points), []
    with writing(directory):
        lines = [json.dumps(to_plain(line), allow_nan=False) for line in records(sweep, rows)]
        (directory / FILE).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
        if len(rows) < count:
            body.append(page.paragraph([f"{count - len(rows)} of {count} are not done."], "strong"))
        said = []
        for number, (scene, own) in enumerate(scenes(sweep, rows).items()):
            found = standings(own)
            seen = {
                name: sight
                for row in own
                if (sight := sights.kept(directory, row.point))
                for name in row.policies
            }
            drawn = canvas.write(directory / "figures" / f"{number}", FIGURES, found, seen)
            head, cells, note = table(found, sweep.base)
            body += [page.heading(scene or "Methods"), page.table(head, cells, note)]
            body += [page.paragraph(differences(found)), *page.images(drawn)]
            said += [*([scene] if scene else []), *words.aligned(head, cells), *differences(found)]
        body += [page.heading("What they are"), _notes(rows)]
        # The table names the methods.
        base = replace(sweep.base, methods=usual())
        subject = words.subject(base.system, base.preset, base)
        title = f"{subject}: methods side by side, {sweep.seeds} seed{'s' * (sweep.seeds > 1)}"
        page.write(directory / "report.html", title, body)
    return "\n".join([*said, f"report: {directory / 'report.html'}"])


def asked(method: str, config: Config) -> Price:
    """What a method asks for beside the demonstrations."""
    price = METHODS[method].price if method in METHODS else None
    known = config.system in systems.names()
    steps = config.clone.trajectory_steps or (systems.get(config.system).steps if known else 0)
    return price(config.collect.expert_trajectories, steps) if price else Price()


def records(sweep: Sweep, rows: Sequence[Row]) -> Iterator[dict[str, Any]]:
    """A line a method and seed, flat, for other programs."""
    for row in rows:
        for name, judged in row.policies.items():
            loss = judged.rollout_loss
            yield {
                "method": name,
                "seed": row.values["seed"],
                "fair": words.kind(name) == "fair",
                "kind": words.kind(name),
                **{k: v for k, v in row.values.items() if k not in ("seed", METHODS_AXIS)},
                "rollout_loss": loss.mean,
                "rollout_loss_se": loss.error,
                "rollout_loss_median": loss.median,
                "expert_loss": row.expert.rollout_loss if row.expert else float("nan"),
                "outcome": judged.outcome,
                "train_loss": judged.train_loss,
                "copycat": judged.copycat,
                "copycat_slope": judged.copycat_slope,
                "past_leakage": judged.past_leakage,
                "predictability": judged.predictability,
                "leakage": judged.leakage,
                "minutes": row.seconds[name] / 60.0,
                **asked(name, sweep.base)._asdict(),
            }


def scenes(sweep: Sweep, rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows of each combination of the other axes' values, by its name."""
    axes = [axis for axis in sweep.axes if axis.name != METHODS_AXIS]
    found: dict[str, list[Row]] = {}
    for row in rows:
        name = ", ".join(f"{axis.name} = {words.shown(row.values[axis.name])}" for axis in axes)
        found.setdefault(name, []).append(row)
    return found


def standings(rows: Sequence[Row]) -> list[Standing]:
    """Fair methods first, then oracles, then controls; of a kind, the lowest loss first."""
    found: dict[str, list[tuple[int, Judged, float, float]]] = {}
    for row in sorted(rows, key=lambda row: row.values["seed"]):
        expert = row.expert.rollout_loss if row.expert else np.nan
        for name, judged in row.policies.items():
            one = row.values["seed"], judged, expert, row.seconds[name]
            found.setdefault(name, []).append(one)
    every = []
    for name, held in found.items():
        seeds, judged, experts, seconds = zip(*held, strict=True)
        every.append(Standing(name, [*seeds], [*judged], np.array(experts), np.array(seconds)))

    def place(one: Standing) -> tuple[int, float]:
        loss = one.losses.mean()
        return _KINDS.index(words.kind(one.method)), loss if np.isfinite(loss) else np.inf

    return sorted(every, key=place)


def table(found: Sequence[Standing], config: Config) -> tuple[list[str], list[list[str]], str]:
    """Head, cells and note."""
    came = _outcome(config.system)
    head = ["", "kind", "seeds", "rollout loss", f"/ {EXPERT}", "median", came.name, "train loss"]
    head += ["copycat", "slope", "predictability", "HSCIC", "leakage R²"]
    head += ["minutes", "labels", "episodes"]
    cells = []
    for one in found:
        medians = np.array([judged.rollout_loss.median for judged in one.judged])
        cells.append(
            [
                one.method,
                words.kind(one.method),
                str(len(one.seeds)),
                words.mean(one.losses),
                words.number(float((one.losses / one.experts).mean())),
                words.loss(float(medians.mean())),
                words.formed(one.mean("outcome"), came.form),
                words.loss(one.mean("train_loss")),
                words.fixed(one.mean("copycat"), 3),
                words.fixed(one.mean("copycat_slope"), 2),
                words.number(one.mean("predictability")),
                words.fixed(one.mean("past_leakage"), 4),
                words.fixed(one.mean("leakage"), 3),
                words.fixed(float(one.seconds.mean()) / 60.0, 1),
                *(f"{count:,}" if count else "–" for count in asked(one.method, config)),
            ]
        )
    note = (
        "Mean stage cost a step, ± standard error over seeds; median over rollouts. "
        f"{came.note} Copycat: mean "
        "change of the action over its limit when only the nuisance is redrawn; slope: mean "
        "derivative of the action with respect to the one that the nuisance shows. Predictability: "
        "error of telling an action from the one before, over the expert's; below 1, actions "
        "follow one another more than the expert's do. HSCIC: how much, where the expert drives, "
        "the policy's action depends on the expert's one before, given the expert's action. "
        "Labels: the expert's, asked for beside the demonstrations; episodes: driven for it."
    )
    return head, cells, note


def _outcome(system: str) -> OutcomeForm:
    """How the outcome of a system is shown; of one that is not known here, plainly."""
    if system not in systems.names():
        return OutcomeForm("outcome", ".3g", "")
    return OutcomeForm(*systems.get(system).outcome[:3])


def differences(found: Sequence[Standing]) -> list[str]:
    """Which methods differ from the plain one, the first in the table: paired over seeds, by
    Student's t at 5 %, each by itself."""
    names = words.ordered([one.method for one in found])
    plain = next(one for one in found if one.method == names[0])
    sentences = []
    for one in found:
        shared = [seed for seed in plain.seeds if seed in one.seeds]
        if one is plain or len(shared) < 2:
            continue
        own, other = (
            np.array([of.losses[of.seeds.index(seed)] for seed in shared]) for of in (one, plain)
        )
        difference = own - other
        better = int((difference < 0).sum())
        told = Losses.of(difference)
        holds = abs(told.mean) > stdtrit(len(shared) - 1, 0.975) * told.error
        sentences.append(
            f"{one.method} against {plain.method}: {words.spread(told)}, lower on {better} of "
            f"{len(shared)} seeds; {'it holds' if holds else 'it may be chance'}."
        )
    return sentences


def _notes(rows: Sequence[Row]) -> str:
    names = words.ordered({name for row in rows for name in row.policies})
    known = [[name, METHODS[name].kind, METHODS[name].note] for name in names if name in METHODS]
    return page.table(["", "kind", "what it is cloned on"], known, kind="words")
