"""HSCIC against its definition in float64, and on what does and does not depend."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.independence.hscic import RIDGE, hscic

N = 150


def samples(share=0.0, count=N, seed=0):
    """z; y = z and noise; x of four features, z and noise and, by a share, what y is beside z."""
    rng = np.random.default_rng(seed)
    z, own = rng.normal(size=(2, count, 1))
    y = z + 0.5 * own
    x = np.concatenate([z, z**2, share * own, 0 * z], axis=1) + 0.3 * rng.normal(size=(count, 4))
    return x, y, z


def by_definition(x, y, z, ridge):
    """A loop over z_j: the joint embedding's distance from the product of the marginal ones."""
    x = (x - x.mean(0)) / np.sqrt(x.var(0).sum())
    y, z = ((a - a.mean(0)) / a.std(0) for a in (y, z))
    count = len(x)
    k_x, k_y, k_z = (np.exp(-((a[:, None] - a[None]) ** 2).sum(-1)) for a in (x, y, z))
    total = 0.0
    for j in range(count):
        w = np.linalg.solve(k_z + count * ridge * np.eye(count), k_z[:, j])
        # The squared norm of Σ w_i φ(x_i) ⊗ ψ(y_i) - Σ w_i φ(x_i) ⊗ Σ w_i ψ(y_i).
        coefficients = np.diag(w) - np.outer(w, w)
        total += (coefficients * (k_x @ coefficients @ k_y)).sum()
    return total / count


@pytest.mark.parametrize("ridge", [RIDGE, 1e-2])
def test_it_is_its_definition(ridge):
    x, y, z = samples(1.0)
    expected = by_definition(x, y, z, ridge)
    np.testing.assert_allclose(hscic(x, y, z, ridge), expected, rtol=1e-3)
    several = np.concatenate([y, x[:, :1]], axis=1), np.concatenate([z, x[:, 1:2]], axis=1)
    expected = by_definition(x, *several, ridge)
    np.testing.assert_allclose(hscic(x, *several, ridge), expected, rtol=1e-3)


def test_it_is_small_where_x_depends_on_y_by_z_alone():
    values = [float(hscic(*samples(share))) for share in (0.0, 0.5, 1.0)]
    assert values[1] > 2 * values[0]
    assert values[2] > values[1] > 0
    x, y, z = samples()
    assert hscic(x, y, np.random.default_rng(1).normal(size=z.shape)) > 2 * values[0]


def test_a_sample_of_weight_0_is_none():
    x, y, z = samples(1.0)
    kept = np.random.default_rng(2).uniform(size=N) < 0.7
    wild = np.where(kept[:, None], 0.0, 100.0)
    found = hscic(x + wild, y - wild, z + 2 * wild, RIDGE, kept)
    np.testing.assert_allclose(found, hscic(x[kept], y[kept], z[kept]), rtol=1e-3)
    assert hscic(x, y, z, RIDGE, np.zeros(N)) == 0.0


def test_neither_scale_nor_place_changes_it():
    x, y, z = samples(1.0)
    found = hscic(100 * x + 3, 5 * y - 1, 0.1 * z)
    np.testing.assert_allclose(found, hscic(x, y, z), rtol=1e-3)


def test_its_gradient_is_that_of_finite_differences():
    x, y, z = samples(1.0)
    step = np.random.default_rng(3).normal(size=x.shape)

    def along(t):
        return hscic(jnp.asarray(x + 0.0) + t * step, y, z, 1e-2)

    expected = (by_definition(x + 1e-4 * step, y, z, 1e-2) - by_definition(x, y, z, 1e-2)) / 1e-4
    np.testing.assert_allclose(jax.grad(along)(0.0), expected, rtol=2e-2)


def test_what_is_constant_depends_on_nothing():
    x, y, z = samples(1.0)
    flat = jnp.ones_like(x)
    assert abs(hscic(flat, y, z)) < 1e-4
    gradient = jax.grad(lambda x: hscic(x, y, z))(flat)
    assert np.isfinite(gradient).all()
