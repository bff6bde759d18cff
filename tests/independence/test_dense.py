"""The accelerator's way to the same numbers; what it shares with no accelerator runs on a CPU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.independence import dense, hoeffding_d, pairs, refined_d
from jaxdeconf.independence.hoeffding import HOEFFDING
from jaxdeconf.independence.ranks import rank_on_host
from jaxdeconf.independence.refined import REFINED


def columns(n: int) -> tuple[np.ndarray, np.ndarray]:
    """x [3, n] and y [4, n] float32: continuous, of few values, equal, and with a tie of zeros."""
    rng = np.random.default_rng(n)
    x, y = (rng.normal(size=(v, n)).astype(np.float32) for v in (3, 4))
    x[1], y[2:], y[0] = np.round(x[1]), np.round(2 * y[2:]), x[0] ** 2
    x[2, :2] = 0.0, -0.0
    return x, y


@pytest.fixture(params=["at once", "in parts"])
def budget(request, monkeypatch):
    """Parts of samples and of columns that do not come out even, too."""
    if request.param == "in parts":
        monkeypatch.setattr(dense, "_FACTORS", 10_000)
        monkeypatch.setattr(dense, "_COUNTS", 30_000)
    for program in (pairs.from_values, pairs.from_ranks):
        program.clear_cache()
    yield
    for program in (pairs.from_values, pairs.from_ranks):
        program.clear_cache()


@pytest.mark.parametrize("statistic", [HOEFFDING, REFINED], ids=["D", "R"])
@pytest.mark.parametrize("n", [5, 64, 301])
def test_compared_samples_give_what_counted_ones_do(n, statistic, budget):
    """To the last bit, from values and from ranks, with ties and without."""
    x, y = columns(n)
    with jax.enable_x64(True):
        values = jnp.asarray(x), jnp.asarray(y)
        counted = pairs.from_values(*values, statistic, "cpu")
        compared = pairs.from_values(*values, statistic, "gpu")
        ranked = pairs.from_ranks(rank_on_host(x), rank_on_host(y), statistic, "gpu")
    np.testing.assert_array_equal(compared, counted)
    np.testing.assert_array_equal(ranked, counted)


@pytest.mark.parametrize("statistic", [HOEFFDING, REFINED], ids=["D", "R"])
def test_an_accelerator_counts_more_samples_as_a_cpu_does(statistic, monkeypatch):
    monkeypatch.setattr(dense, "MOST", 5)
    x, y = columns(301)
    with jax.enable_x64(True):
        values = jnp.asarray(x), jnp.asarray(y)
        found = [pairs.from_values(*values, statistic, platform) for platform in ("cpu", "gpu")]
    np.testing.assert_array_equal(*found)


def test_weights_of_the_most_samples_fit_their_digits():
    """Products of the largest digits stay in a byte, their sums in 32 bits, at any N allowed."""
    largest = 2 * (2**dense._DIGIT - 1)
    assert largest <= np.iinfo(np.int8).max
    assert 2 * largest * dense.MOST <= np.iinfo(np.int32).max


@pytest.mark.parametrize("function", [hoeffding_d, refined_d])
def test_the_public_functions_take_that_way(function, monkeypatch):
    """Values on the device are neither fetched nor ranked; a column with a NaN has none."""
    x, y = columns(64)
    expected = function(x.T, y.T)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    np.testing.assert_allclose(function(x.T, y.T), expected, rtol=1e-6, atol=1e-9)
    broken = x.T.copy()
    broken[3, 0] = np.nan
    missing = jax.jit(function)(broken, y.T)
    assert np.isnan(missing[0]).all()
    assert not np.isnan(missing[1:]).any()
