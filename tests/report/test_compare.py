"""A comparison's report against made-up rows, in which it is known who is better."""

import dataclasses
import html
import json
import re

import numpy as np
import pytest
from PIL import Image
from scipy.stats import ttest_rel

from jaxdeconf.pipeline.results import Judged, JudgedExpert, Losses, Row, Sight
from jaxdeconf.presets import PRESETS
from jaxdeconf.report import compare, compare_figures
from jaxdeconf.sweep import sights
from jaxdeconf.sweep.grid import Axis
from jaxdeconf.sweep.log import Sweep

SEEDS = 5
# Mean rollout losses by seed: Masked is always lower than BcVanilla, Palr as often as not.
LOSSES = {
    "BcVanilla": [20.0, 30.0, 25.0, 35.0, 15.0],
    "BcManual": [5.0, 6.0, 7.0, 6.0, 6.0],
    "Masked": [10.0, 15.0, 12.0, 20.0, 8.0],
    "Palr": [25.0, 20.0, 35.0, 20.0, 24.0],
    "Dagger": [4.0, 4.0, 5.0, 4.0, 4.0],
    "Longer": [9.0, 9.0, 9.0, 9.0, np.nan],
}


def rows_of(scenes=("previous_action",)):
    rows = []
    for scene in scenes:
        for name, by_seed in LOSSES.items():
            for seed, loss in enumerate(by_seed):
                values = {"seed": seed, "collect.nuisance": scene, "methods": (name,)}
                losses = Losses(loss, 9.0, [], 0.9, loss / 2)
                judged = Judged(losses, 0.5, 0.1, 0.2, 0.01, 0.7)
                expert = JudgedExpert(2.0, 1.0, 0.0, 0.0)
                row = Row(len(rows), values, [], {name: judged}, expert=expert)
                rows.append(row._replace(seconds={name: 90.0}))
    return rows


def sweep_of(scenes=("previous_action",)):
    base = dataclasses.replace(PRESETS["cartpole"]["smoke"], methods=tuple(LOSSES))
    methods = Axis("methods", tuple((name,) for name in LOSSES))
    return Sweep(base, (Axis("collect.nuisance", scenes), methods), SEEDS)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    directory = tmp_path_factory.mktemp("compare")
    scenes = "previous_action", "filtered"
    return directory, compare.write(directory, sweep_of(scenes), rows_of(scenes))


def test_fair_methods_come_first_and_the_best_of_a_kind(written):
    found = compare.standings(rows_of())
    order = ["Masked", "Palr", "BcVanilla", "Dagger", "BcManual", "Longer"]
    assert [one.method for one in found] == order
    head, cells, _ = compare.table(found, sweep_of().base)
    masked = dict(zip(head, cells[0], strict=True))
    error = np.std(LOSSES["Masked"], ddof=1) / np.sqrt(SEEDS)
    assert masked["rollout loss"] == f"13.0 ± {error:.2f}"
    assert masked["/ Expert"] == "6.50"
    assert masked["minutes"] == "1.5"
    assert masked["survival"] == "50%"
    assert masked["labels"] == masked["episodes"] == "–"
    # Smoke: 64 trajectories, of which two rounds relabel a quarter, of 40 steps.
    dagger = dict(zip(head, cells[3], strict=True))
    assert (dagger["labels"], dagger["episodes"]) == ("1,280", "32")


@pytest.mark.parametrize("seeds", [2, 3, 5])
@pytest.mark.parametrize("method", [name for name in LOSSES if name != "BcVanilla"])
def test_a_difference_holds_where_a_paired_t_test_says_so(method, seeds):
    """Reference: scipy.stats."""
    some = [row for row in rows_of() if row.values["seed"] < seeds]
    (said,) = [
        words
        for words in compare.differences(compare.standings(some))
        if words.startswith(f"{method} ")
    ]
    p = ttest_rel(LOSSES[method][:seeds], LOSSES["BcVanilla"][:seeds]).pvalue
    assert said.endswith("it holds.") == (p < 0.05)


def test_a_difference_is_told_with_its_seeds(written):
    said = {words.split()[0]: words for words in compare.differences(compare.standings(rows_of()))}
    assert said.keys() == LOSSES.keys() - {"BcVanilla"}
    assert said["Masked"].endswith("lower on 5 of 5 seeds; it holds.")
    assert said["Palr"].endswith("lower on 2 of 5 seeds; it may be chance.")
    assert said["Longer"].endswith("it may be chance.")  # one seed diverged


def test_a_line_a_method_and_seed(written):
    directory, _ = written
    lines = [json.loads(line) for line in (directory / "compare.jsonl").read_text().splitlines()]
    assert len(lines) == 2 * len(LOSSES) * SEEDS
    first = lines[0]
    assert (first["method"], first["seed"], first["fair"]) == ("BcVanilla", 0, True)
    assert (first["rollout_loss"], first["rollout_loss_se"]) == (20.0, 0.9)
    assert (first["collect.nuisance"], first["minutes"], first["labels"]) == (
        *("previous_action", 1.5),
        0,
    )
    diverged = [line for line in lines if line["rollout_loss"] is None]
    assert [line["method"] for line in diverged] == ["Longer"] * 2


def test_each_scene_has_its_table_and_figure(written):
    directory, said = written
    for number in (0, 1):
        with Image.open(directory / "figures" / f"{number}" / "losses.png") as image:
            image.load()
            assert min(image.size) > 300
    page = (directory / "report.html").read_text(encoding="utf-8")
    text = html.unescape(re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL))
    for scene in ("previous_action", "filtered"):
        assert f"collect.nuisance = {scene}" in text
        assert f"collect.nuisance = {scene}" in said
    assert "Features that depend on the previous action" in text  # what Palr is
    assert "not done" not in text
    assert said.splitlines()[-1] == f"report: {directory / 'report.html'}"


def test_methods_whose_policies_are_the_same_share_a_mark():
    found = compare.standings(rows_of())
    masked = next(one for one in found if one.method == "Masked")
    figure = compare_figures.losses([*found, masked._replace(method="Probe")], {})
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    alone = ["Palr", "Longer", "Dagger"]
    assert labels == ["BcVanilla", "BcManual", "Masked, Probe", *alone, "Expert"]


def test_what_policies_see_is_kept_for_the_first_seed_and_shown(tmp_path):
    """Of those alone whose pictures there are, and that can be read."""
    sweep, rows = sweep_of(), rows_of()
    kept = [point for point in sweep.points if sights.asked(sweep, point)]
    assert [point.config.seed for point in kept] == [0] * len(LOSSES)
    assert not sights.asked(Sweep(sweep.base, (), SEEDS), kept[0])
    of = {row.values["methods"][0]: row.point for row in rows if row.values["seed"] == 0}
    sizes = []
    for name in ("BcVanilla", "Masked", "Palr"):
        sight = Sight(np.zeros((3, 16, 16, 3), np.uint8), np.zeros((3, 16, 16), np.float32))
        sights.keep(tmp_path, of[name], sight)
        np.testing.assert_array_equal(sights.kept(tmp_path, of[name]).seen, sight.seen)
        compare.write(tmp_path, sweep, rows)
        with Image.open(tmp_path / "figures" / "0" / "sights.png") as image:
            sizes.append(image.size[1])
    assert sizes[0] < sizes[1] < sizes[2]
    (tmp_path / "sights" / f"{of['Palr']}.npz").write_bytes(b"damaged")
    compare.write(tmp_path, sweep, rows)
    with Image.open(tmp_path / "figures" / "0" / "sights.png") as image:
        assert image.size[1] == sizes[1]
