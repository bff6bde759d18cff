"""The whole program, as a user runs it: every stage, every file."""

import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from jaxdeconf.commands.main import main

pytestmark = pytest.mark.slow
POLICIES = ("BcVanilla", "BcManual", "Masked")


@pytest.fixture(scope="module")
def results(done):
    return json.loads((done[0] / "results.json").read_text())


def test_it_says_what_it_found_and_beside_it_a_line_a_stage(done):
    _, run = done
    stages = [line.split(": ")[0] for line in run.stderr.splitlines()]
    each = [f"{what} {policy}" for policy in POLICIES for what in ("clone", "judge")]
    assert (stages[0], stages[-1]) == ("collect", "judge")
    assert sorted(stages[1:-1]) == sorted(["disentangle", "mask", *each])  # side by side
    assert stages.index("disentangle") < stages.index("mask") < stages.index("clone Masked")
    assert re.search(r"^clone Masked: \d+\.\d s, loss \d", run.stderr, re.MULTILINE)
    assert re.search(r"^judge Masked: \d+\.\d s, rollout loss \d", run.stderr, re.MULTILINE)
    assert run.stdout.startswith("cartpole, preset smoke with ")
    assert "seed 0" in run.stdout.splitlines()[0]
    assert all(policy in run.stdout for policy in POLICIES)
    assert run.stdout.rstrip().endswith("report.html")


def test_results_hold_what_is_promised(results):
    latents, states, actions, horizon = 4, 4, 1, 3
    assert (results["system"], results["preset"], results["seed"]) == ("cartpole", "smoke", 0)
    for name in ("mask", "active", "kl", "nuisance_correlation", "nuisance_share"):
        assert np.shape(results[name]) == (latents,)
    assert np.shape(results["state_observation"]) == (states, latents)
    assert np.shape(results["state_action"]) == (states, horizon, actions)
    assert 0 < results["expert"]["rollout_loss"] < 20
    assert 0 <= results["expert"]["violation_rate"] < 1
    assert set(results["policies"]) == set(POLICIES)
    for policy in results["policies"].values():
        assert 0 <= policy["outcome"] <= 1
        assert 0 <= policy["copycat"] <= 2
        assert policy["leakage"] <= 1
        assert policy["train_loss"] > 0
        epochs = [epoch for epoch, _, _ in policy["rollout_loss"]["per_epoch"]]
        assert epochs == pytest.approx([0.25, 0.5], abs=0.02)  # to a whole step
        loss = policy["rollout_loss"]
        assert loss["error"] == pytest.approx(loss["std"] / np.sqrt(8 - 1), rel=1e-4)
        assert loss["median"] < loss["mean"] + 2 * loss["std"]
    each = {f"{what} {policy}" for policy in POLICIES for what in ("clone", "judge")}
    assert set(results["seconds"]) == {"collect", "disentangle", "mask", "judge", *each}
    assert {"python", "jax", "jaxdeconf", "device"} <= set(results["versions"])


def test_the_mask_follows_from_the_statistics(results):
    depends = np.array(results["state_observation"]) > results["threshold"]
    moves = (np.array(results["state_action"]) > results["threshold"]).any(axis=(1, 2))
    assert results["mask"] == (~(depends & moves[:, None]).any(axis=0)).tolist()


def test_what_a_policy_cannot_see_it_does_not_copy(results):
    policies = results["policies"]
    assert policies["BcManual"]["copycat"] == 0
    assert policies["BcVanilla"]["leakage"] > 0.95
    assert policies["BcManual"]["leakage"] < 0.1


def test_every_picture_is_there(done):
    directory, _ = done
    for name in ("dependence", "rollout_loss", "frames", "traversals"):
        with Image.open(directory / "figures" / f"{name}.png") as image:
            assert min(image.size) > 100
    with Image.open(directory / "figures" / "rollouts.gif") as image:
        assert getattr(image, "n_frames", 1) > 10
    assert "data:image/png;base64," in (directory / "report.html").read_text()


def test_a_finished_run_resumes_to_the_same_numbers(done, experiment, numbers, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(done[0], copy)
    # A missing stage is redone; that it comes out the same keeps the later ones valid.
    for name in ("mask", "clone Masked"):
        shutil.rmtree(copy / "checkpoints" / name)
    (copy / "results.json").unlink()
    (copy / "report.html").write_text("of the results that were there before")
    run = experiment("--resume", copy)
    assert run.returncode == 0, run.stderr
    assert numbers(copy) == numbers(done.directory)
    assert "BcManual" in (copy / "report.html").read_text()


def test_what_is_finished_is_only_said_again_and_its_report_redrawn(done, capsys, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(done.directory, copy)
    shutil.rmtree(copy / "checkpoints")  # nothing of it is needed any more
    shutil.rmtree(copy / "figures")
    (copy / "report.html").unlink()
    before = (copy / "results.json").read_bytes()
    assert main(["report", str(copy)]) == 0
    assert capsys.readouterr().out == f"report: {copy / 'report.html'}\n"
    for name in ("dependence", "rollout_loss", "frames", "traversals"):
        one, other = (d / "figures" / f"{name}.png" for d in (copy, done.directory))
        assert one.read_bytes() == other.read_bytes()
    assert (copy / "report.html").read_text() == (done.directory / "report.html").read_text()
    for words in (["--resume", str(copy)], ["--out", str(copy), "--resume-if-exists"]):
        assert main(["cartpole", *words]) == 0
        said = capsys.readouterr().out.replace(str(copy), str(done.directory))
        assert said == done.process.stdout
    assert (copy / "results.json").read_bytes() == before
