"""The β-VAE's losses against NumPy, and its linear start on real frames."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.leakage import spearman
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.disentangle import M_N, DisentangleConfig
from jaxdeconf.nets import vae
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.systems.rollout import frames

SYSTEM = systems.get("cartpole")
SMALL = VAEConfig(channels=(4, 4, 4, 4, 4), latents=4, linear_path=True)


@pytest.fixture(scope="module")
def random_frames():
    trajectories = systems.random_trajectories(SYSTEM, jax.random.key(0), 120)
    valid = jax.tree.map(lambda a: a[trajectories.valid], trajectories)
    return jax.jit(lambda t: frames(SYSTEM, t))(valid), valid.previous_actions


def test_kl_divergence_is_that_of_two_normals():
    mean, log_variance = jnp.array([[0.7, -1.0]]), jnp.array([[0.3, -2.0]])
    x = np.linspace(-12, 12, 200_001)
    for i in range(2):
        m, v = float(mean[0, i]), float(np.exp(log_variance[0, i]))
        p = np.exp(-((x - m) ** 2) / (2 * v)) / np.sqrt(2 * np.pi * v)
        log_ratio = -((x - m) ** 2) / (2 * v) - 0.5 * np.log(v) + x**2 / 2
        expected = np.sum(p * log_ratio) * (x[1] - x[0])
        assert disentangle.kl_divergence(mean, log_variance)[0, i] == pytest.approx(
            expected, rel=1e-4
        )


@pytest.mark.parametrize("objective", ["H", "B"])
def test_losses_are_those_of_the_cited_code(random_frames, objective):
    images = random_frames[0][:8]
    config = DisentangleConfig(
        objective=objective, beta=7.0, capacity=25.0, capacity_steps=100, network=SMALL
    )
    variables = disentangle.initial_state(config, random_frames[0], jax.random.key(1)).variables
    key, step = jax.random.key(2), jnp.int32(40)
    loss, (_, metrics) = disentangle.objective(config)(variables, images, jnp.arange(8), key, step)
    x = np.asarray(images, np.float64) / 255
    mean, log_variance, stats = vae.encode(
        SMALL, variables, jnp.asarray(x, jnp.float32), train=True
    )
    z = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
    decoded, _ = vae.decode(SMALL, {**variables, "batch_stats": stats}, z, train=True)
    error = np.mean(((2 * np.asarray(decoded) - 1) - (2 * x - 1)) ** 2)
    divergence = np.asarray(disentangle.kl_divergence(mean, log_variance)).sum(1).mean()
    penalty = divergence if objective == "H" else abs(divergence - 25.0 * 0.4)
    assert loss == pytest.approx(error + 7.0 * M_N * penalty, rel=1e-4)
    assert metrics["kl"] == pytest.approx(divergence, rel=1e-4)


def test_the_linear_start_finds_the_nuisance_without_being_told(random_frames):
    images, actions = random_frames
    config = DisentangleConfig(network=SMALL)
    state = disentangle.initial_state(config, images, jax.random.key(3))
    mean, _ = disentangle.encode(SMALL, state.variables, images)
    correlation = np.sort(np.abs(spearman(mean, actions)[:, 0]))
    assert correlation[-1] > 0.98
    assert (correlation[:-1] < 0.15).all()


def test_encoding_in_batches_is_encoding_at_once(random_frames):
    images = random_frames[0][:300]
    variables = disentangle.initial_state(
        DisentangleConfig(network=SMALL), images, jax.random.key(4)
    ).variables
    mean, log_variance = disentangle.encode(SMALL, variables, images)
    whole = vae.encode(SMALL, variables, images.astype(jnp.float32) / 255, train=False)
    np.testing.assert_allclose(mean, whole[0], atol=1e-4)
    np.testing.assert_allclose(log_variance, whole[1], atol=1e-4)


def test_training_lowers_the_loss_and_compiles_once(random_frames):
    images, _ = random_frames
    config = DisentangleConfig(
        epochs=3, learning_rate=1e-3, objective="H", beta=5.0, chunk=8, network=SMALL
    )
    state = disentangle.initial_state(config, images, jax.random.key(5))
    chunks = disentangle.disentangle(config, state, images, jax.random.key(6))
    losses = [float(metrics["loss"]) for _, metrics in chunks]
    assert losses[-1] < 0.8 * losses[0]


@pytest.mark.parametrize(("field", "value"), [("objective", "C"), ("beta", -1.0)])
def test_a_bad_config_names_the_field_and_the_value(field, value):
    with pytest.raises(ValueError, match=rf"{field}: expected .*{value}"):
        DisentangleConfig(**{field: value})


def test_some_patches_train_the_coordinate_decoder():
    network = VAEConfig(channels=(4, 4), latents=2, image_size=16, decoder="coordinates", width=8)
    config = DisentangleConfig(epochs=2, batch_size=8, patches=16, network=network, objective="H")
    images = (jax.random.uniform(jax.random.key(0), (32, 16, 16, 3)) * 255).astype(jnp.uint8)
    state = disentangle.initial_state(config, images, jax.random.key(1))
    before = jax.tree.map(np.asarray, state.variables["params"])
    chunks = list(disentangle.disentangle(config, state, images, jax.random.key(2)))
    assert np.isfinite([float(metrics["reconstruction"]) for _, metrics in chunks]).all()
    after = chunks[-1][0].variables["params"]
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), before, after)
    assert all(jax.tree.leaves(moved))
