"""D of columns of few values, on every way it is counted, against midranks by definition."""

import jax
import numpy as np
import pytest

from jaxdeconf.independence import hoeffding_d
from jaxdeconf.independence.hoeffding import HOEFFDING
from jaxdeconf.independence.levels import few_levels, from_cells, from_levels, levels_of
from jaxdeconf.independence.ranks import rank_on_host
from tests.reference import midrank_d

N = 600  # several blocks of every size
LEVELS = [1, 2, 16, 17, 200, 256]


def table(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns of so many levels; and few, none, saturated and as many as a byte holds."""
    rng = np.random.default_rng(seed)
    x = np.column_stack([rng.integers(0, k, size=N) for k in LEVELS])
    x[:256, -1] = np.arange(256)
    noise = rng.normal(size=N)
    y = [np.round(x[:, 1] + noise), noise + x[:, 2], np.clip(noise, -1.5, 1.5), x[:, -1] // 2]
    return x, np.column_stack(y)


def test_every_kind_of_pair_is_midranks():
    x, y = table(0)
    want = [[midrank_d(a, b) for b in y.T] for a in x.T]
    np.testing.assert_allclose(hoeffding_d(x, y), want, atol=1e-7)
    np.testing.assert_array_equal(hoeffding_d(y, x), hoeffding_d(x, y).T)
    np.testing.assert_array_equal(hoeffding_d(x[:, 3], y[:, 1]), hoeffding_d(x, y)[3, 1])


@pytest.mark.parametrize("dtype", ["u1", "i2", "f4"])
def test_types_of_a_byte_or_two_are_not_widened_in_value(dtype):
    x, y = table(1)
    np.testing.assert_array_equal(
        hoeffding_d(x[:, 1:5].astype(dtype), y), hoeffding_d(x[:, 1:5], y)
    )


def test_both_ways_for_two_columns_of_few_levels_agree():
    x, y = (rank_on_host(v.T) for v in table(2))
    few_x, few_y = few_levels(x), few_levels(y)
    assert few_x.all()
    np.testing.assert_array_equal(few_y, [True, False, False, True])
    y = rank_on_host(table(2)[1].T[few_y])
    with jax.enable_x64(True):
        one = from_levels(levels_of(x), y, HOEFFDING)
        np.testing.assert_allclose(
            from_cells(levels_of(x), levels_of(y), HOEFFDING), one, atol=1e-15
        )


def test_levels_are_midranks_of_the_values():
    values = np.array([[3, 1, 1, 7, 3, 3]])
    found = levels_of(rank_on_host(values))
    np.testing.assert_array_equal(found.level, [[1, 0, 0, 2, 1, 1]])
    np.testing.assert_array_equal(found.midrank[0, :3], [0.5, 3, 5])
