"""The linear start against NumPy's SVD, and against sources that are known."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf.learn.linear_start import linear_start, principal_components

SAMPLES, PIXELS, SOURCES = 4000, 60, 3


def mixture(scales):
    """Independent uniform, arcsine and Laplace sources, each with a direction of its own."""
    keys = jax.random.split(jax.random.key(0), 3)
    sources = jnp.stack(
        [
            jax.random.uniform(keys[0], (SAMPLES,), minval=-1.7, maxval=1.7),
            jnp.sqrt(2.0) * jnp.sin(jax.random.uniform(keys[1], (SAMPLES,), maxval=2 * jnp.pi)),
            jax.random.laplace(keys[2], (SAMPLES,)) / jnp.sqrt(2.0),
        ],
        axis=1,
    )
    directions = jnp.linalg.qr(jax.random.normal(jax.random.key(1), (PIXELS, SOURCES)))[0]
    return sources, 0.3 + (sources * jnp.asarray(scales)) @ directions.T


def test_principal_components_are_those_of_an_svd():
    x = jax.random.normal(jax.random.key(2), (200, 30)) * jnp.linspace(3, 0.1, 30)
    x = x - x.mean(0)
    vectors, variances = principal_components(x, 4, jax.random.key(3))
    _, singular, right = np.linalg.svd(np.asarray(x, np.float64), full_matrices=False)
    np.testing.assert_allclose(variances, singular[:4] ** 2 / 200, rtol=1e-3)
    np.testing.assert_allclose(np.abs(right[:4] @ np.asarray(vectors)), np.eye(4), atol=0.03)


def test_components_are_white_and_reconstruct():
    _, x = mixture((3.0, 2.0, 1.0))
    start = linear_start(x, SOURCES, jax.random.key(4))
    z = (x - start.mean) @ start.encoder
    np.testing.assert_allclose(np.cov(z.T), np.eye(SOURCES), atol=1e-2)
    np.testing.assert_allclose(start.mean + z @ start.decoder, x, atol=1e-3)


def test_sources_of_equal_variance_are_parted():
    # Equal eigenvalues: principal components alone are an arbitrary rotation of the sources.
    sources, x = mixture((2.0, 2.0, 2.0))
    start = linear_start(x, SOURCES, jax.random.key(5))
    z = (x - start.mean) @ start.encoder
    correlation = np.abs(np.corrcoef(np.asarray(z).T, np.asarray(sources).T)[:SOURCES, SOURCES:])
    assert (correlation.max(axis=0) > 0.995).all()
    assert (np.sort(correlation, axis=0)[:-1] < 0.08).all()


def purity(x, sources, among):
    """|Correlation| [2, 3] of the two components kept with the three sources."""
    start = linear_start(x, 2, jax.random.key(5), among)
    z = (x - start.mean) @ start.encoder
    assert z.shape == (SAMPLES, 2)
    return np.abs(np.corrcoef(np.asarray(z).T, np.asarray(sources).T)[:2, 2:])


def test_components_among_more_are_purer():
    # Two principal components of three alike hold a part of each source; among three, two are pure.
    sources, x = mixture((2.0, 2.0, 2.0))
    assert purity(x, sources, None).max(axis=1).min() < 0.95
    assert purity(x, sources, 3).max(axis=1).min() > 0.995


def test_of_components_among_more_the_strongest_are_kept():
    sources, x = mixture((1.0, 3.0, 2.0))
    found = purity(x, sources, 3)
    np.testing.assert_array_equal(found.argmax(axis=1), [1, 2])  # the strongest first
    assert found.max(axis=1).min() > 0.995


def test_a_component_that_is_not_there_is_not_blown_up():
    """Three sources, four components: the fourth is rounding, and stays small."""
    _, x = mixture((3.0, 2.0, 1.0))
    start = linear_start(x, SOURCES + 1, jax.random.key(4))
    variances = np.sort(np.asarray((x - start.mean) @ start.encoder).var(axis=0))
    assert variances[0] < 1e-3
    np.testing.assert_allclose(variances[1:], 1.0, atol=0.02)
