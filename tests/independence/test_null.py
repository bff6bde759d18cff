import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.independence import hoeffding_d, p_value, refined_d, threshold
from tests.independence.test_hoeffding import GOLDEN


@pytest.mark.parametrize(
    "case", [c for c in GOLDEN if c.get("p", 0) > 1e-5], ids=lambda c: c["name"]
)
def test_p_values_of_taustar(case):
    kept = sum(a is not None and b is not None for a, b in zip(case["x"], case["y"], strict=True))
    np.testing.assert_allclose(p_value(case["D"], kept), case["p"], rtol=5e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("n", "tests", "want"),
    [(500, 24, 5.30e-3), (1000, 24, 2.65e-3), (5000, 24, 5.3e-4), (2000, 192, 1.92e-3)],
)
def test_thresholds_of_an_independent_inversion(n, tests, want):
    assert threshold(n, tests) == pytest.approx(want, rel=5e-3)


@pytest.mark.parametrize("alpha", [0.9, 0.05, 1e-4, 2.0e-6, 1e-9, 1e-30])
def test_threshold_inverts_p_value(alpha):
    np.testing.assert_allclose(p_value(threshold(700, 1, alpha), 700), alpha, rtol=1e-3)


def test_p_value_falls_monotonically_across_the_end_of_the_table():
    d = jnp.linspace(-0.002, 0.02, 4001)
    p = jax.jit(p_value)(d, 1000)
    assert p[0] == 1.0
    assert (jnp.diff(p) <= 0).all()
    assert p[-1] > 0


def test_level_of_the_test_under_independence():
    """1000 independent pairs: the rejections at level alpha are binomial. Six sigma allowed."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 200, 32))
    for statistic in (hoeffding_d, refined_d):
        for alpha in (0.3, 0.05):
            rate = float((statistic(x, y) > threshold(200, 1, alpha)).mean())
            assert rate == pytest.approx(alpha, abs=6 * (alpha / 1024) ** 0.5)


def test_wrong_arguments():
    with pytest.raises(ValueError, match=r"n: expected .*5.*, got 4"):
        threshold(4)
    with pytest.raises(ValueError, match="tests: expected a positive integer, got 0"):
        threshold(50, 0)
    with pytest.raises(ValueError, match=r"alpha: expected a probability in \(0, 1\), got 1.0"):
        threshold(50, 1, 1.0)
    with pytest.raises(ValueError, match=r"n: expected .*5.*, got 3"):
        p_value(0.1, 3)
