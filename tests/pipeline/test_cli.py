"""The command line: presets, flags, and what a wrong argument costs."""

import json
import re
import subprocess
import sys

import pytest

from experiments.cartpole import PRESETS
from jaxdeconf import __version__
from jaxdeconf.pipeline import cli
from jaxdeconf.pipeline.store import write_config


def parse(*arguments):
    return cli.parse("", PRESETS, arguments)


def test_the_default_is_the_laptop_preset():
    asked = parse()
    assert asked.config == PRESETS["laptop"]
    assert (asked.seeds, asked.out, asked.resume) == (1, None, None)


def test_flags_change_the_preset_they_are_given_with():
    asked = parse("--preset", "smoke", "--bc.learning-rate", "0.5", "--vae.network.latents", "7")
    assert asked.config.bc.learning_rate == 0.5
    assert asked.config.vae.network.latents == 7
    assert asked.config.collect == PRESETS["smoke"].collect


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--preset", "big"], "--preset: expected one of smoke, laptop, paper, got 'big'"),
        (["--preset"], "--preset: expected one of smoke, laptop, paper, got ''"),
        (["--bc.learning-rate", "fast"], "--bc.learning-rate: .*'fast'"),
        (["--bc.learning-rate", "nan"], "learning_rate: expected a positive number, got nan"),
        (["--bc.learning-rate", "1e400"], "learning_rate: expected a positive number, got inf"),
        (["--vae.epochs", "inf"], "epochs: expected a positive number, got inf"),
        (["--bc.epochs", "1e30"], "epochs: expected at most 2147483647 steps in all, got 1e.30"),
        (["--bc.batch-size", "1e3"], "--bc.batch-size: .*1e3"),
        (["--bc.batch-size", "1" + 30 * "0"], "batch_size: expected an integer <= 2147483647"),
        (["--bc.batch-size", "1000000"], "batch_size: expected at most 40000 samples, got 1000000"),
        (["--vae.network.channels", "8", "0"], "channels: expected a positive integer, got 0"),
        (["--vae.network.channels"], "channels: expected positive integers, got .."),
        (["--vae.objective", "G"], "choice 'G' for argument '--vae.objective'"),
        (["--vae.capacity", "-inf"], "capacity: expected a number >= 0, got -inf"),
        (["--mask.threshold", "-1e-9"], "threshold: expected a number >= 0, got -1e-09"),
        (["--mask.alpha", "nan"], "alpha: expected a number in .0, 1., got nan"),
        (["--mask.reaction-horizon", "101"], "reaction_horizon: expected an integer <= 100"),
        (["--collect.expert-trajectories", "4"], "expert_trajectories: expected .* >= 5, got 4"),
        (["--eval.every", "inf"], "every: expected a positive number, got inf"),
        (["--expert.tolerance", "0"], "tolerance: expected a positive number, got 0"),
        (["--bc.trajectory-steps", "-4"], "trajectory_steps: expected a positive integer, got -4"),
        (["--system", "pendulum"], "system: expected one of cartpole.*, got 'pendulum'"),
        (["--bc.learning-rate", "-1"], "learning_rate: expected a positive number, got -1.0"),
        (["--bc.lerning-rate", "1"], "--bc.lerning-rate.*--bc.learning-rate"),
        (["--vae.beta", "-2"], "beta: expected a number >= 0, got -2.0"),
        (["--mask.alpha", "2"], "alpha: expected a number in .0, 1., got 2.0"),
        (["--mask.reaction-horizon", "0"], "reaction_horizon: expected a positive integer, got 0"),
        (["--bc.network.width", "0"], "width: expected a positive integer, got 0"),
        (["--eval.rollouts", "0"], "rollouts: expected a positive integer, got 0"),
        (["--expert.horizon", "0"], "horizon: expected a positive integer, got 0"),
        (["--collect.expert-trajectories", "0"], "expert_trajectories: expected .*, got 0"),
        (["--seed", "-1"], "seed: expected an integer >= 0, got -1"),
        (["--seed", "1.5"], "--seed: .*1.5"),
        (["--seeds", "2", "--seed", str(2**32 - 1)], "seeds: expected an integer <= 1, got 2"),
        (["--seeds", "nan"], "--seeds: .*nan"),
        (["--seeds", "0"], "seeds: expected a positive integer, got 0"),
        (["--out", "a", "--resume", "b"], "b/config.json: no run to resume there"),
    ],
)
def test_a_wrong_argument_exits_with_2_and_one_line(arguments, said, capsys):
    assert cli.main("", PRESETS, arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("error: ")
    assert re.search(said, printed.err)


def test_resuming_needs_no_flags(tmp_path):
    config = parse("--preset", "smoke", "--vae.beta", "3", "--seed", "5").config
    write_config(tmp_path, config)
    assert parse("--resume", str(tmp_path)).config == config


def test_a_config_that_is_none_is_named(tmp_path, capsys):
    (tmp_path / "config.json").write_text(
        json.dumps({"jaxdeconf": __version__, "seed": 1, "wheels": 4})
    )
    assert cli.main("", PRESETS, ["--resume", str(tmp_path)]) == 2
    assert "config.json: not a config of jaxdeconf" in capsys.readouterr().err


def test_out_and_resume_exclude_each_other(tmp_path, capsys):
    write_config(tmp_path, PRESETS["smoke"])
    assert cli.main("", PRESETS, ["--out", "a", "--resume", str(tmp_path)]) == 2
    assert "expected only one of --out and --resume" in capsys.readouterr().err


def test_help_shows_every_field_and_exits_with_0():
    run = subprocess.run(
        [sys.executable, "-m", "experiments.cartpole", "--help"], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    for flag in (
        "--bc.learning-rate",
        "--vae.objective",
        "--mask.threshold",
        "--resume",
        "--seeds",
    ):
        assert flag in run.stdout
