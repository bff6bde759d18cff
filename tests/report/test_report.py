"""The report against what it was given: files, sizes, frame times, colours, and the words it says.

The references are the made-up runs and pictures of conftest.py.
"""

import base64
import html
import io
import json
import math
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from jaxdeconf.methods import METHODS
from jaxdeconf.pipeline import results as stored
from jaxdeconf.pipeline.plain import to_plain
from jaxdeconf.presets import PRESETS
from jaxdeconf.report import animation, canvas, figures, words
from jaxdeconf.report.run import averaged, redraw, write_report, write_summary

PICTURES = ("rollout_loss", "dependence", "frames", "region", "traversals")
FIGURES = {"rollouts.gif", *(f"{name}.png" for name in PICTURES)}
NOTHING = {
    "rollouts": {},
    "alive": {},
    "strips": {},
    "traversals": np.zeros((0, 0, 4, 4, 3)),
    "region": np.zeros((4, 4), bool),
}


@pytest.fixture(scope="module")
def written(make, pictures, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    write_report(directory, make(), pictures)
    return directory


def text_of(directory: Path) -> str:
    """What a reader sees: the page without pictures and tags."""
    page = (directory / "report.html").read_text(encoding="utf-8")
    text = re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL)
    return html.unescape(text).replace("\N{NO-BREAK SPACE}", " ")


def size_of(file: Path) -> tuple[int, int]:
    with Image.open(file) as image:
        image.load()
        return image.size


def test_figures_are_images_of_the_expected_size(written: Path):
    assert {file.name for file in (written / "figures").iterdir()} == FIGURES
    sizes = {name: size_of(written / "figures" / name) for name in FIGURES}
    # Two pixels a pixel, gutters, and the labels.
    assert sizes["frames.png"] == (190 + 10 * 134 - 6 + 8, 8 + 4 * 134 - 6 + 8)
    assert sizes["region.png"] == (190 + 10 * 134 - 6 + 8, 8 + 134 - 6 + 8)
    assert sizes["traversals.png"] == (190 + 5 * 134 - 6 + 8, 64 + 6 * 134 - 6 + 8)
    assert sizes["rollouts.gif"] == (4 * (3 * 64 + 8) + 8, 34 + 3 * 64 + 26)
    assert sizes["rollout_loss.png"] == (1020, 585)
    assert min(sizes["dependence.png"]) > 400


@pytest.mark.parametrize(
    ("height", "width", "sheet", "film"),
    [(32, 48, 3, 4), (48, 32, 4, 6), (96, 96, 2, 2), (240, 320, 1, 1)],
)
def test_pictures_of_any_size(height, width, sheet, film, make, draw, tmp_path: Path):
    small = draw(height, width, steps=30)
    canvas.write(tmp_path, [figures.frames, figures.rollouts], make(), small)
    down, along = sheet * height + 6, sheet * width + 6
    assert size_of(tmp_path / "frames.png") == (190 + 10 * along - 6 + 8, 8 + 4 * down - 6 + 8)
    across = 4 * (film * width + 8) + 8
    assert size_of(tmp_path / "rollouts.gif") == (across, 34 + film * height + 26)
    with Image.open(tmp_path / "frames.png") as image:
        shown = np.asarray(image.convert("RGB"))
    frame = small.strips["Masked"][3].repeat(sheet, axis=0).repeat(sheet, axis=1)
    y, x = 8 + 2 * down, 190 + 3 * along
    panel = shown[y : y + sheet * height, x : x + sheet * width]
    np.testing.assert_array_equal(panel[1:-1, 1:-1], frame[1:-1, 1:-1])  # within the outline


def test_contact_sheet_keeps_every_pixel(written: Path, pictures):
    with Image.open(written / "figures" / "frames.png") as image:
        sheet = np.asarray(image.convert("RGB"))
    frame = pictures.strips["Frame"][3]
    inside = frame.repeat(2, axis=0).repeat(2, axis=1)[4:-4, 4:-4]  # within the thin outline
    x, y = 190 + 3 * 134 + 4, 8 + 4
    np.testing.assert_array_equal(sheet[y : y + 120, x : x + 120], inside)


def test_all_but_the_region_is_faded(written: Path, pictures):
    with Image.open(written / "figures" / "region.png") as image:
        sheet = np.asarray(image.convert("RGB"))[8:, 190 + 3 * 134 :][2:126:2, 2:126:2]
    frame = pictures.strips["Frame"][3][1:63, 1:63]  # within the thin outline
    inside = pictures.region[1:63, 1:63]
    np.testing.assert_array_equal(sheet[inside], frame[inside])
    np.testing.assert_allclose(sheet[~inside], 255 - (255.0 - frame[~inside]) / 5, atol=1)


def test_gif_shows_every_step_in_real_time(written: Path):
    file = written / "figures" / "rollouts.gif"
    with Image.open(file) as image:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
        assert image.info["loop"] == 0
    assert durations == [50] * 100
    assert file.stat().st_size < 2e6


@pytest.mark.parametrize(("dt", "count", "seconds"), [(0.008, 34, 0.816), (0.0333, 100, 3.33)])
def test_gif_of_short_steps_skips_frames_and_keeps_time(dt, count, seconds, pictures):
    gif = animation.animate(pictures._replace(dt=dt), {"Expert": "#555555"})
    with Image.open(io.BytesIO(gif)) as image:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    assert len(durations) == count
    assert abs(sum(durations) - 1000 * seconds) <= 5
    assert min(durations) >= 20


def test_gif_keeps_the_colours_and_greys_the_fallen(written: Path, pictures):
    fell = int(np.argmin(pictures.alive["BcVanilla"]))
    with Image.open(written / "figures" / "rollouts.gif") as image:
        for step in (0, fell - 1, fell + 5):
            image.seek(step)
            page = np.asarray(image.convert("RGB")).astype(int)
            for panel, name in enumerate(("Expert", "BcVanilla", "BcManual", "Masked")):
                # The middle of the nuisance, in the picture's corner.
                shown = page[34 + 20, 8 + panel * 200 + 20]
                if pictures.alive[name][step]:
                    assert np.abs(shown - pictures.rollouts[name][step, 7, 7]).max() <= 4
                else:
                    assert np.ptp(shown) <= 6


def test_the_bars_of_the_gif_are_the_methods_colours(written: Path):
    with Image.open(written / "figures" / "rollouts.gif") as image:
        page = np.asarray(image.convert("RGB")).astype(int)
    for panel, name in enumerate(("BcVanilla", "BcManual", "Masked"), 1):
        color = canvas.looks([name])[name].color
        wanted = [int(color[at : at + 2], 16) for at in (1, 3, 5)]
        assert np.abs(page[28, 8 + panel * 200 + 50] - wanted).max() <= 8


def test_page_is_self_contained(written: Path):
    page = (written / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)\s*=\s*"([^"]*)"', page)
    assert len(sources) == len(FIGURES)
    for source in sources:
        data = re.fullmatch(r"data:image/(?:png|gif);base64,(.*)", source).group(1)
        assert base64.b64decode(data, validate=True)[:3] in (b"\x89PN", b"GIF")
    assert "<script" not in page
    assert "url(" not in page


def test_page_says_what_was_found(written: Path):
    text = text_of(written)
    for phrase in (
        "Of 6 latents, 4 are active; of these, Algorithm 1 masked o₃ (γ = 0.001).",
        "The masked latents reach 4 % of the image's pixels.",
        "The previous action explains 97 % of o₃ (|Spearman| 0.99): it is the nuisance's.",
        "Masked's rollout loss is 1.15 times BcManual's.",
        "BcVanilla's rollout loss is 7.00 times BcManual's.",
        "BcManual's rollout loss is 1.37 times the expert's.",
        "outside its soft limits in 3.1 % of its steps",
        "clone.learning_rate",
        METHODS["Masked"].note,
        "Hoeffding's D",
        "D, theta (rad)",
    ):
        assert phrase in text
    assert "Reconstructed's" not in text  # a control
    assert "336.1" in text  # the seconds' sum


def test_no_goals_and_no_verdict(make, written: Path, tmp_path: Path):
    write_summary(tmp_path, [make(0), make(1)])
    for said in (text_of(written), text_of(tmp_path), words.summary(make(), Path("run"))):
        assert not re.search(r"goal|reached|missed|verdict", said, re.IGNORECASE)


def test_without_an_oracle_all_are_compared_with_the_expert(make):
    run = make(losses={"BcVanilla": 9.5, "Masked": 1.9, "Reconstructed": 3.8})
    assert words.of_policies(run) == [
        "BcVanilla's rollout loss is 10.0 times the expert's.",
        "Masked's rollout loss is 2.00 times the expert's.",
    ]


def test_what_is_not_finite_is_not_compared(make):
    run = make(losses={"BcVanilla": math.nan, "BcManual": 1.9, "Masked": math.inf})
    assert words.of_policies(run) == [
        "BcVanilla's rollout loss is not comparable to BcManual's.",
        "Masked's rollout loss is not comparable to BcManual's.",
        "BcManual's rollout loss is 2.00 times the expert's.",
    ]


@pytest.mark.parametrize(
    ("changes", "phrase"),
    [
        (
            {"mask": [True, False, True, False, False, False]},
            "explains 1 % of o₁ (|Spearman| 0.03): it is not the nuisance's alone.",
        ),
        ({"mask": [False, True, True, False, False, False]}, "explains 0 % of o₂ (|Spearman|"),
        ({"region": 1.0}, "The masked latents reach all pixels: their reach is not local."),
        ({"mask": [False] * 6}, "The nuisance's o₃ was kept."),
        ({"nuisance_share": [0.5] * 6}, "The previous action explains 90 % of no active latent"),
        ({"nuisance_share": [0.5] * 6}, "also shows in o₁, o₂, o₃ and o₄: the previous action"),
        ({"active": [False] * 6}, "No latent is active"),
    ],
)
def test_what_the_mask_got_wrong_is_said(changes, phrase: str, make, tmp_path: Path):
    run = make(**{name: np.array(value) for name, value in changes.items()})
    assert phrase in " ".join(words.of_mask(run))
    for sentence in words.of_mask(run):  # the terminal says the same
        assert sentence in words.summary(run, tmp_path)


def test_a_collapsed_vae_is_said_once_and_drawn(make, brief, tmp_path: Path):
    run = make(active=np.zeros(6, bool))
    write_report(tmp_path, run, brief)
    assert words.of_mask(run) == [
        "No latent is active: the β-VAE has learnt nothing, and nothing is masked."
    ]
    assert "masked o" not in text_of(tmp_path)


def test_the_statistic_is_named(make, brief, tmp_path: Path):
    write_report(tmp_path, make(statistic="refined"), brief)
    text = text_of(tmp_path)
    assert "R, refined" in text
    assert "R, theta (rad)" in text
    assert "Hoeffding" not in text


def test_text_is_escaped(make, brief, tmp_path: Path):
    attack = '<script src="http://a.b">$x_1$ & "</script>'
    run = make(losses={attack: 3.0, "BcManual": 1.0}, system=attack)
    run.config["note"] = {attack: attack}
    run.state_names[0] = run.action_names[0] = run.versions["device"] = attack
    shown = brief._replace(
        rollouts=brief.rollouts | {attack: brief.rollouts["Expert"]},
        alive=brief.alive | {attack: brief.alive["Expert"]},
        strips={attack: brief.strips["Frame"]},
    )
    write_report(tmp_path, run, shown)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert page.count(html.escape(attack)) >= 7


def test_what_diverged_or_is_missing_is_said(make, brief, tmp_path: Path):
    nan, inf = math.nan, math.inf
    run = make(losses={"BcVanilla": inf, "BcManual": 1.3, "Masked": nan}, threshold=0.0)
    curve = [[1, 3.0, 0.5], [5, None, None], [10, inf, inf], [20, 2.0, 0.1]]
    for name, per_epoch in {"BcVanilla": [], "BcManual": [], "Masked": curve}.items():
        losses = run.policies[name].rollout_loss._replace(per_epoch=per_epoch)
        run.policies[name] = run.policies[name]._replace(rollout_loss=losses)
    run.policies["Masked"] = run.policies["Masked"]._replace(train_loss=nan, outcome=nan)
    run.state_observation[1, 2] = run.p_values.state_observation[1, 2] = nan
    run.nuisance_share[5] = run.kl[5] = nan
    write_report(tmp_path, run, brief)
    text = text_of(tmp_path)
    assert text.count("diverged") >= 3
    assert "undefined" in text
    assert "BcVanilla's rollout loss is not comparable to BcManual's." in text


@pytest.mark.parametrize("losses", [{}, {"BcVanilla": 2.0}])
def test_a_run_with_little_to_show(losses, make, brief, tmp_path: Path):
    run = make(losses={name: math.nan for name in losses})
    run = run._replace(expert=run.expert._replace(rollout_loss=math.nan))
    for name in losses:
        losses = run.policies[name].rollout_loss._replace(per_epoch=[])
        run.policies[name] = run.policies[name]._replace(rollout_loss=losses)
    write_report(tmp_path, run, brief._replace(**NOTHING))
    assert [file.name for file in (tmp_path / "figures").iterdir()] == ["dependence.png"]
    write_report(tmp_path / "again", make(losses={}), brief)  # the expert's line alone
    assert {file.name for file in (tmp_path / "again/figures").iterdir()} == FIGURES


def test_a_new_method_and_one_that_is_gone_are_shown(make, draw, monkeypatch, tmp_path: Path):
    row = METHODS["Masked"]._replace(note="A rival, made up.", needs=())
    monkeypatch.setitem(METHODS, "Rival", row)
    losses = {"Gone": 2.6, "Rival": 3.9, "BcManual": 1.3, "Reconstructed": 8.0}
    write_report(tmp_path, make(losses=losses), draw(names=tuple(losses), steps=45))
    text = text_of(tmp_path)
    assert "Rival's rollout loss is 3.00 times BcManual's." in text
    assert "Gone's rollout loss is 2.00 times BcManual's." in text
    assert "A rival, made up." in text
    assert words.ordered(losses) == ["BcManual", "Reconstructed", "Rival", "Gone"]
    # The expert, and those that are no controls, in this order.
    with Image.open(tmp_path / "figures" / "rollouts.gif") as image:
        image.seek(44)
        page = np.asarray(image.convert("RGB")).astype(int)
    assert page.shape[1] == 4 * 200 + 8
    assert [np.ptp(page[34 + 20, 8 + panel * 200 + 20]) <= 6 for panel in range(4)] == [
        *(False, False, False),
        True,  # Gone is the first in the pictures, the one that has fallen
    ]


def test_controls_are_in_the_gif_only_if_methods_are_few(make, draw, tmp_path: Path):
    names = ("Reconstructed", "Masked")
    write_report(tmp_path, make(losses=dict.fromkeys(names, 1.0)), draw(names=names, steps=40))
    assert size_of(tmp_path / "figures" / "rollouts.gif")[0] == 3 * 200 + 8
    with Image.open(tmp_path / "figures" / "rollouts.gif") as image:
        image.seek(39)
        page = np.asarray(image.convert("RGB")).astype(int)
    assert np.ptp(page[34 + 20, 8 + 400 + 20]) <= 6  # Reconstructed, which has fallen, is last


def test_colours_go_by_the_place_in_the_table_and_differ(monkeypatch):
    before = {name: look.color for name, look in canvas.looks(METHODS).items()}
    assert list(before.values())[:4] == ["#D55E00", "#0072B2", "#009E73", "#B55D92"]
    for place in range(40):
        monkeypatch.setitem(METHODS, f"Rival{place}", METHODS["Masked"])
    looks = canvas.looks([*METHODS, "Gone", "Gone too"])
    assert {name: looks[name].color for name in before} == before
    assert len({(look.color, look.marker) for look in looks.values()}) == len(looks)
    controls = [
        "Reconstructed",
        "PalrPlain",
        "OreoPlain",
        "OneFrame",
        "Cutout",
        "Dropout",
        "Longer",
    ]
    assert [name for name, look in looks.items() if look.thin] == controls
    assert canvas.looks(["Masked"])["Masked"] == looks["Masked"]


@dataclass(frozen=True)
class Part:
    epochs: float = 1.0
    alpha: float | None = 0.05
    widths: tuple[int, ...] = (64, 128)
    beta: float = 2.0
    decay: float = 0.3


@dataclass(frozen=True)
class MadeUp:
    system: str = "pendulum"
    preset: str = "laptop"
    seed: int = 0
    clone: Part = field(default_factory=Part)


@pytest.mark.parametrize(
    ("part", "said"),
    [
        (Part(), ""),
        (Part(epochs=1), ""),
        (Part(epochs=50, alpha=None), " with clone.alpha None, clone.epochs 50"),
        (Part(widths=(8, 16)), " with clone.widths 8 16"),
        (
            Part(0.5, None, (8,), 1e-05, 0.1),
            " with clone.alpha None, clone.beta 1e-05, clone.decay 0.1, clone.epochs 0.5"
            " and 1 more",
        ),
    ],
)
def test_title_names_the_flags_that_differ_from_the_preset(
    part, said, make, monkeypatch, tmp_path: Path
):
    monkeypatch.setitem(PRESETS, "pendulum", {"laptop": MadeUp()})
    config = json.loads(json.dumps(to_plain(MadeUp(seed=7, clone=part))))
    run = make(seed=7, system="pendulum", config=config)
    assert words.title(run) == f"pendulum, preset laptop{said}, seed 7"
    write_summary(tmp_path, [run, run])
    assert f"<h1>pendulum, preset laptop{said}, 2 seeds</h1>" in (
        tmp_path / "report.html"
    ).read_text(encoding="utf-8")


def test_title_of_an_unknown_preset_is_the_system(make):
    assert words.title(make(system="pendulum")) == "pendulum, seed 0"
    assert words.title(make(preset="mine")) == "cartpole, seed 0"


def test_presets_differ_in_nothing_from_themselves():
    for system, presets in PRESETS.items():
        for preset, config in presets.items():
            assert words.subject(system, preset, config) == f"{system}, preset {preset}"


def test_summary_averages_the_seeds(make, tmp_path: Path):
    runs = [
        make(seed, losses={"BcManual": mean, "BcVanilla": 9.1, "Masked": 1.5, "Reconstructed": 8})
        for seed, mean in enumerate((1.0, 2.0, 6.0))
    ]
    write_summary(tmp_path, runs)
    text = text_of(tmp_path)
    losses, ratios = re.findall(r"mean  .*", text)
    for line, values in (
        (losses, np.array([1.0, 2.0, 6.0])),
        (ratios, 9.1 / np.array([1.0, 2.0, 6.0])),
        (ratios, 1.5 / np.array([1.0, 2.0, 6.0])),
    ):
        error = values.std(ddof=1) / np.sqrt(3)
        assert f"{words.number(values.mean())} ± {words.number(error)}" in line
    assert "0.950" in losses  # the expert's, then the methods' in their order
    assert losses.index("9.10") < losses.index("3.00") < losses.index("1.50")
    assert size_of(tmp_path / "figures" / "rollout_loss.png") == (1020, 585)


def test_curve_over_seeds_is_the_spread_of_their_means(make):
    runs = [make(seed) for seed in range(2)]
    for run, mean in zip(runs, (1.0, 3.0), strict=True):
        curve = [[10, mean, 9.0], [5, mean, 9.0], [mean, 0.0, 0.0], [20, math.inf, math.nan]]
        losses = run.policies["Masked"].rollout_loss._replace(mean=mean, per_epoch=curve)
        run.policies["Masked"] = run.policies["Masked"]._replace(rollout_loss=losses)
    losses = averaged(runs).policies["Masked"].rollout_loss
    assert (losses.mean, losses.std) == (2.0, 1.0)
    # The epochs that both have, in order.
    np.testing.assert_equal(losses.per_epoch, [[5, 2, 1], [10, 2, 1], [20, math.inf, math.nan]])


def test_redraw_writes_what_was_written(make, brief, tmp_path: Path):
    runs = [make(seed) for seed in (2, 10)]
    write_summary(tmp_path, runs)
    for run in runs:
        place = tmp_path / f"seed-{run.seed}"
        write_report(place, run, brief)
        stored.save(place, run, brief)
    files = {
        file: file.read_bytes()
        for file in tmp_path.rglob("*")
        if file.suffix in (".html", ".png", ".gif")
    }
    assert len(files) == 2 * (1 + len(FIGURES)) + 2
    for file in files:
        file.unlink()
    said = redraw(tmp_path)
    assert said.index("seed 2") < said.index("seed 10") < said.index("summary: ")
    for file, content in files.items():
        assert file.read_bytes() == content
    with pytest.raises(OSError, match=r"results\.json"):
        redraw(tmp_path / "seed-3")


def test_what_is_saved_is_loaded(make, brief, tmp_path: Path):
    run = make(losses={"Masked": math.nan, "Gone": 2.0})
    run.state_observation[0, 0] = run.kl[1] = math.nan
    run.policies["Gone"].rollout_loss.per_epoch[1][1] = math.inf
    stored.save(tmp_path, run, brief)
    loaded, shown = stored.load(tmp_path)
    # On disk a number that is not finite is null, and comes back as NaN.
    run.policies["Gone"].rollout_loss.per_epoch[1][1] = math.nan
    run.policies["Masked"] = run.policies["Masked"]._replace(
        rollout_loss=loaded.policies["Masked"].rollout_loss._replace(mean=math.nan, std=math.nan)
    )
    np.testing.assert_equal(loaded._asdict(), run._asdict())
    np.testing.assert_equal(shown._asdict(), brief._asdict())
    assert type(loaded.policies["Gone"]) is stored.Judged
    assert loaded.mask.dtype == bool
