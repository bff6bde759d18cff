"""Reacher through the same stages as CartPole: two torques, twelve latents, its own outcome."""

import numpy as np
import pytest
from rich.console import Console

from experiments.reacher import PRESETS
from jaxdeconf.pipeline import cli, run
from jaxdeconf.pipeline.progress import Reporter

# Smaller yet than the smoke preset: that its stages fit together, in less time. The expert drives
# 8 + 2 trajectories at once, as many as there are golden ones in tests/systems/test_reacher.py: one
# compiled program, of some twenty seconds, does for both.
SMALLER = (
    *("--preset", "smoke", "--collect.random-trajectories", "60"),
    *("--collect.held-out-trajectories", "20", "--collect.expert-trajectories", "8"),
    *("--vae.epochs", "0.5", "--bc.epochs", "0.25", "--eval.rollouts", "2"),
)


def test_presets_are_of_this_system():
    assert {preset.system for preset in PRESETS.values()} == {"reacher"}
    assert {name: preset.preset for name, preset in PRESETS.items()} == {n: n for n in PRESETS}
    assert {preset.vae.network.latents for preset in PRESETS.values()} == {12}  # the paper's


@pytest.mark.slow
def test_a_run_ends_with_its_report(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "POLICIES", ("Masked",))  # the others take the same way
    config = cli.parse("", PRESETS, SMALLER).config
    results = run.run(config, tmp_path / "run", Reporter(Console(quiet=True)))
    assert np.shape(results["state_observation"]) == (6, 12)
    assert np.shape(results["state_action"]) == (6, 3, 2)
    assert np.shape(results["nuisance_share"]) == (12,)
    assert results["expert"]["outcome"] < 0.05
    assert 0 < results["policies"]["Masked"]["outcome"] < 2
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Final distance: from the arm&#x27;s end" in page
    assert cli.summary(results, tmp_path).count("final distance (m) ") == 2
