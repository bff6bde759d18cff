"""Wrong arguments of every public function: one line that names the argument and what came.

A row is (the argument's name, how the message shows what came, the call).
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import evaluate, leakage, systems
from jaxdeconf.collect import CollectConfig
from jaxdeconf.deconfound import clone_policy, deconfound, learn_latents, mask_latents
from jaxdeconf.demos import Demos
from jaxdeconf.evaluate import EvaluateConfig
from jaxdeconf.expert import ExpertConfig, plan
from jaxdeconf.independence import (
    hoeffding_d,
    p_value,
    permutation_p_value,
    refined_d,
    threshold,
)
from jaxdeconf.learn.clone import CloneConfig, Policy
from jaxdeconf.learn.disentangle import DisentangleConfig, Encoder
from jaxdeconf.learn.fit import FitConfig
from jaxdeconf.learn.linear_start import linear_start
from jaxdeconf.mask import Mask, MaskConfig, find_mask
from jaxdeconf.method import Evidence
from jaxdeconf.methods import METHODS
from jaxdeconf.nets import vae
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.pipeline.config import Config, fitting
from jaxdeconf.region import find_region
from jaxdeconf.systems.rollout import Trajectories
from jaxdeconf.views import identity
from jaxdeconf.vision.nuisance import ColorSquare

NAN, INF = float("nan"), float("inf")
SYSTEM = systems.get("cartpole")
KEY = jax.random.key(0)
STATES = np.zeros((6, 4), np.float32)
WRONG_STATES = np.where(np.arange(24).reshape(6, 4) == 9, NAN, 0.0)
IMAGES = np.zeros((6, 64, 64, 3), np.uint8)
SAMPLES = np.arange(8.0)
OBSERVATIONS, ACTIONS = np.ones((6, 2)), np.ones((6, 3, 1))
TRAJECTORIES = Trajectories(
    np.zeros((6, 2, 4)),
    np.zeros((6, 2, 1)),
    np.zeros((6, 2, 1)),
    np.ones((6, 2), bool),
    np.zeros((6, 2, 1)),
)
VAE, RESNET = VAEConfig(channels=(4, 4)), NetworkConfig(width=4)
POLICY = Policy(identity, RESNET, 2, {}, {})
NONE = jnp.zeros((1, 1, 1))
MASK = Mask(
    *(jnp.zeros(1, bool), NONE[0], NONE, NONE > 0, jnp.zeros(())),
    *(NONE[0], NONE, NONE[0] > 0, NONE > 0, NONE[0], NONE),
)
# Seven episodes of three steps, frames to go with them, and a β-VAE of such frames.
FRAMES = np.zeros((20, 16, 24, 3), np.uint8)
DEMOS = Demos(np.zeros((7, 3, 16, 24, 3), np.uint8), np.zeros((7, 3, 1)), np.zeros((7, 2)))
LEARN = DisentangleConfig(batch_size=4, network=VAE)
CLONE = CloneConfig(batch_size=4, network=RESNET)
SHAPES = jax.eval_shape(lambda: vae.init(VAE, KEY, (16, 24)))
VARIABLES = jax.tree.map(lambda leaf: np.zeros(leaf.shape, np.float32), SHAPES)
ENCODER = Encoder(VAE, VARIABLES, jnp.ones(3), jnp.ones(3, bool))
NONE = np.zeros(3, bool)
OTHER_SIZE = replace(DEMOS, images=np.zeros((7, 3, 32, 24, 3), np.uint8))


def loss(*_):
    raise AssertionError("reached")


learn = partial(learn_latents, FRAMES, FRAMES, KEY, LEARN, loss)
clone = partial(clone_policy, key=KEY, config=CLONE, watch=loss)
configured = partial(fitting, system=SYSTEM)


def whole(**changed):
    arguments = {"demos": DEMOS, "exploration": FRAMES, "key": KEY, "watch": loss}
    configs = {"disentangle": LEARN, "clone": CLONE}
    return deconfound(**{**arguments, **configs, **changed})


BAD = [
    # systems
    ("name", "'pendulum'", lambda: systems.get("pendulum")),
    ("name", "['cartpole']", lambda: systems.get(["cartpole"])),
    ("size", "96", lambda: replace(SYSTEM, size=96)),
    ("size", "0", lambda: replace(SYSTEM, size=(96, 0))),
    # vision
    ("size", "nan", lambda: ColorSquare(size=NAN)),
    ("size", "-1", lambda: ColorSquare(size=-1)),
    ("corner", "shape (3,)", lambda: ColorSquare(corner=(0.0, 0.0, 0.0))),
    ("low", "nan", lambda: ColorSquare(low=(0.0, NAN, 0.0))),
    # expert
    ("initial_states", "nan at [2, 1]", lambda: plan(SYSTEM, WRONG_STATES)),
    ("initial_states", "shape (0, 4)", lambda: plan(SYSTEM, np.zeros((0, 4)))),
    ("initial_states", "complex64", lambda: plan(SYSTEM, STATES + 1j)),
    ("system", "'cartpole'", lambda: plan("cartpole", STATES)),
    ("config", "30", lambda: plan(SYSTEM, STATES, 30)),
    ("horizon", "-1", lambda: ExpertConfig(horizon=-1)),
    ("horizon", "True", lambda: ExpertConfig(horizon=True)),
    ("horizon", str(10**30), lambda: ExpertConfig(horizon=10**30)),
    ("initial_iterations", "nan", lambda: ExpertConfig(initial_iterations=NAN)),
    ("step_iterations", "'two'", lambda: ExpertConfig(step_iterations="two")),
    ("tolerance", "inf", lambda: ExpertConfig(tolerance=INF)),
    ("least_cost", "0.0", lambda: ExpertConfig(least_cost=0.0)),
    # independence
    ("x", "4", lambda: hoeffding_d(SAMPLES[:4], SAMPLES[:4])),
    ("x", "0", lambda: hoeffding_d([], [])),
    ("y", "7", lambda: hoeffding_d(SAMPLES, SAMPLES[:7])),
    ("y", "7", lambda: refined_d(SAMPLES, SAMPLES[:7])),
    ("x", "1 NaN", lambda: hoeffding_d(np.where(SAMPLES == 3, NAN, SAMPLES), SAMPLES)),
    ("y", "<U1", lambda: hoeffding_d(SAMPLES, list("abcdefgh"))),
    ("y", "1", lambda: hoeffding_d(SAMPLES, np.ma.masked_equal(SAMPLES, 3.0))),
    ("x", "datetime64", lambda: hoeffding_d(SAMPLES.astype("datetime64[s]"), SAMPLES)),
    ("x", "datetime64", lambda: hoeffding_d(np.array(["NaT"] * 8, "datetime64[s]"), SAMPLES)),
    ("y", "timedelta64", lambda: refined_d(SAMPLES, SAMPLES.astype("timedelta64[s]"))),
    ("x", "cm", lambda: hoeffding_d(Measured("units"), SAMPLES)),
    ("y", "cm", lambda: permutation_p_value(SAMPLES, Measured("unit"), KEY)),
    ("x", "shape (8, 0)", lambda: hoeffding_d(np.zeros((8, 0)), SAMPLES)),
    ("x", "different lengths", lambda: hoeffding_d([[1, 2], [3], [4], [5], [6]], SAMPLES[:5])),
    ("x", str(2**31), lambda: hoeffding_d(np.broadcast_to(np.float32(0), 2**31), SAMPLES)),
    ("d", "int", lambda: p_value(3, 10)),
    ("d", "1", lambda: p_value(np.ma.masked_equal(SAMPLES, 3.0), 10)),
    ("n", str(2**31), lambda: threshold(2**31)),
    ("n", "4", lambda: p_value(0.1, 4)),
    ("n", "nan", lambda: p_value(0.1, NAN)),
    ("n", "100.0", lambda: threshold(100.0)),
    ("tests", "0", lambda: threshold(100, tests=0)),
    ("alpha", "nan", lambda: threshold(100, alpha=NAN)),
    ("alpha", "1.0", lambda: threshold(100, alpha=1.0)),
    ("permutations", "0", lambda: permutation_p_value(SAMPLES, SAMPLES, KEY, 0)),
    ("permutations", "99.9", lambda: permutation_p_value(SAMPLES, SAMPLES, KEY, 99.9)),
    ("key", "3", lambda: permutation_p_value(SAMPLES, SAMPLES, 3)),
    ("y", "6", lambda: permutation_p_value(SAMPLES, SAMPLES[:6], KEY)),
    ("statistic", "'D'", lambda: permutation_p_value(SAMPLES, SAMPLES, KEY, 9, "D")),
    # mask
    ("initial_states", "shape (6,)", lambda: find_mask(STATES[:, 0], OBSERVATIONS, ACTIONS)),
    ("trajectories in initial_states", "4", lambda: find_mask(*few(4))),
    ("observations", "inf at [0, 0]", lambda: find_mask(STATES, OBSERVATIONS * INF, ACTIONS)),
    ("observations", "(5, 2)", lambda: find_mask(STATES, OBSERVATIONS[1:], ACTIONS)),
    (
        "actions",
        "1",
        lambda: find_mask(
            STATES,
            OBSERVATIONS,
            np.ma.array(ACTIONS, mask=ACTIONS.cumsum().reshape(ACTIONS.shape) == 4),
        ),
    ),
    ("initial_states", "cm", lambda: find_mask(Measured("units"), OBSERVATIONS, ACTIONS)),
    ("actions", "shape (6, 0, 1)", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS[:, :0])),
    ("threshold", "nan", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS, NAN)),
    ("threshold", "-0.1", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS, [0.1, -0.1])),
    ("threshold", "None", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS, None)),
    ("alpha", "0", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS, alpha=0)),
    ("alpha", "'no'", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS, alpha="no")),
    ("statistic", "'D'", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS, statistic="D")),
    ("states_together", "3", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS, states_together=3)),
    ("horizon", "0", lambda: MASK.within(0)),
    ("horizon", "2", lambda: MASK.within(2)),
    ("reaction_horizon", "3.5", lambda: MaskConfig(reaction_horizon=3.5)),
    ("threshold", "inf", lambda: MaskConfig(threshold=INF)),
    ("alpha", "nan", lambda: MaskConfig(alpha=NAN)),
    ("statistic", "None", lambda: MaskConfig(statistic=None)),
    ("states_together", "0", lambda: MaskConfig(states_together=0)),
    # nets
    ("channels", "()", lambda: VAEConfig(channels=())),
    ("channels", "[4, 4]", lambda: VAEConfig(channels=[4, 4])),
    ("channels", "4.5", lambda: VAEConfig(channels=(4, 4.5))),
    ("latents", "-2", lambda: VAEConfig(latents=-2)),
    ("decoder", "'linear'", lambda: VAEConfig(decoder="linear")),
    ("width", "0", lambda: VAEConfig(width=0)),
    ("norm", "'layer'", lambda: VAEConfig(norm="layer")),
    ("dtype", "'float64'", lambda: VAEConfig(dtype="float64")),
    ("size", "84 × 86", lambda: vae.init(VAE, KEY, (84, 86))),
    ("width", "0", lambda: NetworkConfig(width=0)),
    ("width", "inf", lambda: NetworkConfig(width=INF)),
    ("stem", "7", lambda: NetworkConfig(stem=7)),
    ("stages", "5", lambda: NetworkConfig(stages=5)),
    ("kind", "'vgg'", lambda: NetworkConfig(kind="vgg")),
    ("motion", "-1.0", lambda: NetworkConfig(motion=-1.0)),
    ("hidden", "[8]", lambda: NetworkConfig(hidden=[8])),
    ("hidden", "0", lambda: NetworkConfig(hidden=(8, 0))),
    # learn
    ("epochs", "inf", lambda: FitConfig(epochs=INF)),
    ("epochs", "1000000000.0", lambda: FitConfig(epochs=1e9).total_steps(64 * 1000)),
    ("steps", "0", lambda: FitConfig(steps=0)),
    ("steps", "1.5", lambda: FitConfig(steps=1.5)),
    ("steps", str(2**31), lambda: FitConfig(steps=2**31)),
    ("batch_size", "2.5", lambda: FitConfig(batch_size=2.5)),
    ("batch_size", "64", lambda: FitConfig(steps=3).total_steps(63)),
    ("samples", "0", lambda: FitConfig().total_steps(0)),
    ("learning_rate", "nan", lambda: FitConfig(learning_rate=NAN)),
    ("learning_rate", "0", lambda: FitConfig(learning_rate=0)),
    ("decay", "'fast'", lambda: FitConfig(decay="fast")),
    ("weight_decay", "-1", lambda: FitConfig(weight_decay=-1)),
    ("chunk", "None", lambda: FitConfig(chunk=None)),
    ("frames", "0", lambda: CloneConfig(frames=0)),
    ("frames", "5", lambda: CloneConfig(frames=5)),
    ("frames", "2.0", lambda: CloneConfig(frames=2.0)),
    ("trajectory_steps", "0", lambda: CloneConfig(trajectory_steps=0)),
    ("huber", "inf", lambda: CloneConfig(huber=INF)),
    ("huber", "-0.1", lambda: CloneConfig(huber=-0.1)),
    ("network", "VAEConfig", lambda: CloneConfig(network=VAE)),
    ("objective", "'G'", lambda: DisentangleConfig(objective="G")),
    ("beta", "-0.5", lambda: DisentangleConfig(beta=-0.5)),
    ("capacity", "nan", lambda: DisentangleConfig(capacity=NAN)),
    ("capacity_steps", "0", lambda: DisentangleConfig(capacity_steps=0)),
    ("network", "NetworkConfig", lambda: DisentangleConfig(network=RESNET)),
    ("start_components", "2", lambda: DisentangleConfig(start_components=2)),
    ("patches", "64", lambda: DisentangleConfig(patches=64)),
    ("among", "9", lambda: linear_start(jnp.zeros((8, 100)), 9, KEY)),
    # the three steps, and all of them; `Demos` has a table of its own in test_demos.py
    ("images", "float64", lambda: learn_latents(FRAMES / 255, FRAMES, KEY)),
    ("images", "shape (16, 24, 3)", lambda: learn_latents(FRAMES[0], FRAMES, KEY)),
    ("held_out", "shape (20, 16, 22, 3)", lambda: learn_latents(FRAMES, FRAMES[:, :, 1:-1], KEY)),
    ("held_out", "shape (0, 16, 24, 3)", lambda: learn_latents(FRAMES, FRAMES[:0], KEY)),
    ("key", "0", lambda: learn_latents(FRAMES, FRAMES, 0)),
    ("config", "CloneConfig", lambda: learn_latents(FRAMES, FRAMES, KEY, CLONE)),
    ("size", "16 × 24", lambda: learn_latents(FRAMES, FRAMES, KEY)),
    ("batch_size", "21", lambda: learn_latents(FRAMES, FRAMES, KEY, replace(LEARN, batch_size=21))),
    ("encoder", "None", lambda: mask_latents(None, DEMOS)),
    ("demos", "array", lambda: mask_latents(ENCODER, DEMOS.images)),
    ("config", "0.001", lambda: mask_latents(ENCODER, DEMOS, 1e-3)),
    ("reaction_horizon", "4", lambda: mask_latents(ENCODER, DEMOS, MaskConfig(4))),
    ("reaction_horizon", "2", lambda: mask_latents(ENCODER, ragged(), MaskConfig(2))),
    ("episodes in demos", "4", lambda: mask_latents(ENCODER, episodes(4))),
    ("images", "32 × 24", lambda: mask_latents(ENCODER, OTHER_SIZE)),
    ("mask", "bool of shape (2,)", lambda: find_region(ENCODER, NONE[:2], FRAMES, KEY)),
    ("images", "float64", lambda: find_region(ENCODER, NONE, FRAMES / 255, KEY)),
    ("images", "32 × 24", lambda: find_region(ENCODER, NONE, OTHER_SIZE.images[:, 0], KEY)),
    ("region", "shape (3,)", lambda: clone("BcVanilla", DEMOS, Evidence(region=NONE))),
    ("methods", "'Bc'", lambda: clone("Bc", DEMOS, Evidence())),
    ("methods", "['BcVanilla']", lambda: clone(["BcVanilla"], DEMOS, Evidence())),
    ("methods", "'BcManual'", lambda: clone("BcManual", DEMOS, Evidence(ENCODER))),
    ("methods", "'Masked'", lambda: clone("Masked", DEMOS, Evidence(ENCODER))),
    ("demos", "None", lambda: clone("BcVanilla", None, Evidence())),
    ("evidence", "None", lambda: clone("BcVanilla", DEMOS, None)),
    ("images", "32 × 24", lambda: clone("Reconstructed", OTHER_SIZE, Evidence(ENCODER))),
    ("mask", "bool of shape (2,)", lambda: clone("Masked", DEMOS, masked(np.zeros(2, bool)))),
    ("mask", "int64", lambda: clone("Masked", DEMOS, masked([0, 1, 1]))),
    ("key", "1", lambda: clone("BcVanilla", DEMOS, Evidence(), key=1)),
    ("config", "DisentangleConfig", lambda: clone("BcVanilla", DEMOS, Evidence(), config=LEARN)),
    ("demos", "None", lambda: whole(demos=None)),
    ("exploration", "shape (20, 16, 22, 3)", lambda: whole(exploration=FRAMES[:, :, 1:-1])),
    ("held_out", "shape (0, 16, 24, 3)", lambda: whole(exploration=FRAMES[:9])),
    ("key", "None", lambda: whole(key=None)),
    ("methods", "'BcManual'", lambda: whole(methods=METHODS)),
    ("evidence", "array", lambda: whole(known=OBSERVATIONS)),
    ("config", "CloneConfig", lambda: whole(disentangle=CLONE)),
    ("config", "array", lambda: whole(mask=np.zeros(3, bool))),
    ("config", "DisentangleConfig", lambda: whole(clone=LEARN)),
    ("batch_size", "22", lambda: whole(clone=replace(CLONE, batch_size=22))),
    # evaluate and leakage
    ("rollouts", "0", lambda: EvaluateConfig(rollouts=0)),
    ("every", "nan", lambda: EvaluateConfig(every=NAN)),
    ("initial_states", "nan at [2, 1]", lambda: drive(WRONG_STATES)),
    ("initial_states", "shape (6, 3)", lambda: drive(STATES[:, :3])),
    ("key", "7", lambda: evaluate.drive(SYSTEM, POLICY, STATES, 7)),
    ("system", "'cartpole'", lambda: evaluate.drive("cartpole", POLICY, STATES, KEY)),
    ("policy", "NetworkConfig", lambda: evaluate.drive(SYSTEM, RESNET, STATES, KEY)),
    ("system", "None", lambda: evaluate.rollout_loss(None, TRAJECTORIES)),
    ("trajectories", "array", lambda: evaluate.rollout_loss(SYSTEM, STATES)),
    ("valid", "shape (6,)", lambda: evaluate.outcome(SYSTEM, moved(valid=np.ones(6, bool)))),
    ("trajectories", "1", lambda: evaluate.copycat(SYSTEM, POLICY, short(), KEY)),
    ("trajectories", "None", lambda: evaluate.copycat(SYSTEM, POLICY, None, KEY)),
    ("policy", "function", lambda: evaluate.copycat(SYSTEM, loss, TRAJECTORIES, KEY)),
    ("system", "'cartpole'", lambda: evaluate.copycat("cartpole", POLICY, TRAJECTORIES, KEY)),
    ("key", "int32", lambda: evaluate.copycat(SYSTEM, POLICY, TRAJECTORIES, jnp.int32(3))),
    ("signal", "(6,)", lambda: leaked(signal=np.ones(6))),
    ("signal", "nan at [0, 0]", lambda: leaked(signal=np.full((6, 1), NAN))),
    ("frames in images", "1", lambda: leaked(images=IMAGES[:1])),
    ("key", "1", lambda: leaked(key=1)),
    # the whole run's config, and what it asks of a system
    ("random_trajectories", "0", lambda: CollectConfig(random_trajectories=0)),
    ("held_out_trajectories", "2.0", lambda: CollectConfig(held_out_trajectories=2.0)),
    ("random_steps", "0", lambda: CollectConfig(random_steps=0)),
    ("expert_trajectories", "4", lambda: CollectConfig(expert_trajectories=4)),
    ("size", "64", lambda: CollectConfig(size=64)),
    ("size", "(64, 64, 3)", lambda: CollectConfig(size=(64, 64, 3))),
    ("size", "0", lambda: CollectConfig(size=(64, 0))),
    ("seed", "-1", lambda: Config(seed=-1)),
    ("seed", str(2**32), lambda: Config(seed=2**32)),
    ("seed", "0.0", lambda: Config(seed=0.0)),
    ("methods", "'Best'", lambda: Config(methods=("Masked", "Best"))),
    ("methods", "Masked Masked", lambda: Config(methods=("Masked", "Masked"))),
    ("system", "'cartpole'", lambda: fitting(Config(), "cartpole")),
    ("size", "64 × 60", lambda: configured(Config(collect=CollectConfig(size=(64, 60))))),
    ("reaction_horizon", "101", lambda: configured(Config(mask=MaskConfig(101)))),
    ("batch_size", "256", lambda: configured(Config(clone=ONE_STEP, collect=FEW))),
    ("patches", "1025", lambda: configured(Config(disentangle=PATCHES))),
    ("draw", "[64, 64]", lambda: fitting(Config(), replace(SYSTEM, draw=grey))),
    ("methods", "'BcManual'", lambda: fitting(Config(), replace(SYSTEM, nuisance=Bare()))),
]
FEW, ONE_STEP = CollectConfig(expert_trajectories=20), CloneConfig(trajectory_steps=1)
PATCHES = DisentangleConfig(patches=1025, network=VAEConfig(decoder="coordinates"))


class Measured:
    """Numbers with a unit, which `__array__` would drop."""

    def __init__(self, name):
        setattr(self, name, "cm")

    def __array__(self, dtype=None, copy=None):
        return SAMPLES


def moved(**changed):
    return TRAJECTORIES._replace(**changed)


def short():
    return jax.tree.map(lambda a: a[:, :1], TRAJECTORIES)


def few(count):
    return STATES[:count], OBSERVATIONS[:count], ACTIONS[:count]


def drive(states):
    return evaluate.drive(SYSTEM, POLICY, states, KEY)


def episodes(count):
    return Demos(DEMOS.images[:count], DEMOS.actions[:count], DEMOS.initial_states[:count])


def ragged():
    return replace(DEMOS, valid=np.arange(3) < np.array([3, 2, 1, 3, 3, 3, 3])[:, None])


def masked(mask):
    return Evidence(ENCODER, mask)


def grey(state, size):
    return jnp.zeros(size)


class Bare:
    """A nuisance that nobody knows how to cover."""

    def draw(self, image, signal):
        return image


def leaked(**changed):
    return leakage.leaked(**{"images": IMAGES, "signal": np.ones((6, 1)), "key": KEY, **changed})


@pytest.mark.parametrize(
    ("argument", "shown", "call"), BAD, ids=[f"{i}-{row[0]}" for i, row in enumerate(BAD)]
)
def test_a_wrong_argument_is_named_in_one_line(argument, shown, call):
    with pytest.raises(ValueError, match=rf"^{argument}: expected .*got ") as error:
        call()
    assert shown in str(error.value)
    assert "\n" not in str(error.value)


def test_lists_and_large_counts_are_ordinary_arguments():
    np.testing.assert_array_equal(hoeffding_d(SAMPLES.tolist(), SAMPLES), 1.0)
    assert permutation_p_value(SAMPLES.tolist(), SAMPLES.tolist(), KEY, 1).shape == ()
    lists = (v.tolist() for v in (STATES, OBSERVATIONS, ACTIONS))
    np.testing.assert_array_equal(
        find_mask(*lists).mask, find_mask(STATES, OBSERVATIONS, ACTIONS).mask
    )
    p = p_value([1e-9, 1e-9], [2**33, 2**33 - 1000])
    np.testing.assert_allclose(p, p_value(1e-9 * 2**33 / 1000, 1001), rtol=1e-3)
