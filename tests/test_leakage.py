"""Leakage and rank correlation against signals that are there, hidden, or absent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.leakage import explained, leaked, spearman

N = 500


def scene(key, size=12):
    """Images of a blob at a random place, and an independent signal in [-1, 1]."""
    place_key, signal_key = jax.random.split(key)
    place = jax.random.uniform(place_key, (2 * N, 1, 1), minval=3, maxval=9)
    signal = jax.random.uniform(signal_key, (2 * N, 1), minval=-1)
    y, x = jnp.mgrid[:size, :size]
    return jnp.exp(-((x - place) ** 2 + (y - 6) ** 2) / 4), signal


def leak(images, signal):
    return float(leaked(images, signal, jax.random.key(1)))


def test_nothing_leaks_from_a_scene_without_the_signal():
    images, signal = scene(jax.random.key(0))
    assert leak(images, signal) == pytest.approx(0.0, abs=0.03)


def test_a_mark_leaks_all():
    images, signal = scene(jax.random.key(0))
    assert leak(images.at[:, 0, 0].set(signal[:, 0]), signal) > 0.99


def test_a_folded_mark_leaks_though_no_correlation_sees_it():
    images, signal = scene(jax.random.key(0))
    angle = 0.8 * jnp.pi * signal[:, 0]
    marked = images.at[:, 0, 0].set(jnp.sin(angle)).at[:, 0, 1].set(jnp.cos(angle))
    assert abs(spearman(marked[:, 0, 1][:, None], signal)[0, 0]) < 0.1
    assert leak(marked, signal) > 0.9


def test_a_mark_that_shows_how_large_the_signal_is_leaks_its_square():
    images, signal = scene(jax.random.key(0))
    marked = images.at[:, 0, 0].set(jnp.abs(signal[:, 0]))
    assert explained(marked, signal, jax.random.key(1))[0] < 0.03
    assert leak(marked, signal) > 0.9


def test_half_the_signal_leaks_half_its_variance():
    images, signal = scene(jax.random.key(0))
    _, noise = scene(jax.random.key(9))
    marked = images.at[:, 0, 0].set((signal + noise)[:, 0])
    assert leak(marked, signal) == pytest.approx(0.5, abs=0.1)


def test_spearman_is_pearson_of_ranks():
    latents = jax.random.normal(jax.random.key(2), (300, 3)).at[:, 2].set(0.7)
    signal = jnp.exp(latents[:, :1]) + 0.5 * jax.random.normal(jax.random.key(3), (300, 1))
    found = spearman(latents, signal)
    ranks = [np.argsort(np.argsort(np.asarray(a))) for a in (*latents.T[:2], signal[:, 0])]
    expected = np.corrcoef(ranks)[:2, 2]
    np.testing.assert_allclose(found[:2, 0], expected, atol=1e-4)
    assert found[2, 0] == 0.0


def test_frames_and_signals_must_match():
    images, signal = scene(jax.random.key(0))
    with pytest.raises(
        ValueError, match=r"signal: expected numbers of shape \[1000, A\].*\(500, 1\)"
    ):
        leaked(images, signal[:N], jax.random.key(0))


def test_a_signal_explains_what_is_a_function_of_it_and_nothing_else():
    signal = jax.random.uniform(jax.random.key(4), (2 * N, 2), minval=-1)
    noise = jax.random.normal(jax.random.key(5), (2 * N,))
    folded = jnp.cos(3 * signal[:, 0]) * signal[:, 1]
    latents = jnp.stack([signal[:, 0], folded, noise, folded + folded.std() * noise, 0 * noise], 1)
    found = explained(signal, latents, jax.random.key(6))
    np.testing.assert_allclose(found, [1, 1, 0, 0.5, 0], atol=0.15)
    np.testing.assert_allclose(found[:3], [1, 1, 0], atol=0.02)
    assert abs(spearman(latents[:, 1:2], signal)).max() < 0.1  # which no correlation shows
