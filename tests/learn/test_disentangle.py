"""The β-VAE's losses against NumPy, and its linear start on real frames."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.leakage import spearman
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.disentangle import ACTIVE_KL, M_N, DisentangleConfig, Encoder
from jaxdeconf.learn.fit import start
from jaxdeconf.nets import vae
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.systems.rollout import frames

SIZE = (32, 32)
SYSTEM = replace(systems.get("cartpole"), size=SIZE)
SMALL = VAEConfig(channels=(4,), latents=4, linear_path=True)


@pytest.fixture(scope="module")
def random_frames():
    trajectories = systems.random_trajectories(SYSTEM, jax.random.key(0), 120)
    valid = jax.tree.map(lambda a: a[trajectories.valid], trajectories)
    return jax.jit(lambda t: frames(SYSTEM, t))(valid), valid.previous_actions


@pytest.fixture(scope="module")
def begun(random_frames):
    """Variables of a linear start."""
    config = DisentangleConfig(network=SMALL)
    return disentangle.initial_state(config, random_frames[0], jax.random.key(3)).variables


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
def test_losses_are_those_of_the_cited_code(random_frames, begun, objective):
    images = random_frames[0][:8]
    config = DisentangleConfig(
        objective=objective, beta=7.0, capacity=25.0, capacity_steps=100, network=SMALL
    )
    key, step, variables = jax.random.key(2), jnp.int32(40), begun
    objective_of = jax.jit(disentangle.objective(config))
    loss, (_, metrics) = objective_of(variables, images, jnp.arange(8), key, step)
    x = np.asarray(images, np.float64) / 255
    mean, log_variance, stats = vae.encode(
        SMALL, variables, jnp.asarray(x, jnp.float32), train=True
    )
    z = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
    again = {**variables, "batch_stats": stats}
    decoded, _ = vae.decode(SMALL, again, z, SIZE, train=True)
    error = np.mean(((2 * np.asarray(decoded) - 1) - (2 * x - 1)) ** 2)
    divergence = np.asarray(disentangle.kl_divergence(mean, log_variance)).sum(1).mean()
    penalty = divergence if objective == "H" else abs(divergence - 25.0 * 0.4)
    assert loss == pytest.approx(error + 7.0 * M_N * penalty, rel=1e-4)
    assert metrics["kl"] == pytest.approx(divergence, rel=1e-4)


def test_the_linear_start_finds_the_nuisance_without_being_told(random_frames, begun):
    images, actions = random_frames
    mean, _ = disentangle.encode(SMALL, begun, images)
    correlation = np.sort(np.abs(spearman(mean, actions)[:, 0]))
    assert correlation[-1] > 0.98
    assert (correlation[:-1] < 0.15).all()


def test_encoding_in_batches_is_encoding_at_once(random_frames, begun):
    images = random_frames[0][:300]
    mean, log_variance = disentangle.encode(SMALL, begun, images)
    whole = vae.encode(SMALL, begun, images.astype(jnp.float32) / 255, train=False)
    np.testing.assert_allclose(mean, whole[0], atol=1e-4)
    np.testing.assert_allclose(log_variance, whole[1], atol=1e-4)


def test_training_lowers_the_loss_and_finds_the_active_latents(random_frames):
    images, held_out = random_frames[0][300:], random_frames[0][:300]
    config = DisentangleConfig(steps=60, objective="H", beta=5.0, chunk=8, network=SMALL)
    training = disentangle.training(
        config, lambda: images, len(images), lambda: held_out, jax.random.key(5)
    )
    chunks = list(training.chunks("disentangle"))
    losses = [metrics["loss"] for _, metrics in chunks]
    assert losses[-1] < 0.8 * losses[0]
    state, _ = chunks[-1]
    encoder = training.trained(state)
    mean, log_variance, _ = vae.encode(SMALL, state.variables, held_out / 255.0, train=False)
    mean, log_variance = np.asarray(mean), np.asarray(log_variance)
    kl = (0.5 * (mean**2 + np.exp(log_variance) - log_variance - 1)).mean(axis=0)
    assert encoder.network == SMALL
    np.testing.assert_allclose(encoder.kl, kl, rtol=1e-3)
    np.testing.assert_array_equal(encoder.active, kl > ACTIVE_KL)


def test_latents_that_carry_nothing_are_not_active():
    """A latent whose posterior is always N(m, 1) has a KL divergence of m² / 2."""
    images, network = jnp.zeros((20, 8, 12, 3), jnp.uint8), VAEConfig((2,), 3, norm="none")
    config, key = DisentangleConfig(network=network), jax.random.key(0)
    training = disentangle.training(config, lambda: images, 20, lambda: images[:10], key)
    variables = jax.tree.map(jnp.zeros_like, training.start(images).variables)
    variables["params"]["encoder"]["mean"]["bias"] = jnp.array([0.0, 0.4, -0.5])
    encoder = training.trained(start(variables))
    np.testing.assert_allclose(encoder.kl, [0.0, 0.08, 0.125], atol=1e-6)
    assert encoder.active.tolist() == [False, False, True]


def test_the_size_is_that_of_the_images():
    size = (8, 12)
    network = VAEConfig(channels=(2, 2), latents=3, norm="none")
    config = DisentangleConfig(network=network)
    images = (jax.random.uniform(jax.random.key(0), (30, *size, 3)) * 255).astype(jnp.uint8)
    disentangle.check_size(config, size)
    variables = disentangle.initial_state(config, images, jax.random.key(1)).variables
    mean, log_variance = disentangle.encode(network, variables, images)
    assert mean.shape == log_variance.shape == (30, 3)
    encoder = Encoder(network, variables, mean[0], mean[0] > 0)
    disentangle.check_images(encoder, size)
    words = r"images: expected the size that the encoder learnt, got 12 × 12"
    with pytest.raises(ValueError, match=words):
        disentangle.check_images(encoder, (12, 12))


def test_sizes_and_patches_that_do_not_fit_are_refused():
    config = DisentangleConfig(network=SMALL)
    with pytest.raises(ValueError, match=r"size: expected multiples of 2 .*, got 15 × 22"):
        disentangle.check_size(config, (15, 22))
    network = VAEConfig(decoder="coordinates")
    config = DisentangleConfig(network=network, patches=97)
    disentangle.check_size(config, (18, 24))
    with pytest.raises(ValueError, match="patches: expected an integer <= 96, got 97"):
        disentangle.check_size(config, (16, 24))


def test_some_patches_give_every_weight_a_gradient():
    network = VAEConfig(channels=(4,), latents=2, decoder="coordinates", width=8, norm="none")
    config = DisentangleConfig(patches=16, network=network, objective="H")
    images = (jax.random.uniform(jax.random.key(0), (8, 12, 16, 3)) * 255).astype(jnp.uint8)
    variables = disentangle.initial_state(config, images, jax.random.key(1)).variables

    @jax.jit
    def gradient(params, key):
        def loss(params):
            step = jnp.int32(0)
            given = {**variables, "params": params}
            return disentangle.objective(config)(given, images, jnp.arange(8), key, step)[0]

        return jax.grad(loss)(params)

    first, second = (gradient(variables["params"], jax.random.key(i)) for i in (2, 3))
    assert all(jnp.isfinite(leaf).all() and (leaf != 0).any() for leaf in jax.tree.leaves(first))
    # Others are drawn at every step.
    assert not jax.tree.all(jax.tree.map(jnp.allclose, first["decoder"], second["decoder"]))
