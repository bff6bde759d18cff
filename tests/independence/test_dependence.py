import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxdeconf as jd
from jaxdeconf.independence.dependence import false_discovery_rate

N = 200
RNG = np.random.default_rng(0)
X = np.column_stack([RNG.normal(size=N), RNG.random(N) < 0.05])
Y = np.column_stack([X[:, 0] + RNG.normal(size=N), RNG.normal(size=N), X[:, 1]])


def test_it_is_the_statistics_and_their_p_values():
    found = jd.dependence(X, Y)
    np.testing.assert_array_equal(found.D, jd.hoeffding_d(X, Y))
    np.testing.assert_array_equal(found.R, jd.refined_d(X, Y))
    np.testing.assert_array_equal(found.p, jd.p_value(found.R, N))
    want = stats.false_discovery_control(found.p, axis=None).reshape(2, 3)
    np.testing.assert_allclose(found.q, want, rtol=1e-5)
    np.testing.assert_array_equal(found.q < 0.01, [[True, False, False], [False, False, True]])


@pytest.mark.parametrize("shape", [(), (7,), (3, 40)])
def test_the_false_discovery_rate_is_benjamini_and_hochbergs(shape):
    p = np.random.default_rng(1).random(shape) ** 3
    want = stats.false_discovery_control(p, axis=None).reshape(shape) if p.size > 1 else p
    np.testing.assert_allclose(false_discovery_rate(p), want)


def test_arrays_lists_and_single_columns():
    want = jd.dependence(X, Y)
    for found in (jd.dependence(X.tolist(), Y), jd.dependence(X, jnp.asarray(Y))):
        np.testing.assert_allclose(found.p, want.p, atol=1e-6)
    assert jd.dependence(X[:, 0], Y[:, 0]).q.shape == ()
    assert jd.dependence(X, Y[:, 0]).D.shape == (2,)


def test_the_names_of_tables_are_kept():
    pandas = pytest.importorskip("pandas")
    x = pandas.DataFrame({"angle": X[:, 0], "button": X[:, 1] > 0})
    y = pandas.DataFrame(Y, columns=["near", "noise", "same"])
    want, found = jd.dependence(X, Y), jd.dependence(x, y)
    for name, table in found._asdict().items():
        np.testing.assert_array_equal(table, getattr(want, name))
        assert list(table.index) == ["angle", "button"]
        assert list(table.columns) == ["near", "noise", "same"]
    assert found.q.loc["button", "same"] < 1e-6
    assert list(jd.dependence(x, Y).p.index) == ["angle", "button"]
    assert jd.dependence(x, y["near"]).p.shape == (2, 1)
