import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxdeconf.independence import dense, hoeffding_d, levels, pairs, table
from tests.reference import midrank_d, quintuple_d

GOLDEN = json.loads((Path(__file__).parents[1] / "golden/hoeffding.json").read_text())["cases"]
IDS = [case["name"] for case in GOLDEN]


def inputs(case: dict) -> tuple[np.ndarray, np.ndarray]:
    x, y = (np.array(case[k], dtype=float) for k in "xy")
    kept = ~(np.isnan(x) | np.isnan(y))
    return x[kept], y[kept]


@pytest.mark.parametrize("case", GOLDEN, ids=IDS)
def test_golden_in_float32_and_float64(case):
    x, y = inputs(case)
    assert hoeffding_d(x, y).dtype == jnp.float32
    np.testing.assert_allclose(hoeffding_d(x, y), case["D"], atol=1e-7, rtol=0)
    with jax.enable_x64(True):
        assert hoeffding_d(x, y).dtype == jnp.float64
        np.testing.assert_allclose(hoeffding_d(x, y), case["D"], atol=1e-13, rtol=0)


@pytest.mark.parametrize("case", [c for c in GOLDEN if c["n"] == 100], ids=lambda c: c["name"])
def test_golden_on_device(case):
    """The traced path ranks on the device; a jit argument is first cast to float32 by JAX."""
    x, y = inputs(case)
    with np.errstate(over="ignore"):
        x32, y32 = x.astype(np.float32), y.astype(np.float32)
    got = jax.jit(hoeffding_d)(x32, y32)
    np.testing.assert_allclose(got, case["D_float32"], atol=1e-7, rtol=0)
    with jax.enable_x64(True):
        np.testing.assert_allclose(jax.jit(hoeffding_d)(x, y), case["D"], atol=1e-13, rtol=0)


def test_a_device_ranks_its_own_values_and_compiles_ties_only_where_there_are(monkeypatch):
    """The layout and the way of a GPU with many samples, on whatever runs the tests."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(dense, "MOST", 5)
    rng = np.random.default_rng(4)
    x, y = rng.normal(size=(2, 30, 2))
    before = pairs.from_ranks._cache_size(), pairs.from_values._cache_size()
    for values in (y, np.round(y)):
        want = [[midrank_d(a, b) for b in values.T] for a in x.T]
        np.testing.assert_allclose(hoeffding_d(x, values), want, atol=1e-7)
    assert pairs.from_ranks._cache_size() == before[0] + 2
    assert pairs.from_values._cache_size() == before[1]


@pytest.mark.parametrize("n", [5, 6, 7, 8])
def test_brute_force_quintuples(n):
    rng = np.random.default_rng(n)
    x, y = rng.normal(size=n), rng.normal(size=n)
    np.testing.assert_allclose(hoeffding_d(x, y), quintuple_d(x, y), atol=1e-7)


@pytest.mark.parametrize("dtype", [np.int8, np.int64, np.float16, np.float32, np.float64, bool])
def test_types_and_ties_against_midranks(dtype):
    rng = np.random.default_rng(3)
    x = rng.integers(0, 2 if dtype is bool else 9, size=(40, 2)).astype(dtype)
    y = np.column_stack([rng.normal(size=40), x[:, 0], np.full(40, 2.0), -0.0 * x[:, 1]])
    want = [[midrank_d(a, b) for b in y.T] for a in x.T]
    np.testing.assert_allclose(hoeffding_d(x, y), want, atol=1e-7)
    if dtype in (np.int64, np.float32):
        with jax.enable_x64(True):
            np.testing.assert_allclose(jax.jit(hoeffding_d)(x, y), want, atol=1e-13)


def grouped(rng, n, largest):
    """[n] numbers in groups of 1 to `largest` equal ones, at random places."""
    sizes = rng.integers(1, largest + 1, n)
    sizes[0] = largest
    return rng.permutation(np.repeat(np.arange(n), sizes)[:n]).astype(float)


@pytest.mark.parametrize(
    ("largest", "one_by_one"),  # of all; of columns with large groups, and without
    [(2, [True]), (pairs.SMALL, [False, True]), (pairs.SMALL + 1, [False, False])],
)
@pytest.mark.parametrize("n", [40, 300])
def test_small_groups_of_ties_are_met_one_by_one_and_large_ones_counted(
    n, largest, one_by_one, monkeypatch
):
    monkeypatch.setattr(levels, "MOST", 0)  # or they would be counted by their levels
    rng = np.random.default_rng(largest)
    x = np.column_stack([grouped(rng, n, largest), rng.normal(size=n)])
    y = np.column_stack(
        [grouped(rng, n, largest), np.round(3 * x[:, 0] / n, 2), rng.normal(size=n)]
    )
    y[: n // 2, 0] = x[: n // 2, 0]  # ties in both
    used = []
    counted = pairs.from_ranks.__wrapped__
    monkeypatch.setattr(table, "from_ranks", lambda *of: used.append(of[-1]) or counted(*of))
    want = [[midrank_d(a, b) for b in y.T] for a in x.T]
    np.testing.assert_allclose(hoeffding_d(x, y), want, atol=1e-7)
    np.testing.assert_allclose(jax.jit(hoeffding_d)(x, y), want, atol=1e-7)
    most = max(np.unique(v, return_counts=True)[1].max() for v in (*x.T, *y.T))
    assert all(used) == (most <= pairs.SMALL)
    assert used == one_by_one


@pytest.mark.parametrize(("n", "columns"), [(1000, 5), (2500, 3), (10900, 1)])
def test_every_pair_of_a_larger_sample(n, columns):
    """Sizes on both sides of the change from two levels to three, and more than one chunk."""
    rng = np.random.default_rng(n)
    x = rng.normal(size=(n, columns))
    y = x[:, :1] * rng.normal(size=(n, columns)) + 0.1 * rng.normal(size=(n, columns))

    def direct(a: np.ndarray, b: np.ndarray) -> float:
        rank_a, rank_b = a.argsort().argsort(), b.argsort().argsort()
        both = np.array([np.sum((a < u) & (b < v)) for u, v in zip(a, b, strict=True)])
        terms = rank_a * (rank_a - 1.0) * rank_b * (rank_b - 1.0)
        terms -= 2.0 * (n - 2) * (rank_a - 1) * (rank_b - 1) * both
        terms += (n - 2.0) * (n - 3) * both * (both - 1)
        return 30 * terms.sum() / np.prod(n - np.arange(5.0))

    want = [[direct(a, b) for b in y.T] for a in x.T]
    np.testing.assert_allclose(hoeffding_d(x, y), want, atol=1e-7)


def test_shapes_and_single_calls_agree():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(30, 2)), rng.normal(size=(30, 3))
    table = hoeffding_d(x, y)
    assert table.shape == (2, 3)
    assert hoeffding_d(x[:, 0], y).shape == (3,)
    assert hoeffding_d(x, y[:, 0]).shape == (2,)
    for s in range(2):
        for p in range(3):
            np.testing.assert_array_equal(hoeffding_d(x[:, s], y[:, p]), table[s, p])
    np.testing.assert_array_equal(hoeffding_d(jnp.asarray(x), jnp.asarray(y)), table)
    np.testing.assert_array_equal(hoeffding_d(y, x), table.T)


def test_vmap_is_a_loop():
    rng = np.random.default_rng(1)
    x = jnp.asarray(rng.normal(size=(4, 25, 2)), jnp.float32)
    y = jnp.round(jnp.asarray(rng.normal(size=(4, 25, 3)), jnp.float32))
    want = jnp.stack([hoeffding_d(a, b) for a, b in zip(x, y, strict=True)])
    np.testing.assert_allclose(jax.vmap(hoeffding_d)(x, y), want, atol=1e-7)


def test_compiles_once():
    rng = np.random.default_rng(2)
    before = pairs.from_ranks._cache_size()
    for _ in range(3):
        hoeffding_d(rng.normal(size=(33, 2)), rng.normal(size=(33, 2)))
    assert pairs.from_ranks._cache_size() == before + 1


values = st.lists(st.floats(-1e6, 1e6) | st.integers(-3, 3).map(float), min_size=20, max_size=20)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(values, values, st.permutations(range(20)))
def test_invariant_to_monotone_maps_order_and_sign(x, y, order):
    x, y, order = np.array(x), np.array(y), np.array(order)
    d = float(hoeffding_d(x, y))
    assert d == pytest.approx(midrank_d(x, y), abs=1e-6)
    _, x_codes = np.unique(x, return_inverse=True)
    assert float(hoeffding_d(x_codes**3, y)) == d
    assert float(hoeffding_d(x[order], y[order])) == pytest.approx(d, abs=1e-7)
    assert float(hoeffding_d(-x, y)) == pytest.approx(d, abs=1e-7)


def test_wrong_arguments():
    x = np.arange(6.0)
    with pytest.raises(ValueError, match=r"y: expected 6 samples, as x has, got 5"):
        hoeffding_d(x, x[:5])
    with pytest.raises(ValueError, match=r"x: expected at least 5 samples and below 2.31, got 4"):
        hoeffding_d(x[:4], x[:4])
    with pytest.raises(
        ValueError, match=r"y: expected shape \[N\] or \[N, V\], got shape \(6, 1, 1\)"
    ):
        hoeffding_d(x, x[:, None, None])
    with pytest.raises(ValueError, match="x: expected real numbers, got dtype complex"):
        hoeffding_d(x + 1j, x)
    with pytest.raises(ValueError, match="y: expected real numbers, got dtype object"):
        hoeffding_d(x, x.astype(object))
    with pytest.raises(ValueError, match="x: expected no NaN, got 2 NaN in 6 values"):
        hoeffding_d(np.where(x < 2, np.nan, x), x)


def test_nan_under_jit_stays_in_its_pairs():
    x = np.random.default_rng(4).normal(size=(20, 2)).astype(np.float32)
    broken = x.copy()
    broken[3, 1] = np.nan
    got = jax.jit(hoeffding_d)(broken, x)
    assert np.isnan(got[1]).all()
    np.testing.assert_allclose(got[0], hoeffding_d(x[:, 0], x), atol=1e-7)


def test_infinities_are_ordinary_values():
    x = np.array([-np.inf, 1.0, 2.0, 3.0, np.inf, 5.0])
    np.testing.assert_array_equal(hoeffding_d(x, x), hoeffding_d(x.argsort().argsort(), x))
