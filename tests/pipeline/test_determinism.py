"""What a run's numbers depend on: its seed, and nothing else on one machine.

Reference for keys: JAX's own checker, which fails where a key that was used is used again.
"""

import ast
import shutil
import zlib
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.key_reuse._core import check_key_reuse  # the checker, without compiling
from rich.console import Console

from experiments.cartpole import PRESETS
from jaxdeconf import evaluate, leakage, systems
from jaxdeconf.expert import ExpertConfig, expert_trajectories
from jaxdeconf.independence import permutation_p_value
from jaxdeconf.learn import clone, disentangle, views
from jaxdeconf.nets.resnet import ResNetConfig
from jaxdeconf.pipeline import stages
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.systems import random_trajectories
from jaxdeconf.systems.rollout import frames, rollout, sample_action

SYSTEM = systems.get("cartpole")
CONFIG = PRESETS["smoke"]
# Named draws that the policies of a run share, so that they differ in their views alone: the same
# first weights, shuffles, rollouts' first nuisance, redrawn nuisance, and regression.
SHARED = {"policy initial weights", "cloning", "evaluation", "copycat", "leakage"}
ALONE = {
    "random",
    "expert initial states",
    "expert",
    "VAE initial weights",
    "VAE training",
    "nuisance share",
}


@pytest.mark.slow
def test_the_number_of_devices_changes_nothing(done, experiment, numbers, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(done.directory, copy)
    # The stages that stay were made on one device, and say what they were made from: had the four
    # made it otherwise, they would be refused.
    for stage in ("collect", "disentangle", "mask", "clone Masked"):
        shutil.rmtree(copy / "checkpoints" / stage)
    (copy / "results.json").unlink()
    four = experiment("--resume", copy, XLA_FLAGS="--xla_force_host_platform_device_count=4")
    assert four.returncode == 0, four.stderr
    assert numbers(copy) == numbers(done.directory)


def named_keys():
    """How often each name stands in the pipeline's source, as `key("name")`."""
    found = Counter()
    for file in Path(stages.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            called = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
            if called and node.func.attr == "key" and isinstance(node.args[0], ast.Constant):
                found[node.args[0].value] += isinstance(node.args[0].value, str)
    return +found


def test_every_named_key_is_drawn_from_in_one_place():
    names = named_keys()
    assert set(names) == SHARED | ALONE
    assert max(names.values()) == 1
    assert len({zlib.crc32(name.encode()) for name in names}) == len(names)


def run_of(seed):
    config = replace(CONFIG, seed=seed)
    return stages.Run(config, None, Reporter(Console(quiet=True)), {})


def test_names_and_seeds_have_different_keys():
    keys = {
        tuple(jax.random.key_data(run_of(seed).key(name)).tolist())
        for seed in range(20)
        for name in named_keys()
    }
    assert len(keys) == 20 * len(named_keys())


def test_seeds_differ_in_data_initial_weights_and_rollouts():
    def made(seed):
        run = run_of(seed)
        data = random_trajectories(SYSTEM, run.key("random"), 2)
        weights = stages.initial_policy(run).variables["params"]["stem"]["kernel"]
        images = frames(SYSTEM, data).reshape(-1, 64, 64, 3)
        config = replace(CONFIG.vae, network=replace(CONFIG.vae.network, linear_path=False))
        vae = disentangle.initial_state(config, images, run.key("VAE initial weights"))
        first = vae.variables["params"]["encoder"]["conv_1"]["kernel"]
        nuisance = driven(run.key("evaluation")).previous_actions[:, 0]
        return data.states, data.actions, weights, first, nuisance

    for one, same, other in zip(made(0), made(0), made(1), strict=True):
        np.testing.assert_array_equal(one, same)
        assert not np.isclose(one, other).any()


DRIVER = evaluate.Driver(ResNetConfig(width=2, stem="imagenet"), views.identity)
FEW = replace(SYSTEM, steps=3)


def policy():
    config = clone.CloneConfig(network=DRIVER.network)
    return clone.initial_state(config, (64, 64, 3), 1, jax.random.key(9))


def driven(key):
    weights = evaluate.Weights(policy().variables, {})
    return evaluate.drive(FEW, DRIVER, weights, jnp.zeros((2, 4)), key)


def images():
    return np.zeros((16, 64, 64, 3), np.uint8) + np.arange(16, dtype=np.uint8)[:, None, None, None]


def zeros(make):
    """What `make` would make, of zeros: numbers, where the key is only traced."""
    return jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), jax.eval_shape(make))


def trained(key):
    config = clone.CloneConfig(batch_size=4, network=DRIVER.network)
    data = clone.Demonstrations(images(), np.zeros(16, bool), np.linspace(-1, 1, 16)[:, None])
    return next(clone.clone(config, zeros(policy), data, key, ()))


VAE = replace(CONFIG.vae, batch_size=4)


def begun(key):
    return disentangle.initial_state(VAE, jnp.asarray(images()), key)


def disentangled(key):
    state = zeros(partial(begun, jax.random.key(0)))
    return next(disentangle.disentangle(VAE, state, images(), key))


def copied(key):
    drive_key, copy_key = jax.random.split(key)
    weights = evaluate.Weights(policy().variables, {})
    return evaluate.copycat(FEW, DRIVER, weights, driven(drive_key), copy_key)


def one_random_trajectory(key):
    """One of `random_trajectories`: the checker takes any scan over keys under vmap for reuse."""

    def policy(memory, state, previous_action, key):
        return memory, sample_action(FEW, key)

    state_key, rollout_key = jax.random.split(key)
    return rollout(FEW, policy, None, FEW.sample_initial(state_key), rollout_key)


def leaked(key):
    signal = np.linspace(-1, 1, 16)[:, None]
    return leakage.r_squared(images(), signal, images(), signal, key)


@pytest.mark.parametrize(
    "draw",
    [
        one_random_trajectory,
        lambda key: expert_trajectories(FEW, jnp.zeros((2, 4)), key, ExpertConfig(3, 2, 1)),
        driven,
        copied,
        leaked,
        begun,
        disentangled,
        trained,
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
