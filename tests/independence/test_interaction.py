"""What two columns tell together: the statistic, its law, its level, and what it sees."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxdeconf.independence import p_value
from jaxdeconf.independence.interaction import interaction_r, pairs_of, strongest
from tests.reference import interaction, midrank_d

N, ROWS, COLS = 300, 5, 60  # samples, columns of x and of y: one shape, compiled once
KINDS = {
    "continuous": lambda rng, shape: rng.normal(size=shape),
    "binary": lambda rng, shape: rng.integers(0, 2, size=shape),
    "rare": lambda rng, shape: rng.random(shape) < 0.1,
    "saturated": lambda rng, shape: np.clip(rng.normal(size=shape), -0.7, 0.7),
}


def p_values(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[10, P] of x [N, up to 5] and y [N, P], padded to one shape."""
    x, y = x.reshape(N, -1).astype(float), y.reshape(N, -1).astype(float)
    wide = (
        np.pad(v, ((0, 0), (0, to - v.shape[1])), mode="edge") for v, to in ((x, ROWS), (y, COLS))
    )
    return np.asarray(p_value(interaction_r(*wide), N))[:, : y.shape[1]]


def circle(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Two angles and three other columns; a torque of their difference, and an exclusive or."""
    rng = np.random.default_rng(seed)
    x = rng.random((N, ROWS))
    torque = np.sin(2 * np.pi * (x[:, 0] - x[:, 1])) + 0.3 * rng.normal(size=N)
    either = (x[:, 0] > 0.5) ^ (x[:, 1] > 0.5) ^ (rng.random(N) < 0.2)
    return x, np.column_stack([torque, either])


def test_three_binary_columns_are_tested_by_a_correlation():
    """Of y with what regression on x and on x' leaves of x x'."""
    rng = np.random.default_rng(0)
    x, y = rng.random((N, 2)) < [0.4, 0.6], rng.random((N, 4)) < 0.5
    y = np.where(rng.random((N, 4)) < [0.0, 0.1, 0.2, 0.5], (x[:, 0] ^ x[:, 1])[:, None], y)
    basis = np.column_stack([np.ones(N), x])
    product = x[:, 0] * x[:, 1] * 1.0
    left = product - basis @ np.linalg.lstsq(basis, product, rcond=None)[0]
    r = np.array([np.corrcoef(left, v)[0, 1] for v in y.T])
    want = stats.chi2.sf((N - 1) * r**2, 1)
    allowed = np.where(want > 0.3, 0.03, 2e-3 * want)  # below the mean of the law it is near
    assert (np.abs(p_values(x, y)[0] - want) <= allowed).all()


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_slow_twins_statistic_and_law(kind):
    """The law by drawing from it: 100,000 draws, four standard errors."""
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(N, 2)), KINDS[kind](rng, (N, 3)).astype(float)
    x[:, 1] = np.round(x[:, 1] + 0.5 * x[:, 0])  # tied, and not independent
    y[:, 1] = y[:, 1] + x[:, 0] > 0.5
    y[:, 2] = np.where(rng.random(N) < 0.15, x[:, 0] * x[:, 1] > 0, y[:, 2])
    found = p_values(x, y)[0]
    for column, p in zip(y.T, found, strict=True):
        t, weights = interaction(x[:, 0], x[:, 1], column)
        drawn = (rng.chisquare(1, (100_000, len(weights))) @ weights > t).mean()
        allowed = 4 * np.sqrt(drawn * (1 - drawn) / 100_000) + (0.03 if t < weights.sum() else 0)
        assert p == pytest.approx(drawn, abs=allowed + 1e-4)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("states", KINDS)
def test_independent_columns_are_rejected_as_often_as_is_said(kind, states):
    """Of 1200 tests of 2 data sets, not independent of each other: five standard errors."""
    rng = np.random.default_rng(2)
    p = [p_values(KINDS[states](rng, (N, ROWS)), KINDS[kind](rng, (N, COLS))) for _ in range(2)]
    for level in (0.05, 0.01):
        error = np.sqrt(level * (1 - level) / np.size(p))
        assert np.mean(np.less_equal(p, level)) <= level + 5 * error


def test_it_sees_what_no_single_column_shows():
    """And only together with the right one."""
    x, y = circle(3)
    alone, together = [midrank_d(v, y[:, 0]) for v in x[:, :2].T], p_values(x, y)
    assert p_value(np.array(alone), N).min() > 1e-3
    assert np.abs(np.corrcoef(x[:, :2].T, y[:, 1])[2, :2]).max() < 0.15
    assert together[0].max() < 1e-6
    assert together[1:].min() > 1e-3


def test_what_one_column_shows_is_none_of_it():
    rng = np.random.default_rng(4)
    x = rng.random((N, ROWS))
    x[:, 4] = x[:, 3] ** 3
    y = np.column_stack([x[:, 0], x[:, 1] > 0.9, x[:, 3] - x[:, 4] + 0.1 * rng.normal(size=N)])
    assert p_values(x, y).min() > 1e-3
    assert p_values(x, y)[-1, 0] == 1.0  # two equal ranks tell nothing together


def test_it_is_of_ranks_and_knows_no_order_of_the_pair():
    x, y = circle(5)
    want = p_values(x, y)
    np.testing.assert_allclose(p_values(np.exp(3 * x), y), want, atol=1e-6)
    swapped = p_values(x[:, [1, 0, 2, 3, 4]], -1.0 * y)
    np.testing.assert_allclose(swapped[0], want[0], rtol=1e-4)


def test_too_few_coincidences_and_constant_columns_tell_nothing():
    rng = np.random.default_rng(6)
    x, few = rng.normal(size=(N, ROWS)), np.arange(N) < 9
    assert (p_values(x, few) == 1).all()
    assert (p_values(x, np.arange(N) < 10) < 1).all()
    assert (p_values(x, np.ones(N)) == 1).all()
    x[:, 0] = 0
    assert (p_values(x, rng.normal(size=N))[:4] == 1).all()


def test_traced_and_mapped_it_is_the_same():
    sets = [circle(seed) for seed in (7, 8)]
    x, y = (np.stack(v).astype(np.float32) for v in zip(*sets, strict=True))
    y = np.pad(y, ((0, 0), (0, 0), (0, COLS - 2)), mode="edge")
    want = [interaction_r(*pair) for pair in zip(x, y, strict=True)]
    found = jax.jit(jax.vmap(interaction_r))(x, y)
    assert found.shape == (2, 10, COLS)
    assert found.dtype == want[0].dtype == jnp.zeros(()).dtype
    np.testing.assert_allclose(found, np.stack(want), atol=1e-6)


def test_pairs_and_the_strongest_test_of_a_column():
    np.testing.assert_array_equal(pairs_of(3), [[0, 1], [0, 2], [1, 2]])
    assert pairs_of(1).shape == (0, 2)
    assert interaction_r(np.arange(9.0)[:, None], np.ones((9, 4))).shape == (0, 4)
    found = strongest(np.array([[0.1], [0.2], [0.3]]), np.array([[0.0], [0.5], [0.25]]))
    np.testing.assert_allclose(found, [[0.5], [0.25], [0.5]])
    np.testing.assert_array_equal(strongest(np.ones((1, 2)), np.ones((0, 2))), np.ones((1, 2)))


def test_wrong_arguments():
    with pytest.raises(ValueError, match="y: expected 9 samples, as x has, got 8"):
        interaction_r(np.ones((9, 2)), np.ones((8, 2)))
    with pytest.raises(ValueError, match="x: expected no NaN, got 1 NaN"):
        interaction_r(np.array([[0.0, 1], [1, np.nan], [2, 2], [3, 1], [4, 4]]), np.ones((5, 1)))
