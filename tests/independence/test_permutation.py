import jax
import numpy as np
import pytest

from jaxdeconf.independence import hoeffding_d, p_value, permutation_p_value, refined_d

N, PERMUTATIONS = 64, 400  # one shape throughout, compiled once


def permuted(x: np.ndarray, y: np.ndarray, seed: int, statistic=hoeffding_d) -> float:
    return float(permutation_p_value(x, y, jax.random.key(seed), PERMUTATIONS, statistic))


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_the_asymptotic_law_on_continuous_data(seed):
    x, y = np.random.default_rng(seed).normal(size=(2, N))
    assert permuted(x, y, seed) == pytest.approx(float(p_value(hoeffding_d(x, y), N)), abs=0.1)


def test_counts_the_permutations_it_says():
    """No permutation of identical columns reaches D = 1, so p is 1 / (1 + permutations)."""
    x = np.arange(float(N))
    assert permuted(x, x, 1) == pytest.approx(1 / (1 + PERMUTATIONS))


def test_constant_column_has_no_evidence():
    assert permuted(np.ones(N), np.arange(N), 2) == 1.0


def test_finds_binary_dependence_that_the_asymptotic_law_misses():
    rng = np.random.default_rng(3)
    x = rng.integers(0, 2, size=N)
    y = np.where(rng.random(N) < 0.3, 1 - x, x)
    assert float(p_value(hoeffding_d(x, y), N)) > 0.05
    assert permuted(x, y, 4) < 0.01
    assert permuted(x, y, 4, refined_d) < 0.01


def test_level_on_discrete_data():
    rng = np.random.default_rng(5)
    x, y = rng.integers(0, 3, size=(2, N, 20))
    p = permutation_p_value(x, y, jax.random.key(6), 199)
    assert p.shape == (20, 20)
    assert float((p <= 0.1).mean()) == pytest.approx(0.1, abs=6 * (0.1 / 400) ** 0.5)


def test_jit():
    x, y = np.random.default_rng(7).normal(size=(2, N)).astype(np.float32)
    traced = jax.jit(permutation_p_value, static_argnums=3)(x, y, jax.random.key(8), PERMUTATIONS)
    assert float(traced) == pytest.approx(permuted(x, y, 8))


def test_wrong_argument():
    with pytest.raises(ValueError, match="permutations: expected a positive integer, got 0"):
        permutation_p_value(np.arange(9), np.arange(9), jax.random.key(0), 0)
