"""Wrong arguments of every public function: one line that names the argument and what came.

A row is (the argument's name, how the message shows what came, the call).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import evaluate, expert, leakage, systems
from jaxdeconf.evaluate import EvaluateConfig
from jaxdeconf.expert import ExpertConfig, expert_trajectories, plan
from jaxdeconf.independence import hoeffding_d, p_value, permutation_p_value, threshold
from jaxdeconf.learn import clone, disentangle, views
from jaxdeconf.learn.clone import CloneConfig, Demonstrations
from jaxdeconf.learn.disentangle import DisentangleConfig
from jaxdeconf.learn.fit import FitConfig, fit, start
from jaxdeconf.learn.linear_start import linear_start
from jaxdeconf.mask import find_mask
from jaxdeconf.nets import resnet, vae
from jaxdeconf.nets.resnet import ResNetConfig
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.pipeline.config import CollectConfig, Config, MaskConfig
from jaxdeconf.systems.rollout import Trajectories, frames, random_trajectories, rollout
from jaxdeconf.vision import raster
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
    np.zeros((6, 2, 4)), np.zeros((6, 2, 1)), np.zeros((6, 2, 1)), np.ones((6, 2), bool)
)
DEMONSTRATIONS = Demonstrations(IMAGES, np.zeros(6, bool), np.zeros((6, 1), np.float32))
STATE = start({"params": {"w": jnp.zeros(2)}, "batch_stats": {}})
VAE, RESNET = VAEConfig(channels=(4, 4)), ResNetConfig(width=4)
VAE_VARIABLES = {"params": {}, "batch_stats": {}}  # never looked at: the images are checked first
RESNET_VARIABLES = {"params": {"stem": {"kernel": np.zeros((3, 3, 6, 4))}}, "batch_stats": {}}
WEIGHTS = evaluate.Weights(RESNET_VARIABLES, {})
DRIVER = evaluate.Driver(RESNET, views.identity)


def loss(*_):
    raise AssertionError("reached")


train = partial(fit, loss, STATE, SAMPLES, 8, KEY, FitConfig(batch_size=4))
cloning = partial(clone.clone, CloneConfig(batch_size=4), STATE)


def without(**changed):
    return DEMONSTRATIONS._replace(**changed)


BAD = [
    # systems
    ("name", "'pendulum'", lambda: systems.get("pendulum")),
    ("name", "None", lambda: systems.get(None)),
    ("name", "['cartpole']", lambda: systems.get(["cartpole"])),
    ("system", "'cartpole'", lambda: random_trajectories("cartpole", KEY, 3)),
    ("count", "0", lambda: random_trajectories(SYSTEM, KEY, 0)),
    ("count", "2.5", lambda: random_trajectories(SYSTEM, KEY, 2.5)),
    ("key", "int32 of shape ()", lambda: random_trajectories(SYSTEM, 7, 3)),
    ("key", "of shape (2,)", lambda: random_trajectories(SYSTEM, jax.random.split(KEY), 3)),
    ("state", "shape (3,)", lambda: rollout(SYSTEM, loss, None, np.zeros(3), KEY)),
    ("state", "int", lambda: rollout(SYSTEM, loss, None, np.zeros(4, int), KEY)),
    ("system", "None", lambda: rollout(None, loss, None, np.zeros(4), KEY)),
    ("states", "shape (6, 2, 5)", lambda: frames(SYSTEM, moved(states=np.zeros((6, 2, 5))))),
    (
        "previous_actions",
        "shape (6, 3, 1)",
        lambda: frames(SYSTEM, moved(previous_actions=np.zeros((6, 3, 1)))),
    ),
    # vision
    ("size", "0", lambda: raster.pixel_centers(0)),
    ("size", "64.0", lambda: raster.pixel_centers(64.0)),
    ("image", "float64", lambda: raster.dequantize(np.zeros((2, 2, 3)))),
    ("image", "uint8", lambda: raster.quantize(IMAGES)),
    ("image", "shape (4, 4)", lambda: raster.paint(np.zeros((4, 4)), np.zeros((4, 4)), (0, 0, 0))),
    ("distance", "shape (5, 4)", lambda: raster.paint(image(4), np.zeros((5, 4)), (0, 0, 0))),
    ("color", "shape (4,)", lambda: raster.paint(image(4), np.zeros((4, 4)), (0, 0, 0, 1))),
    ("size", "nan", lambda: ColorSquare(size=NAN)),
    ("size", "-1", lambda: ColorSquare(size=-1)),
    ("corner", "shape (3,)", lambda: ColorSquare(corner=(0.0, 0.0, 0.0))),
    ("low", "nan", lambda: ColorSquare(low=(0.0, NAN, 0.0))),
    ("signal", "shape ()", lambda: ColorSquare().draw(image(64), np.float32(0.5))),
    # expert
    ("initial_states", "nan at [2, 1]", lambda: plan(SYSTEM, WRONG_STATES)),
    ("initial_states", "shape (0, 4)", lambda: plan(SYSTEM, np.zeros((0, 4)))),
    ("initial_states", "complex64", lambda: plan(SYSTEM, STATES + 1j)),
    ("horizon", "-1", lambda: plan(SYSTEM, STATES, -1)),
    ("horizon", "True", lambda: plan(SYSTEM, STATES, True)),
    ("horizon", str(10**30), lambda: plan(SYSTEM, STATES, 10**30)),
    ("system", "'cartpole'", lambda: plan("cartpole", STATES)),
    ("config", "30", lambda: plan(SYSTEM, STATES, 30, 30)),
    ("key", "0", lambda: expert_trajectories(SYSTEM, STATES, 0)),
    ("config", "FitConfig", lambda: expert_trajectories(SYSTEM, STATES, KEY, FitConfig())),
    ("config", "None", lambda: expert.receding_horizon(SYSTEM, None)),
    ("horizon", "1.5", lambda: ExpertConfig(horizon=1.5)),
    ("initial_iterations", "nan", lambda: ExpertConfig(initial_iterations=NAN)),
    ("step_iterations", "'two'", lambda: ExpertConfig(step_iterations="two")),
    ("tolerance", "inf", lambda: ExpertConfig(tolerance=INF)),
    ("least_cost", "0.0", lambda: ExpertConfig(least_cost=0.0)),
    # independence
    ("x", "4", lambda: hoeffding_d(SAMPLES[:4], SAMPLES[:4])),
    ("x", "0", lambda: hoeffding_d([], [])),
    ("y", "7", lambda: hoeffding_d(SAMPLES, SAMPLES[:7])),
    ("x", "1 NaN", lambda: hoeffding_d(np.where(SAMPLES == 3, NAN, SAMPLES), SAMPLES)),
    ("y", "<U1", lambda: hoeffding_d(SAMPLES, list("abcdefgh"))),
    ("d", "int", lambda: p_value(3, 10)),
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
    ("observations", "5", lambda: find_mask(STATES, OBSERVATIONS[1:], ACTIONS)),
    ("actions", "shape (6, 0, 1)", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS[:, :0])),
    ("threshold", "nan", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS, NAN)),
    ("alpha", "0", lambda: find_mask(STATES, OBSERVATIONS, ACTIONS, alpha=0)),
    # nets
    ("channels", "()", lambda: VAEConfig(channels=())),
    ("channels", "[4, 4]", lambda: VAEConfig(channels=[4, 4])),
    ("channels", "4.5", lambda: VAEConfig(channels=(4, 4.5))),
    ("latents", "-2", lambda: VAEConfig(latents=-2)),
    ("image_size", "63", lambda: VAEConfig(image_size=63)),
    ("decoder", "'linear'", lambda: VAEConfig(decoder="linear")),
    ("width", "0", lambda: VAEConfig(width=0)),
    ("norm", "'layer'", lambda: VAEConfig(norm="layer")),
    ("dtype", "'float64'", lambda: VAEConfig(dtype="float64")),
    ("key", "0", lambda: vae.init(VAE, 0)),
    ("config", "None", lambda: vae.init(None, KEY)),
    ("images", "uint8", lambda: vae.encode(VAE, VAE_VARIABLES, IMAGES, train=False)),
    (
        "images",
        "shape (0, 64, 64, 3)",
        lambda: vae.encode(VAE, VAE_VARIABLES, floats(3)[:0], True),
    ),
    ("latents", "(6, 2)", lambda: vae.decode(VAE, VAE_VARIABLES, OBSERVATIONS, train=False)),
    ("width", "0", lambda: ResNetConfig(width=0)),
    ("width", "inf", lambda: ResNetConfig(width=INF)),
    ("stem", "7", lambda: ResNetConfig(stem=7)),
    ("stages", "5", lambda: ResNetConfig(stages=5)),
    ("pool", "'max'", lambda: ResNetConfig(pool="max")),
    ("hidden", "[8]", lambda: ResNetConfig(hidden=[8])),
    ("hidden", "0", lambda: ResNetConfig(hidden=(8, 0))),
    ("input_shape", "(64, 64)", lambda: resnet.init(RESNET, KEY, (64, 64), 1)),
    ("input_shape", "64.0", lambda: resnet.init(RESNET, KEY, (64.0, 64, 6), 1)),
    ("outputs", "0", lambda: resnet.init(RESNET, KEY, (64, 64, 6), 0)),
    ("images", "64, 64, 3", lambda: resnet.apply(RESNET, RESNET_VARIABLES, floats(3), False)),
    # learn
    ("epochs", "inf", lambda: FitConfig(epochs=INF)),
    ("epochs", "1000000000.0", lambda: FitConfig(epochs=1e9).steps(64 * 1000)),
    ("batch_size", "2.5", lambda: FitConfig(batch_size=2.5)),
    ("batch_size", "64", lambda: FitConfig().steps_per_epoch(63)),
    ("samples", "0", lambda: FitConfig().steps(0)),
    ("learning_rate", "nan", lambda: FitConfig(learning_rate=NAN)),
    ("learning_rate", "0", lambda: FitConfig(learning_rate=0)),
    ("decay", "'fast'", lambda: FitConfig(decay="fast")),
    ("chunk", "None", lambda: FitConfig(chunk=None)),
    ("variables", "['w']", lambda: start({"w": jnp.zeros(2)})),
    ("state", "None", lambda: next(fit(loss, None, SAMPLES, 8, KEY, FitConfig(batch_size=4)))),
    ("key", "5", lambda: next(fit(loss, STATE, SAMPLES, 8, 5, FitConfig(batch_size=4)))),
    ("samples", "8.0", lambda: next(fit(loss, STATE, SAMPLES, 8.0, KEY, FitConfig(batch_size=4)))),
    ("trajectory_steps", "0", lambda: CloneConfig(trajectory_steps=0)),
    ("huber", "inf", lambda: CloneConfig(huber=INF)),
    ("network", "VAEConfig", lambda: CloneConfig(network=VAE)),
    ("data", "array", lambda: cloning(IMAGES, KEY, ())),
    ("frames", "float", lambda: cloning(without(frames=IMAGES / 255), KEY, ())),
    ("first", "shape (5,)", lambda: cloning(without(first=np.zeros(5, bool)), KEY, ())),
    ("actions", "shape (6,)", lambda: cloning(without(actions=np.zeros(6)), KEY, ())),
    ("actions", "nan at [0, 0]", lambda: cloning(without(actions=np.full((6, 1), NAN)), KEY, ())),
    ("frame_shape", "64", lambda: clone.initial_state(CloneConfig(), 64, 1, KEY)),
    ("previous", "shape (5, 64, 64, 3)", lambda: clone.stack(IMAGES[:5], IMAGES)),
    (
        "actions",
        "shape (6,)",
        lambda: clone.action_error(CloneConfig(), np.ones((6, 1)), SAMPLES[:6]),
    ),
    ("objective", "'G'", lambda: DisentangleConfig(objective="G")),
    ("beta", "-0.5", lambda: DisentangleConfig(beta=-0.5)),
    ("capacity", "nan", lambda: DisentangleConfig(capacity=NAN)),
    ("capacity_steps", "0", lambda: DisentangleConfig(capacity_steps=0)),
    ("start_components", "2", lambda: DisentangleConfig(start_components=2)),
    ("patches", "64", lambda: DisentangleConfig(patches=64)),
    ("patches", "1025", lambda: DisentangleConfig(patches=1025)),
    ("images", "shape (6, 32, 64, 3)", lambda: begin(IMAGES[:, :32], KEY)),
    ("images", "float64", lambda: begin(IMAGES / 255, KEY)),
    ("key", "None", lambda: begin(IMAGES, None)),
    ("images", "(64, 64, 3)", lambda: disentangle.encode(VAE, VAE_VARIABLES, IMAGES[0])),
    (
        "log_variance",
        "(6, 1)",
        lambda: disentangle.kl_divergence(OBSERVATIONS, OBSERVATIONS[:, :1]),
    ),
    ("count", "9", lambda: linear_start(jnp.zeros((8, 100)), 9, KEY)),
    ("images", "shape (8,)", lambda: linear_start(jnp.zeros(8), 1, KEY)),
    ("nuisance", "None", lambda: views.covered(None)),
    ("config", "ResNetConfig", lambda: views.reconstructed(RESNET)),
    # evaluate and leakage
    ("rollouts", "0", lambda: EvaluateConfig(rollouts=0)),
    ("every", "nan", lambda: EvaluateConfig(every=NAN)),
    ("total", "0", lambda: EvaluateConfig().steps(10, 0)),
    ("initial_states", "nan at [2, 1]", lambda: drive(WRONG_STATES)),
    ("initial_states", "shape (6, 3)", lambda: drive(STATES[:, :3])),
    ("weights", "None", lambda: evaluate.drive(SYSTEM, DRIVER, None, STATES, KEY)),
    ("driver", "ResNetConfig", lambda: evaluate.drive(SYSTEM, RESNET, WEIGHTS, STATES, KEY)),
    ("trajectories", "array", lambda: evaluate.rollout_loss(SYSTEM, STATES)),
    ("valid", "shape (6,)", lambda: evaluate.outcome(SYSTEM, moved(valid=np.ones(6, bool)))),
    ("trajectories", "1", lambda: evaluate.copycat(SYSTEM, DRIVER, WEIGHTS, short(), KEY)),
    ("signal", "shape (5, 1)", lambda: leakage.spearman(OBSERVATIONS, np.ones((5, 1)))),
    ("latents", "shape (5, 1)", lambda: leakage.explained(OBSERVATIONS, np.ones((5, 1)), KEY)),
    ("rows of signal", "3", lambda: leakage.explained(OBSERVATIONS[:3], OBSERVATIONS[:3], KEY)),
    ("latents", "nan", lambda: leakage.spearman(OBSERVATIONS * NAN, OBSERVATIONS)),
    ("train_signal", "(6,)", lambda: r_squared(train_signal=np.ones(6))),
    ("test_signal", "nan at [0, 0]", lambda: r_squared(test_signal=np.full((6, 1), NAN))),
    ("test", "shape (6, 32, 64, 3)", lambda: r_squared(test=IMAGES[:, :32])),
    ("frames in train", "1", lambda: r_squared(train=IMAGES[:1])),
    ("key", "1", lambda: r_squared(key=1)),
    # the whole run's config
    ("random_trajectories", "0", lambda: CollectConfig(random_trajectories=0)),
    ("held_out_trajectories", "2.0", lambda: CollectConfig(held_out_trajectories=2.0)),
    ("random_steps", "0", lambda: CollectConfig(random_steps=0)),
    ("expert_trajectories", "4", lambda: CollectConfig(expert_trajectories=4)),
    ("reaction_horizon", "3.5", lambda: MaskConfig(reaction_horizon=3.5)),
    ("threshold", "inf", lambda: MaskConfig(threshold=INF)),
    ("alpha", "nan", lambda: MaskConfig(alpha=NAN)),
    ("system", "'pendulum'", lambda: Config(system="pendulum")),
    ("seed", "-1", lambda: Config(seed=-1)),
    ("seed", str(2**32), lambda: Config(seed=2**32)),
    ("seed", "0.0", lambda: Config(seed=0.0)),
    ("reaction_horizon", "101", lambda: Config(mask=MaskConfig(reaction_horizon=101))),
    ("batch_size", "256", lambda: Config(bc=CloneConfig(trajectory_steps=1), collect=FEW)),
]
FEW = CollectConfig(expert_trajectories=20)


def moved(**changed):
    return TRAJECTORIES._replace(**changed)


def short():
    return jax.tree.map(lambda a: a[:, :1], TRAJECTORIES)


def image(side):
    return np.zeros((side, side, 3), np.float32)


def floats(channels):
    return np.zeros((6, 64, 64, channels), np.float32)


def few(count):
    return STATES[:count], OBSERVATIONS[:count], ACTIONS[:count]


def begin(images, key):
    return disentangle.initial_state(DisentangleConfig(network=VAE), images, key)


def drive(states):
    return evaluate.drive(SYSTEM, DRIVER, WEIGHTS, states, KEY)


def r_squared(**changed):
    arguments = {
        "train": IMAGES,
        "train_signal": np.ones((6, 1)),
        "test": IMAGES,
        "test_signal": np.ones((6, 1)),
        "key": KEY,
    }
    return leakage.r_squared(**{**arguments, **changed})


@pytest.mark.parametrize(
    ("argument", "shown", "call"), BAD, ids=[f"{i}-{row[0]}" for i, row in enumerate(BAD)]
)
def test_a_wrong_argument_is_named_in_one_line(argument, shown, call):
    with pytest.raises(ValueError, match=rf"^{argument}: expected .*got ") as error:
        call()
    assert shown in str(error.value)
    assert "\n" not in str(error.value)


def test_the_table_is_long_and_says_nothing_twice():
    assert len(BAD) >= 60
    assert len({(name, shown) for name, shown, _ in BAD}) > 100
