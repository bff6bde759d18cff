"""The grid of a sweep: its axes, its points, and which of them share a program."""

import pytest

from experiments import cartpole
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.grid import Axis, is_traced, numbers, points, read_axis, replace
from jaxdeconf.pipeline.sweep import part
from jaxdeconf.pipeline.sweep_cli import main

BASE = Config()


def test_points_are_all_combinations_seed_by_seed():
    axes = [Axis("bc.learning_rate", (1e-3, 1e-4)), Axis("mask.reaction_horizon", (1, 2, 3))]
    found = points(replace(BASE, {"seed": 5}), axes, seeds=2)
    assert [point.index for point in found] == list(range(12))
    assert [point.config.seed for point in found] == [5] * 6 + [6] * 6
    assert found[7].values == {"seed": 6, "bc.learning_rate": 1e-3, "mask.reaction_horizon": 2}
    assert found[7].config == replace(
        BASE, {"seed": 6, "bc.learning_rate": 1e-3, "mask.reaction_horizon": 2}
    )


def test_shards_are_all_points_once():
    found = points(BASE, [Axis("vae.beta", (1.0, 2.0, 3.0))], seeds=3)
    assert [p for i in range(1, 5) for p in part(found, (i, 4))] == found


@pytest.mark.parametrize(
    ("name", "values", "traced"),
    [
        ("bc.learning_rate", (1e-3, 1e-4), True),
        ("bc.weight_decay", (0.0, 1e-4), True),
        ("vae.beta", (1.0, 2.0), True),
        ("bc.huber", (0.1, 0.2), True),
        ("bc.huber", (None, 0.2), False),
        ("mask.threshold", (1e-3, 1e-2), True),
        ("mask.reaction_horizon", (1, 2), True),
        ("mask.alpha", (None, 0.05), True),
        ("bc.epochs", (1.0, 2.0), False),
        ("bc.network.width", (4, 8), False),
        ("collect.expert_trajectories", (100, 200), False),
    ],
)
def test_which_axes_are_traced(name, values, traced):
    assert is_traced(Axis(name, values), BASE) is traced


def test_a_stage_knows_its_own_numbers():
    axes = [Axis("bc.learning_rate", (1e-3,)), Axis("vae.beta", (2.0,)), Axis("bc.epochs", (3.0,))]
    (point,) = points(BASE, axes, seeds=1)
    assert numbers(point.config, "bc", axes, BASE) == {"learning_rate": 1e-3}
    assert numbers(point.config, "vae", axes, BASE) == {"beta": 2.0}


def test_an_axis_is_read_as_its_flag_would_be():
    def parse(field, value):
        return replace(BASE, {field: float(value)})

    assert read_axis("bc.learning-rate=1e-3,1", BASE, parse) == Axis(
        "bc.learning_rate", (1e-3, 1.0)
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--grid", "vae.beta=1,x"), "--vae.beta: could not convert string to float: 'x'"),
        (("--grid", "vae.bet=1"), "--grid: expected a field as bc.learning_rate, got 'vae.bet'"),
        (("--grid", "seed=1"), "--grid: expected a field as bc.learning_rate, got 'seed'"),
        (("--grid", "vae.beta="), "--grid: expected STAGE.FIELD=VALUE,VALUE,..., got 'vae.beta='"),
        (("--grid", "vae.beta=1,1.0"), "expected different values of vae.beta, got '1,1.0'"),
        (("--grid", "vae.beta=1", "vae.beta=2"), "--grid: expected each field once"),
        (("--grid", "mask.reaction_horizon=999"), "reaction_horizon: expected an integer <= "),
        (("--shard", "3/2"), "--shard: expected I/N with 1 <= I <= N, got '3/2'"),
        (("--seeds", "0"), "seeds: expected a positive integer, got 0"),
        (("--policies", "Copycat"), "--policies: invalid choice: 'Copycat'"),
        (("--memory", "-1"), "--memory: expected a positive number of GB, got -1.0"),
        (("--process-id", "1"), "--coordinator: expected HOST:PORT beside --process-id"),
        (("--devices", "0"), "--devices: expected a positive integer, got 0"),
        (("--resume", "nowhere"), "nowhere/sweep.json: no sweep to resume there"),
        (("--bc.epoch", "3"), "Perhaps you meant: --bc.epochs"),
    ],
)
def test_bad_command_lines_end_with_one_line_and_code_2(words, message, capsys):
    assert main("", {"cartpole": cartpole.PRESETS}, ("--plan", *words)) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
