import jax
import numpy as np
import pytest

from jaxdeconf.independence import hoeffding_d, refined_d
from tests.independence.test_hoeffding import GOLDEN, inputs
from tests.reference import quintuple_r


@pytest.mark.parametrize(
    "case",
    [c for c in GOLDEN if "R" in c and c["n"] in (5, 12, 50, 100, 1000)],
    ids=lambda c: c["name"],
)
def test_golden(case):
    x, y = inputs(case)
    np.testing.assert_allclose(refined_d(x, y), case["R"], atol=1e-7)
    with jax.enable_x64(True):
        np.testing.assert_allclose(refined_d(x, y), case["R"], atol=1e-13)


@pytest.mark.parametrize("n", [5, 6, 7])
def test_brute_force(n):
    rng = np.random.default_rng(n)
    x, y = rng.normal(size=n), rng.normal(size=n)
    np.testing.assert_allclose(refined_d(x, y), quintuple_r(x, y), atol=1e-7)


def test_sees_the_singular_law_that_d_misses():
    """y is a function of x and noise, and D's population value is 0 (Even-Zohar 2020, ex. I)."""
    rng = np.random.default_rng(1)
    x, noise = rng.uniform(size=(2, 900))
    y = np.where(x > noise, np.minimum(noise, x / 2), np.maximum(noise, (x + 1) / 2))
    assert abs(float(hoeffding_d(x, y))) < 4e-3
    assert float(refined_d(x, y)) > 1e-2


def test_symmetry():
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(2, 40, 3))
    table = refined_d(x, y)
    np.testing.assert_allclose(refined_d(-x, y), table, atol=1e-7)
    np.testing.assert_allclose(refined_d(y, x), table.T, atol=1e-7)
