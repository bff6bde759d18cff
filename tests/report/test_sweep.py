"""A sweep's report against made-up rows of a grid over gamma and the reaction horizon."""

import dataclasses
import html
import itertools
import math
import re

import numpy as np
import pytest
from PIL import Image

from jaxdeconf.methods import METHODS
from jaxdeconf.pipeline.results import Judged, JudgedExpert, Losses, Row
from jaxdeconf.presets import PRESETS
from jaxdeconf.report.sweep import ranked, write
from jaxdeconf.sweep.grid import Axis
from jaxdeconf.sweep.log import Sweep

BASE = PRESETS["cartpole"]["smoke"]
GAMMA, HORIZON = Axis("mask.threshold", (1e-3, 1e-2, 1e-1)), Axis("mask.reaction_horizon", (1, 3))


def sweep_of(*axes: Axis, methods: tuple[str, ...] = ("BcVanilla", "Masked"), seeds=2) -> Sweep:
    return Sweep(dataclasses.replace(BASE, methods=methods), axes, seeds)


def rows_of(sweep: Sweep) -> list[Row]:
    """Of 4 latents the second is the nuisance's; it is masked from the second value on."""
    names = [axis.name for axis in sweep.axes]
    grid = itertools.product(range(sweep.seeds), *(axis.values for axis in sweep.axes))
    rows = []
    for point, (seed, *values) in enumerate(grid):
        masked = values[0] > sweep.axes[0].values[0] if values else True
        policies = {
            name: Judged(Losses(2.0 + place + 0.1 * point, 0.3, [], 0.3), 0.5, 0.1, 0.2, 0.01)
            for place, name in enumerate(sweep.base.methods)
        }
        found = Row(point, {"seed": seed, **dict(zip(names, values, strict=True))}, [], policies)
        rows.append(
            found._replace(
                threshold=1e-3,
                mask=np.array([False, masked, False, True]),
                active=np.array([True, True, True, False]),
                nuisance_share=np.array([-0.1, 0.97, 0.05, 0.0]),
                precision=1.0 if masked else None,
                recall=float(masked),
                expert=JudgedExpert(1.0, 1.0, 0.0, 0.0),
            )
        )
    return rows


def text_of(directory):
    page = (directory / "report.html").read_text(encoding="utf-8")
    return html.unescape(re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL))


def test_report_of_a_whole_sweep(tmp_path):
    sweep = sweep_of(GAMMA, HORIZON)
    said = write(tmp_path, sweep, rows_of(sweep))
    files = {file.name for file in (tmp_path / "figures").iterdir()}
    assert files == {"rollout_loss.png", "mask.png", "precision_recall.png"}
    for name in files:
        with Image.open(tmp_path / "figures" / name) as image:
            image.load()
            assert min(image.size) > 300
    text = text_of(tmp_path)
    assert "cartpole, preset smoke" in text
    assert "a sweep of 12 points" in text
    assert "not done yet" not in text
    assert "o₂" in text
    # In the terminal: the head, the best five, what is left out, where the report is.
    lines = said.splitlines()
    assert len(lines) == 8
    assert lines[0].split()[:4] == ["point", "seed", "mask.threshold", "mask.reaction_horizon"]
    assert [line.split()[0] for line in lines[1:6]] == ["0", "1", "2", "3", "4"]
    assert lines[6:] == ["... 7 more", f"report: {tmp_path / 'report.html'}"]


def test_rows_that_are_missing_or_diverged_are_said(tmp_path):
    sweep = sweep_of(GAMMA)
    rows = rows_of(sweep)[:4]
    rows[1] = Row(1, rows[1].values, ["disentangle"])
    lost = Judged(Losses(math.nan, math.nan), math.nan, 0.1, 0.2, math.nan)
    rows[2] = rows[2]._replace(diverged=["BcVanilla"], policies={"Masked": lost})
    write(tmp_path, sweep, rows)
    text = text_of(tmp_path)
    assert "2 points are not done yet." in text
    assert "Diverged: 1, 2." in text
    assert "β-VAE diverged" in text


def test_rows_are_ranked_by_the_first_method_that_needs_a_mask(monkeypatch):
    sweep = sweep_of(GAMMA, methods=("Masked", "BcVanilla"), seeds=1)
    rows = rows_of(sweep)
    losses = {"Masked": (3.0, math.nan, 1.0), "BcVanilla": (1.0, 2.0, 3.0)}
    for row, masked, vanilla in zip(rows, *losses.values(), strict=True):
        for name, loss in {"Masked": masked, "BcVanilla": vanilla}.items():
            judged = row.policies[name]
            row.policies[name] = judged._replace(rollout_loss=Losses(loss, 0.1))
    assert [row.point for row in ranked(sweep, rows)] == [2, 0, 1]
    alone = dataclasses.replace(sweep, base=dataclasses.replace(sweep.base, methods=("BcVanilla",)))
    assert [row.point for row in ranked(alone, rows)] == [0, 1, 2]
    row = METHODS["BcVanilla"]._replace(needs=("mask",))  # it comes before Masked in the table
    monkeypatch.setitem(METHODS, "BcVanilla", row)
    assert [row.point for row in ranked(sweep, rows)] == [0, 1, 2]


@pytest.mark.parametrize(
    ("axes", "methods", "files"),
    [
        ((), ("Masked",), {"rollout_loss.png"}),  # over seeds alone
        ((Axis("clone.learning_rate", (1e-4, 1e-3)),), ("Masked",), {"rollout_loss.png"}),
        ((GAMMA,), (), {"mask.png", "precision_recall.png"}),  # masks alone
    ],
)
def test_what_there_is_nothing_of_is_not_drawn(axes, methods, files, tmp_path):
    sweep = sweep_of(*axes, methods=methods)
    write(tmp_path, sweep, rows_of(sweep))
    assert {file.name for file in (tmp_path / "figures").iterdir()} == files


def test_a_sweep_without_rows_has_a_report(tmp_path):
    write(tmp_path, sweep_of(GAMMA), [])
    assert "6 points are not done yet." in text_of(tmp_path)
