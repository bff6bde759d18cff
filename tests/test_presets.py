"""The presets against the paper (its appendix; tests/pipeline/test_paper.py steps them), field by
field, and against each other."""

import pytest

from jaxdeconf import systems
from jaxdeconf.pipeline.config import fitting
from jaxdeconf.presets import PRESETS

# What the paper gives: of both systems, and of each.
BOTH = {
    "disentangle.epochs": 100,
    "disentangle.steps": None,
    "disentangle.decay": 0.95,
    "disentangle.network.channels": (32, 64, 128, 256, 512),
    "disentangle.network.linear_path": False,
    "disentangle.network.decoder": "convolutions",
    "disentangle.network.norm": "batch",
    "mask.alpha": None,  # it names a bare threshold
    "mask.statistic": "hoeffding",
    "clone.learning_rate": 0.001,
    "clone.decay": 0.96,
    "clone.batch_size": 256,
    "clone.frames": 2,
    "clone.trajectory_steps": None,
    "clone.huber": None,
    "clone.network.width": 64,
    "clone.network.stem": "cifar",
    "clone.network.stages": 4,
    "clone.network.kind": "resnet",
    "clone.network.hidden": (),
    "collect.random_steps": None,
    "collect.size": None,
    "evaluate.rollouts": 25,
    "evaluate.every": 10,
}
OF = {
    "cartpole": {
        "collect.random_trajectories": 5000,
        "collect.expert_trajectories": 1000,
        "disentangle.learning_rate": 0.005,
        "disentangle.batch_size": 64,
        "disentangle.beta": 100,
        "disentangle.network.latents": 3,
        "mask.reaction_horizon": 3,
        "mask.threshold": 1e-3,
    },
    "reacher": {
        "collect.random_trajectories": 2000,
        "collect.expert_trajectories": 2000,
        "disentangle.learning_rate": 0.0005,
        "disentangle.batch_size": 256,
        "disentangle.beta": 1000,
        "disentangle.network.latents": 12,
    },
}
SYSTEMS = {
    "cartpole": {"steps": 100, "dt": 0.05, "action_limit": (25.0,), "size": (64, 64)},
    "reacher": {"steps": 200, "dt": 0.05, "action_limit": (2.0, 2.0), "size": (64, 64)},
}


def value(config, name):
    for part in name.split("."):
        config = getattr(config, part)
    return config


@pytest.mark.parametrize(
    ("system", "name", "expected"),
    [(s, name, expected) for s, own in OF.items() for name, expected in (BOTH | own).items()],
)
def test_the_paper_presets_have_the_papers_numbers(system, name, expected):
    assert value(PRESETS[system]["paper"], name) == expected


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_systems_have_the_papers_numbers(system):
    for name, expected in SYSTEMS[system].items():
        assert getattr(systems.get(system), name) == expected


@pytest.mark.parametrize("system", SYSTEMS)
def test_every_preset_fits_its_system_and_says_its_name(system):
    assert tuple(PRESETS[system]) == ("smoke", "laptop", "paper")
    for name, config in PRESETS[system].items():
        assert (config.system, config.preset) == (system, name)
        assert fitting(config, systems.get(system)).name == system
