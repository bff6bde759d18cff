"""R of tied columns: its law, its scale, and that its p-values hold their level."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxdeconf.independence import hoeffding_d, p_value, permutation_p_value, refined_d
from jaxdeconf.independence.hoeffding import HOEFFDING
from jaxdeconf.independence.null import quantile
from jaxdeconf.independence.refined import REFINED
from jaxdeconf.independence.ties import few_events, log_survival, with_ties
from tests.reference import rank_distance_covariance

N = 300  # samples, columns of x and of y: one shape, compiled once
ROWS, COLS = 25, 40
KINDS = {
    "continuous": lambda rng, shape: rng.normal(size=shape),
    "binary": lambda rng, shape: rng.integers(0, 2, size=shape),
    "rare": lambda rng, shape: rng.random(shape) < 0.02,
    "five events": lambda rng, shape: rng.random(shape).argsort(axis=0) < 5,
    "three levels": lambda rng, shape: rng.integers(0, 3, size=shape),
    "rare, of two signs": lambda rng, shape: rng.choice([-1, 0, 0, 0, 0, 0, 0, 0, 0, 1], shape),
    "saturated": lambda rng, shape: np.clip(rng.normal(size=shape), -0.7, 0.7),
    "zero or continuous": lambda rng, shape: rng.normal(size=shape) * (rng.random(shape) < 0.1),
}


def p_values(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[S, P] of the scaled R of x [N, S] and y [N, P]."""
    x, y = x.reshape(N, -1).astype(float), y.reshape(N, -1).astype(float)
    wide = (
        np.pad(v, ((0, 0), (0, to - v.shape[1])), mode="edge") for v, to in ((x, ROWS), (y, COLS))
    )
    r, _ = with_ties(*wide, REFINED)
    return np.asarray(p_value(r, N))[: x.shape[1], : y.shape[1]]


@pytest.mark.parametrize("terms", [1, 2, 5])
def test_the_survival_of_equal_weights_is_chi_squares(terms):
    q = np.array([0.5, 1.0, 3.0, 10.0, 100.0, 500.0])
    with jax.enable_x64(True):
        found = jax.vmap(log_survival, (0, None))(3 * q, jnp.full(terms, 3.0))
    np.testing.assert_allclose(found, stats.chi2.logsf(q, terms), rtol=1e-4, atol=2e-3)


def test_the_survival_of_continuous_columns_is_the_tables():
    """Of the products of 36 / (pi^4 i^2 j^2), beyond the largest their mean alone."""
    w = np.array([-0.2, 0.5, 2.0, 4.0, 7.0])
    i = np.arange(1.0, 200.0)
    weights = np.sort((36 / np.pi**4 / np.outer(i, i) ** 2).ravel())[::-1]
    with jax.enable_x64(True):
        survival = jax.vmap(log_survival, (0, None))
        found = survival(w + weights[:24].sum(), jnp.asarray(weights[:24]))
    np.testing.assert_allclose(np.exp(found), p_value(w / 1.2 / (N - 1), N), rtol=5e-3)


@pytest.mark.parametrize("log_p", [-0.1, -3.0, -13.0, -40.0, -3000.0])
def test_the_quantile_inverts_the_p_value(log_p):
    assert quantile(log_p) == pytest.approx(float(quantile(log_p, np)), rel=1e-5)
    if log_p > -50:
        p = p_value(quantile(log_p) / (1.2 * (N - 1)), N)
        np.testing.assert_allclose(jnp.log(p), log_p, rtol=1e-3)


def test_two_binary_columns_are_tested_by_their_correlation():
    rng = np.random.default_rng(0)
    x = rng.random((N, 1)) < [0.3]
    y = np.where(rng.random((N, 4)) < [0.0, 0.03, 0.06, 0.3], x, rng.random((N, 4)) < 0.2)
    phi = np.array([np.corrcoef(x[:, 0], v)[0, 1] for v in y.T])
    want = stats.chi2.sf((N - 1) * phi**2, 1)
    np.testing.assert_allclose(p_values(x, y)[0], want, rtol=2e-3, atol=1e-30)


@pytest.mark.parametrize("shared", range(6))
def test_two_rare_columns_are_tested_by_fishers_exact_test(shared):
    x, y = np.zeros((2, N))
    x[:5], y[5 - shared : 25 - shared] = 1, 1
    law = stats.hypergeom(N, 5, 20)
    exact = min(1.0, 2 * min(law.sf(shared - 1), law.cdf(shared)))
    found = float(p_values(x, y)[0, 0])
    assert found >= exact * 0.999
    assert shared < 2 or found == pytest.approx(exact, rel=1e-3)


def test_few_levels_have_the_p_value_of_permutations():
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, 4, size=N), rng.poisson(1.0, size=N)
    y = np.where(rng.random(N) < 0.07, x, y)
    shuffled = [rank_distance_covariance(x, rng.permutation(y)) for _ in range(500)]
    share = np.mean(np.array(shuffled) >= rank_distance_covariance(x, y))
    assert 0.005 < share < 0.3
    assert p_values(x, y)[0, 0] == pytest.approx(share, abs=4 * (share / 500) ** 0.5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("other", ["rare", "three levels", "saturated"])
def test_p_values_hold_their_level(kind, other):
    """1000 independent pairs of 300 samples, at most alpha rejected, three sigma allowed."""
    rng = np.random.default_rng(2)
    p = p_values(KINDS[kind](rng, (N, ROWS)), KINDS[other](rng, (N, COLS)))
    for alpha in (0.2, 0.05, 0.01):
        assert np.mean(p <= alpha) < alpha + 3 * (alpha / p.size) ** 0.5


def test_permutation_p_values_of_rare_and_mixed_columns_hold_their_level():
    rng = np.random.default_rng(3)
    x = np.hstack([KINDS[kind](rng, (60, 4)) for kind in ("rare", "binary", "continuous")])
    y = np.hstack([rng.random((60, 4)) < 0.1, KINDS["saturated"](rng, (60, 4))])
    p = permutation_p_value(x, y, jax.random.key(0), 99)
    assert np.mean(np.asarray(p) <= 0.1) < 0.1 + 3 * (0.1 / p.size) ** 0.5


def test_continuous_and_hardly_tied_columns_keep_their_statistic_bit_for_bit():
    rng = np.random.default_rng(4)
    x, y = rng.normal(size=(2, N, 2))
    x[:15, 0] = y[:15, 1] = 0.5  # 5 % of one value: two samples share it in one case of 400
    d = hoeffding_d(x, y)
    kept, tied = with_ties(x, y, HOEFFDING)
    assert not tied.any()
    np.testing.assert_array_equal(kept, d)
    x[:45, 0] = 0.5
    _, tied = with_ties(x, y, HOEFFDING)
    np.testing.assert_array_equal(tied, [[True, True], [False, False]])


def test_symmetry():
    rng = np.random.default_rng(5)
    x = np.column_stack([kind(rng, N) for kind in KINDS.values()])
    y = np.round(x + rng.normal(size=x.shape))
    p = p_values(x, y)
    np.testing.assert_allclose(p_values(-x, y), p, rtol=1e-3)
    np.testing.assert_allclose(p_values(y, x).T, p, rtol=1e-3)


def test_the_refined_r_has_the_scale_of_its_p_value():
    rng = np.random.default_rng(6)
    x, y = rng.integers(0, 3, size=(2, 64)).astype(np.float32)
    want, tied = with_ties(x, y, HOEFFDING)
    assert tied
    np.testing.assert_array_equal(refined_d(x, y), want)


def test_a_constant_column_has_no_evidence():
    y = np.column_stack([np.arange(N), np.ones(N), np.arange(N) % 2])
    np.testing.assert_array_equal(p_values(np.ones(N), y), 1.0)


def test_traced_is_as_on_the_host_and_a_missing_statistic_stays_missing():
    rng = np.random.default_rng(7)
    x, y = rng.normal(size=(2, 64, 2)).astype(np.float32)
    x[:, 0] = x[:, 0] > 1
    traced = jax.jit(partial(with_ties, statistic=HOEFFDING))
    want, tied = with_ties(x, y, HOEFFDING)
    found, tied_traced = traced(x, y)
    np.testing.assert_array_equal(tied, tied_traced)
    np.testing.assert_allclose(found, want, atol=1e-6)
    x[0, 0] = np.nan
    found, _ = traced(x, y)
    assert np.isnan(found[0]).all()
    assert not np.isnan(found[1]).any()


def test_columns_of_few_events_are_counted():
    table = np.zeros((50, 2, 3))
    table[:4, 0, 1], table[:5, 0, 2], table[:, 1] = 7, 7, np.arange(50.0)[:, None]
    table[3:, 1, 0] = 60
    assert few_events(table) == {1: 4, 3: 3}
