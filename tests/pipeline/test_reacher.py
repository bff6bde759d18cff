"""Reacher through the same stages as CartPole: two torques, twelve latents, its own outcome."""

import numpy as np
import pytest
from rich.console import Console

from jaxdeconf.commands.run import read
from jaxdeconf.pipeline import results
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.run import run
from jaxdeconf.presets import PRESETS
from jaxdeconf.report.run import write_report
from jaxdeconf.report.words import summary

# Smaller yet than the smoke preset: that its stages fit together, in less time. The expert drives
# 8 + 2 trajectories at once, as many as there are golden ones in tests/systems/test_reacher.py: one
# compiled program, of some twenty seconds, does for both. One method: the others take the same way.
SMALLER = (
    *("--preset", "smoke", "--collect.random-trajectories", "60", "--methods", "Masked"),
    *("--collect.held-out-trajectories", "20", "--collect.expert-trajectories", "8"),
    *("--disentangle.epochs", "0.5", "--clone.epochs", "0.25", "--evaluate.rollouts", "2"),
)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:actions. column 1 has its most frequent value")  # 8 episodes
def test_a_run_ends_with_its_report(tmp_path):
    config = read("", PRESETS["reacher"], SMALLER).config
    found = run(config, directory=tmp_path, reporter=Reporter(Console(quiet=True)))
    assert np.shape(found.state_observation) == (6, 12)
    assert np.shape(found.state_action) == (6, 3, 2)
    assert np.shape(found.nuisance_share) == (12,)
    assert found.expert.outcome < 0.05
    assert 0 < found.policies["Masked"].outcome < 2
    write_report(tmp_path, *results.load(tmp_path))
    page = (tmp_path / "report.html").read_text()
    assert "Final distance: from the arm&#x27;s end" in page
    assert "final distance (m)" in summary(found, tmp_path)
