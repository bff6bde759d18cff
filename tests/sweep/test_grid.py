"""The grid of a sweep: its axes, its points, and which of them share a program."""

import jax
import pytest

from jaxdeconf import systems
from jaxdeconf.commands.main import main
from jaxdeconf.commands.parse import parse_value
from jaxdeconf.pipeline.config import Config
from jaxdeconf.presets import PRESETS
from jaxdeconf.sweep.grid import Axis, is_traced, points, read_axis, replace
from jaxdeconf.sweep.log import Sweep
from jaxdeconf.sweep.plan import describe
from jaxdeconf.sweep.sweep import part

BASE = Config()


def test_points_are_all_combinations_seed_by_seed():
    axes = [Axis("clone.learning_rate", (1e-3, 1e-4)), Axis("mask.reaction_horizon", (1, 2, 3))]
    found = points(replace(BASE, {"seed": 5}), axes, seeds=2)
    assert [point.index for point in found] == list(range(12))
    assert [point.config.seed for point in found] == [5] * 6 + [6] * 6
    assert found[7].values == {"seed": 6, "clone.learning_rate": 1e-3, "mask.reaction_horizon": 2}
    assert found[7].config == replace(
        BASE, {"seed": 6, "clone.learning_rate": 1e-3, "mask.reaction_horizon": 2}
    )


def test_a_shard_without_points_has_nothing_to_do():
    one = Sweep(PRESETS["cartpole"]["smoke"])
    assert describe(one, systems.get("cartpole"), (1, 2), 1e9).endswith("\n  nothing to do")


def test_shards_are_all_points_once():
    found = points(BASE, [Axis("disentangle.beta", (1.0, 2.0, 3.0))], seeds=3)
    assert [p for i in range(1, 5) for p in part(found, (i, 4))] == found


@pytest.mark.parametrize(
    ("name", "values", "traced"),
    [
        ("clone.learning_rate", (1e-3, 1e-4), True),
        ("clone.weight_decay", (0.0, 1e-4), True),
        ("disentangle.beta", (1.0, 2.0), True),
        ("clone.huber", (0.1, 0.2), True),
        ("clone.huber", (None, 0.2), False),
        ("mask.threshold", (1e-3, 1e-2), True),
        ("mask.reaction_horizon", (1, 2), True),
        ("mask.alpha", (None, 0.05), True),
        ("clone.epochs", (1.0, 2.0), False),
        ("clone.frames", (1, 2), False),
        ("clone.network.width", (4, 8), False),
        ("collect.expert_trajectories", (100, 200), False),
    ],
)
def test_which_axes_are_traced(name, values, traced):
    assert is_traced(Axis(name, values), BASE) is traced


def test_points_that_differ_in_traced_fields_have_configs_of_one_structure():
    axes = [Axis("clone.learning_rate", (1e-3, 1e-4)), Axis("clone.huber", (0.1, 0.2))]
    assert len({jax.tree.structure(p.config.clone) for p in points(BASE, axes, 1)}) == 1


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("clone.learning-rate=1e-3,1", (1e-3, 1.0)),
        ("mask.alpha=None,0.1", (None, 0.1)),
        ("disentangle.network.channels=4 8,8 16 32", ((4, 8), (8, 16, 32))),
        ("mask.statistic=hoeffding,refined", ("hoeffding", "refined")),
        ("mask.states_together=1,2", (1, 2)),
        ("disentangle.network.linear_path=True,False", (True, False)),
    ],
)
def test_an_axis_is_read_as_its_flag_would_be(word, values):
    assert read_axis(word, BASE, parse_value).values == values


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--grid", "disentangle.beta=1,x"), "--disentangle.beta: could not convert string to"),
        (("--grid", "disentangle.bet=1"), "--grid: expected a field as clone.learning_rate, got"),
        (("--grid", "seed=1"), "--grid: expected a field as clone.learning_rate, got 'seed'"),
        (("--grid", "disentangle.beta="), "--grid: expected STAGE.FIELD=VALUE,VALUE,..., got "),
        (("--grid", "disentangle.beta=1,1.0"), "expected different values of disentangle.beta"),
        (("--grid", "disentangle.beta=1", "disentangle.beta=2"), "expected each field once"),
        (("--grid", "mask.reaction_horizon=999"), "reaction_horizon: expected an integer <= "),
        (("--grid", "collect.size=84 84"), "size: expected multiples of 32"),
        (("--shard", "3/2"), "--shard: expected I/N with 1 <= I <= N, got '3/2'"),
        (("--seeds", "0"), "seeds: expected a positive integer, got 0"),
        (("--methods", "Copycat"), "methods: expected one of BcVanilla, "),
        (("--memory", "-1"), "memory: expected a positive number, got -1.0"),
        (("--memory", "inf"), "memory: expected a positive number, got inf"),
        (("--process-id", "1"), "--coordinator: expected HOST:PORT beside --process-id"),
        (("--devices", "0"), "devices: expected a positive integer, got 0"),
        (("--devices", "5000"), "devices: expected an integer <= 1024, got 5000"),
        (("--resume", "nowhere"), "nowhere/sweep.json: no sweep to resume there"),
        (("--clone.epoch", "3"), "Perhaps you meant: --clone.epochs"),
        (("--system", "pendulum"), "--system: expected one of cartpole, reacher, got 'pendulum'"),
    ],
)
def test_bad_command_lines_end_with_one_line_and_code_2(words, message, capsys, monkeypatch):
    # As in a process of its own, in which JAX has not looked for devices yet.
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    assert main(["sweep", "--plan", *words]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert message in printed.err
    assert printed.err.count("\n") == 1
