"""The report against what it was given: files, sizes, frame times, colours, and the words it says.

Pictures are real frames of CartPole under an LQR and under random actions; the numbers are made up.
"""

import base64
import html
import math
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image, ImageSequence

from jaxdeconf import systems
from jaxdeconf.pipeline import animation, findings
from jaxdeconf.pipeline.report import Pictures, over_seeds, write_report, write_summary
from jaxdeconf.systems.cartpole import riccati
from jaxdeconf.systems.rollout import frames, rollout, sample_action
from jaxdeconf.systems.system import SURVIVAL

STATES, HORIZON, LATENTS, VALUES = 4, 3, 6, 5
POLICIES = {"BcVanilla": 9.1, "BcManual": 1.3, "Masked": 1.5, "Reconstructed": 8.0}


def policy_of(loss: float) -> dict:
    epochs = (1, 5, 10, 20)
    per_epoch = [[e, loss * (1 + 3 * math.exp(-e / 4)), loss / (1 + 0.4 * e)] for e in epochs]
    return {
        "train_loss": 0.01 * loss,
        "outcome": min(1.0, 2.0 / loss),
        "copycat": 0.1 * loss,
        "leakage": 0.1 * loss,
        "rollout_loss": {"mean": loss, "std": per_epoch[-1][2], "per_epoch": per_epoch},
    }


def run_of(seed: int = 0) -> dict:
    """What results.json holds, for a run in which o₃ is the nuisance's latent and is masked."""
    rng = np.random.default_rng(seed)
    state_observation = 10.0 ** rng.uniform(-3.5, -0.5, (STATES, LATENTS))
    state_observation[:, 2] = [2e-4, -1e-4, 5e-5, -3e-4]
    state_observation[:, 4:] = -2e-4
    state_action = 10.0 ** rng.uniform(-3.5, -0.8, (STATES, HORIZON, 1))
    return {
        "system": "cartpole",
        "preset": "laptop",
        "seed": seed,
        "mask": [False, False, True, False, True, True],
        "active": [True, True, True, True, False, False],
        "kl": [3.1, 2.7, 1.9, 1.2, 0.01, 0.002],
        "nuisance_correlation": [0.03, 0.05, 0.986, 0.11, 0.2, 0.02],
        "nuisance_share": [0.01, -0.02, 0.97, 0.08, 0.05, 0.0],
        "outcome": {name: getattr(SURVIVAL, name) for name in ("name", "form", "note")},
        "state_names": list(systems.get("cartpole").state_names),
        "action_names": list(systems.get("cartpole").action_names),
        "threshold": 1e-3,
        "reaction_horizon": HORIZON,
        "state_observation": state_observation.tolist(),
        "state_action": state_action.tolist(),
        "p_values": {
            "state_observation": rng.uniform(0, 1, (STATES, LATENTS)).tolist(),
            "state_action": np.full((STATES, HORIZON, 1), 1e-5).tolist(),
        },
        "reconstruction": {"nuisance": 0.52, "elsewhere": 3.1},
        "expert": {
            "rollout_loss": 0.95,
            "outcome": 1.0,
            "violation_rate": 0.031,
            "unconverged": 0.0004,
        },
        "policies": {name: policy_of(loss) for name, loss in POLICIES.items()},
        "seconds": {"collect": 21.3, "disentangle": 310.0, "mask": 0.8, "report": 4.0},
        "versions": {"python": "3.11.2", "jax": "0.10.2", "jaxdeconf": "0.1.0", "device": "cpu"},
        "peak_memory_mb": 2100.0,
        "config": {"seed": seed, "bc": {"learning_rate": 1e-3, "widths": [64, 128]}},
    }


@pytest.fixture(scope="module")
def pictures() -> Pictures:
    system = systems.get("cartpole")
    gain = np.asarray(riccati((0.01, 0.01, 10.0, 0.1), 0.01)[1], np.float32)
    start = jax.numpy.array([1.5, -1.0, 0.4, 0.2])

    def balance(_, state, previous_action, key):
        return None, -gain @ state

    def flail(_, state, previous_action, key):
        return None, sample_action(system, key)

    def film(policy):
        trajectory = rollout(system, policy, None, start, jax.random.key(1))
        return frames(system, trajectory), trajectory.valid

    balanced, steady = map(np.asarray, jax.jit(lambda: film(balance))())
    flailed, fallen = map(np.asarray, jax.jit(lambda: film(flail))())
    assert steady.all()
    assert not fallen.all()
    names = ["Expert", "BcVanilla", "BcManual", "Masked", "Reconstructed"]
    clips = {name: flailed if name == "BcVanilla" else balanced for name in names}
    alive = {name: fallen if name == "BcVanilla" else steady for name in names}
    strips = {name: balanced[:60:6] for name in ("Frame", "BcManual", "Masked", "Reconstructed")}
    grid = flailed[: LATENTS * VALUES].reshape(LATENTS, VALUES, 64, 64, 3)
    return Pictures(strips, grid, np.linspace(-2, 2, VALUES), clips, alive, 0.05)


@pytest.fixture(scope="module")
def written(pictures: Pictures, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    write_report(directory, run_of(), pictures)
    return directory


def text_of(directory: Path) -> str:
    """What a reader sees: the page without pictures and tags."""
    page = (directory / "report.html").read_text(encoding="utf-8")
    return html.unescape(re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL))


def test_figures_are_images_of_the_expected_size(written: Path):
    sizes = {}
    for name in ("dependence", "rollout_loss", "frames", "traversals"):
        with Image.open(written / "figures" / f"{name}.png") as image:
            image.load()
            sizes[name] = image.size
    sheet = {"frames": (4, 10), "traversals": (LATENTS, VALUES)}
    for name, (rows, columns) in sheet.items():  # two pixels a pixel, gutters, and the labels
        width, height = sizes[name]
        assert 0 < width - (columns * 134 - 6) < 220
        assert 0 < height - (rows * 134 - 6) < 80
    assert sizes["rollout_loss"] == (1020, 585)
    assert min(sizes["dependence"]) > 400


def test_contact_sheet_keeps_every_pixel(written: Path, pictures: Pictures):
    with Image.open(written / "figures" / "frames.png") as image:
        sheet = np.asarray(image.convert("RGB"))
    frame = pictures.strips["Frame"][3]
    inside = frame.repeat(2, axis=0).repeat(2, axis=1)[4:-4, 4:-4]  # within the thin outline
    x, y = 190 + 3 * 134 + 4, 8 + 4
    np.testing.assert_array_equal(sheet[y : y + 120, x : x + 120], inside)


def test_gif_shows_every_step_in_real_time(written: Path, pictures: Pictures):
    file = written / "figures" / "rollouts.gif"
    with Image.open(file) as image:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
        assert image.info["loop"] == 0
        assert image.size == (4 * (3 * 64 + 8) + 8, 34 + 3 * 64 + 26)
    assert durations == [50] * 100
    assert file.stat().st_size < 2e6


def test_gif_of_short_steps_skips_frames_and_keeps_time(tmp_path: Path, pictures: Pictures):
    clips, alive = {"Expert": pictures.rollouts["Expert"]}, pictures.alive
    for dt, frames_shown in ((0.008, 34), (0.0333, 100)):
        animation.write_rollouts(tmp_path / "a.gif", clips, alive, dt)
        with Image.open(tmp_path / "a.gif") as image:
            durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
        assert len(durations) == frames_shown
        shown = dt * 100 if frames_shown == 100 else dt * 102
        assert abs(sum(durations) - 1000 * shown) <= 5
        assert min(durations) >= 20


def test_gif_keeps_the_colours_and_greys_the_fallen(written: Path, pictures: Pictures):
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


def test_page_is_self_contained(written: Path):
    page = (written / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)\s*=\s*"([^"]*)"', page)
    assert len(sources) == 5
    for source in sources:
        data = re.fullmatch(r"data:image/(?:png|gif);base64,(.*)", source).group(1)
        assert base64.b64decode(data, validate=True)[:3] in (b"\x89PN", b"GIF")
    assert "<script" not in page
    assert "url(" not in page


def test_page_says_what_was_found(written: Path):
    text = text_of(written)
    for phrase in (
        "Of 6 latents, 4 are active; of these, Algorithm 1 masked o₃ (γ = 0.001).",
        "The previous action explains 97 % of o₃ (|Spearman| 0.99): it is the nuisance's.",
        "Masked's rollout loss is 1.15 times BcManual's (goal: at most 1.5; reached).",
        "BcVanilla's rollout loss is 7.00 times BcManual's (goal: at least 3; reached).",
        "BcManual's rollout loss is 1.37 times the expert's (goal: at most 2; reached).",
        "All goals are reached.",
        "outside its soft limits in 3.1 % of its steps",
        "bc.learning_rate",
    ):
        assert phrase in text
    assert "336.1" in text  # the seconds' sum


@pytest.mark.parametrize(
    ("mask", "phrase"),
    [
        (
            [True, False, True, False, False, False],
            "explains 1 % of o₁ (|Spearman| 0.03): it is not the nuisance's alone.",
        ),
        ([False] * 6, "The nuisance's o₃ was kept."),
    ],
)
def test_a_wrong_mask_is_said_to_miss(mask: list[bool], phrase: str):
    sentences = findings.paragraph({**run_of(), "mask": mask})
    assert any(phrase in sentence for sentence in sentences)
    assert sentences[-1] == "Goals missed: mask exactly the nuisance's latents."


def test_a_missed_ratio_is_said_to_miss():
    run = run_of()
    run["policies"]["Masked"]["rollout_loss"]["mean"] = 1.3 * 1.6
    run["nuisance_share"] = [0.5] * 6
    sentences = findings.paragraph(run)
    assert "The previous action explains 90 % of no active latent" in " ".join(sentences)
    assert sentences[-1] == (
        "Goals missed: mask exactly the nuisance's latents; Masked / BcManual."
    )


def test_goals_are_those_of_the_laptop_preset():
    sentences = findings.paragraph({**run_of(), "preset": "smoke"})
    assert sentences[-1] == "All goals are reached. They are set for the laptop preset."


def test_text_is_escaped(tmp_path: Path, pictures: Pictures):
    attack = '<script src="http://a.b">$x_1$ & "</script>'
    run = run_of()
    run["config"]["note"] = {attack: attack}
    run["state_names"][0] = run["action_names"][0] = run["preset"] = attack
    run["versions"]["device"] = attack
    write_report(tmp_path, run, pictures)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert page.count(html.escape(attack)) >= 6


def test_what_diverged_or_is_missing_is_said(tmp_path: Path, pictures: Pictures):
    run, nan, inf = run_of(), math.nan, math.inf
    run["policies"]["BcVanilla"]["rollout_loss"] = {"mean": inf, "std": nan, "per_epoch": []}
    run["policies"]["Masked"]["rollout_loss"].update(
        mean=nan, per_epoch=[[1, 3.0, 0.5], [5, nan, nan], [10, inf, inf], [20, 2.0, 0.1]]
    )
    del run["policies"]["BcManual"]["rollout_loss"]["per_epoch"]
    del run["policies"]["Reconstructed"]
    run["policies"]["Masked"]["train_loss"] = run["policies"]["Masked"]["outcome"] = nan
    run["state_observation"][1][2] = run["nuisance_share"][5] = run["kl"][5] = nan
    run["p_values"]["state_observation"][1][2] = nan
    run["threshold"] = 0.0
    write_report(tmp_path, run, pictures)
    text = text_of(tmp_path)
    assert text.count("diverged") >= 3
    assert (
        "BcVanilla's rollout loss is not comparable to BcManual's (goal: at least 3; missed)."
        in text
    )
    assert "Masked / BcManual; BcVanilla / BcManual." in text


def test_summary_averages_the_seeds(tmp_path: Path):
    runs = [run_of(seed) for seed in range(3)]
    for run, mean in zip(runs, (1.0, 2.0, 6.0), strict=True):
        run["policies"]["BcManual"]["rollout_loss"]["mean"] = mean
    write_summary(tmp_path, runs)
    text = text_of(tmp_path)
    rows = [line.split() for line in re.findall(r"mean  .*", text)]
    assert rows[0][1:6] == ["0.950", "9.10", "3.00", "1.50", "8.00"]
    ratios = (1.5 / 1.0 + 1.5 / 2.0 + 1.5 / 6.0) / 3
    assert rows[1][1] == f"{ratios:.3f}"
    with Image.open(tmp_path / "figures" / "rollout_loss.png") as image:
        assert image.size == (1020, 585)


def test_curve_over_seeds_is_the_spread_of_their_means():
    runs = [run_of(seed) for seed in range(2)]
    for run, mean in zip(runs, (1.0, 3.0), strict=True):
        run["policies"]["Masked"]["rollout_loss"]["per_epoch"] = [[5, mean, 9.0], [mean, 0.0, 0.0]]
    assert over_seeds(runs, "Masked") == [[5, 2.0, 1.0]]  # the only epoch that both have


def test_importing_the_report_does_not_load_matplotlib():
    code = "import sys, jaxdeconf.pipeline.report; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
