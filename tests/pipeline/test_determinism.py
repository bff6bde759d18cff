"""What a run's numbers depend on: its seed, and nothing else on one machine.

Reference for keys: JAX's own checker, which fails where a key that was used is used again.
"""

import ast
import shutil
import signal
import zlib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.key_reuse._core import check_key_reuse  # the checker, without compiling

from jaxdeconf import evaluate, leakage, systems, views
from jaxdeconf.expert import ExpertConfig, expert_trajectories
from jaxdeconf.independence import permutation_p_value
from jaxdeconf.keys import named
from jaxdeconf.learn import clone, disentangle, fit
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.pipeline import checkpoint
from jaxdeconf.presets import PRESETS
from jaxdeconf.systems import random_trajectories
from jaxdeconf.systems.rollout import rollout, sample_action

SYSTEM = systems.get("cartpole")
CONFIG = PRESETS["cartpole"]["smoke"]
# Named draws that the policies of a run share, so that they differ in their views alone: the same
# first weights, shuffles, rollouts' first nuisance, redrawn nuisance, and regression.
SHARED = {"policy initial weights", "cloning", "evaluation", "copycat", "leakage"}
ALONE = {
    "random",
    "expert initial states",
    "expert",
    "VAE initial weights",
    "VAE training",
    *("nuisance share", "region", "predictability"),
    # Of a dataset of one's own.
    *("linear start", "check", "told", "stability", "retention", "written"),
    # Of rivals.
    *("shaken", "clone drives", "nuisance redrawn", "probe"),
    *("CCIL initial weights", "CCIL training", "CCIL queries", "CCIL returns"),
    *("VQ-VAE initial weights", "VQ-VAE training", "adversary initial weights", "keyframes"),
    # Of the theory's experiments.
    *("structures", "structural data", "normal columns", "pairs"),
    *("square", "first squares", "coupled", "driven", "redrawn"),
}


@pytest.mark.slow
def test_the_number_of_devices_changes_nothing(done, experiment, tmp_path):
    """Every kind of stage; a clone's notes hold what it drove while it was trained."""
    copy, redone = tmp_path / "copy", ("collect", "disentangle", "mask", "clone Masked")
    shutil.copytree(done.directory, copy)
    for stage in redone:
        shutil.rmtree(copy / "checkpoints" / stage)
    (copy / "results.json").unlink()
    # It need not judge them: they are made from the same, or not.
    four = experiment(
        *("SIGKILL", "judge Masked", "0", "--resume", copy),
        start=("-m", "tests.pipeline.killed"),
        XLA_FLAGS="--xla_force_host_platform_device_count=4",
    )
    assert four.returncode == -signal.SIGKILL, four.stderr
    for stage in redone:
        one, other = (saved(d / "checkpoints" / stage) for d in (copy, done.directory))
        assert one == other, stage


def saved(stage):
    """The arrays of a stage's latest checkpoint, as they are on disk, and its history."""
    folder = checkpoint.latest(stage)
    assert folder is not None
    notes = checkpoint.read_notes(folder)["notes"]
    return (folder / "arrays.npz").read_bytes(), notes.get("history")


def named_keys():
    """How often each name stands in the package's source, as `named(key, "name")`."""
    found = Counter()
    for file in Path(views.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            called = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
            if called and node.func.id == "named":
                assert isinstance(node.args[1], ast.Constant), f"{file}:{node.lineno}"
                found[node.args[1].value] += 1
    return found


def test_every_named_key_is_drawn_from_in_one_place():
    names = named_keys()
    assert set(names) == SHARED | ALONE
    assert max(names.values()) == 1
    assert len({zlib.crc32(name.encode()) for name in names}) == len(names)


def test_names_and_seeds_have_different_keys():
    keys = {
        tuple(jax.random.key_data(named(jax.random.key(seed), name)).tolist())
        for seed in range(20)
        for name in named_keys()
    }
    assert len(keys) == 20 * len(named_keys())


NETWORK = NetworkConfig(width=2, stem="imagenet")
CLONE = CloneConfig(batch_size=4, steps=1, network=NETWORK)
VAE = replace(
    CONFIG.disentangle,
    steps=1,
    batch_size=4,
    network=replace(CONFIG.disentangle.network, linear_path=False),
)
FEW = replace(SYSTEM, steps=3)


def images():
    return np.zeros((16, 64, 64, 3), np.uint8) + np.arange(16, dtype=np.uint8)[:, None, None, None]


def cloning(key):
    def data():
        actions = np.linspace(-1, 1, 16, dtype=np.float32)[:, None]
        return clone.Demonstrations(jnp.asarray(images()), jnp.arange(16), jnp.asarray(actions))

    return clone.training(CLONE, data, 16, views.identity, {}, key)


def disentangling(key):
    return disentangle.training(VAE, lambda: jnp.asarray(images()), 16, images, key)


def zeros(training):
    """Its first state's shapes, of zeros: numbers, where the key is only traced."""
    shapes = jax.eval_shape(lambda: training.start(training.data()))
    return jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), shapes)


def policy():
    return cloning(jax.random.key(9)).trained(zeros(cloning(jax.random.key(9))))


def driven(key):
    return evaluate.drive(FEW, policy(), jnp.zeros((2, 4)), key)


def test_seeds_differ_in_data_initial_weights_and_rollouts():
    def made(seed):
        key = jax.random.key(seed)
        data = random_trajectories(SYSTEM, named(key, "random"), 2)
        one, other = cloning(key), disentangling(key)
        weights = one.start(one.data()).variables["params"]["stem"]["kernel"]
        first = other.start(other.data()).variables["params"]["encoder"]["conv_1"]["kernel"]
        nuisance = driven(named(key, "evaluation")).signals[:, 0]
        return data.states, data.actions, weights, first, nuisance

    for one, same, other in zip(made(0), made(0), made(1), strict=True):
        np.testing.assert_array_equal(one, same)
        assert not np.isclose(one, other).any()


def begun(key):
    return disentangle.initial_state(CONFIG.disentangle, jnp.asarray(images()), key)


def trained(of):
    def train(key):
        training = of(key)
        chunks = fit.fit(
            training.objective,
            zeros(of(jax.random.key(0))),
            training.data(),
            training.samples,
            training.key,
            training.config,
        )
        return next(chunks)

    return train


def copied(key):
    drive_key, copy_key = jax.random.split(key)
    return evaluate.copycat(FEW, policy(), driven(drive_key), copy_key)


def one_random_trajectory(key):
    """One of `random_trajectories`: the checker takes any scan over keys under vmap for reuse."""

    def policy(memory, state, signal, key):
        return memory, sample_action(FEW, key)

    state_key, rollout_key = jax.random.split(key)
    return rollout(FEW, policy, None, FEW.sample_initial(state_key), rollout_key)


def leaked(key):
    signal = np.linspace(-1, 1, 16)[:, None]
    return leakage.leaked(images(), signal, key)


@pytest.mark.parametrize(
    "draw",
    [
        one_random_trajectory,
        lambda key: expert_trajectories(FEW, jnp.zeros((2, 4)), key, ExpertConfig(3, 2, 1)),
        driven,
        copied,
        leaked,
        begun,
        trained(disentangling),
        trained(cloning),
        lambda key: permutation_p_value(np.arange(8.0), np.arange(8.0) ** 2, key, 9),
    ],
    ids=[
        "random",
        "expert",
        "drive",
        "copycat",
        "leakage",
        "begin",
        "disentangle",
        "clone",
        "permutation",
    ],
)
def test_no_key_reaches_two_draws(draw):
    check_key_reuse(draw, jax.random.key(5))


def test_the_checker_would_see_it():
    def twice(key):
        return jax.random.normal(key), jax.random.uniform(key)

    with pytest.raises(jax.errors.KeyReuseError):
        check_key_reuse(jax.jit(twice), jax.random.key(5))
