"""Tables large enough to be counted in a thread for each core, against the same in one."""

import numpy as np
import pytest

from jaxdeconf import threads
from jaxdeconf.independence import hoeffding_d, pairs, ranks, refined_d, table

N, COLS = 300, 100


@pytest.fixture(scope="module")
def columns() -> tuple[np.ndarray, np.ndarray]:
    """Continuous ones, ones of a few values and saturated ones in both tables."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(N, 3))
    y = rng.normal(size=(N, COLS)) + 0.3 * x[:, :1]
    y[:, 1::3] = np.round(y[:, 1::3])
    y[:, 2::3] = np.clip(y[:, 2::3], -1.0, 1.0)
    return np.column_stack([x[:, 0], x[:, 1] > 0, x[:, 2].clip(-1, 1)]), y


@pytest.mark.parametrize("statistic", [hoeffding_d, refined_d])
@pytest.mark.parametrize("cores", [2, 3])
def test_in_parts_every_pair_is_what_it_is_as_a_whole(statistic, cores, columns, monkeypatch):
    x, y = columns
    whole = [statistic(x, y), statistic(y, x), statistic(x[:, 0], y[:, 0])]
    monkeypatch.setattr(threads, "cores", lambda: cores)
    monkeypatch.setattr(table, "PART", N)
    monkeypatch.setattr(ranks, "MANY", N)
    monkeypatch.setattr(ranks, "IN_CACHE", 7 * N)
    for one, parts in zip(whole, [statistic(x, y), statistic(y, x)], strict=False):
        np.testing.assert_array_equal(parts, one)
    np.testing.assert_array_equal(statistic(x[:, 0], y[:, 0]), whole[2])


def test_parts_are_of_one_size_so_that_one_program_is_compiled(columns, monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 3)
    monkeypatch.setattr(table, "PART", N)
    sizes = []

    def from_ranks(x, y, *rest):
        sizes.append(len(y.rank))
        return pairs.from_ranks(x, y, *rest)

    monkeypatch.setattr(table, "from_ranks", from_ranks)
    assert hoeffding_d(columns[0][:, 0], columns[1][:, ::3]).shape == (34,)
    assert sizes == [12, 12, 12]  # the last overlaps
