"""Tables large enough to be counted in a thread for each core, against the same in one."""

import jax
import numpy as np
import pytest

from jaxdeconf import threads
from jaxdeconf.independence import hoeffding_d, pairs, ranks, refined_d, table
from jaxdeconf.independence.groups import from_groups, groups_of
from jaxdeconf.independence.hoeffding import HOEFFDING
from tests.reference import midrank_d

N, COLS = 500, 100


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
def test_in_parts_every_pair_is_what_it_is_as_a_whole(statistic, columns, monkeypatch):
    x, y = columns
    whole, turned, single = statistic(x, y), statistic(y, x), statistic(x[:, 0], y[:, 0])
    monkeypatch.setattr(threads, "cores", lambda: 3)  # of which the last part overlaps
    monkeypatch.setattr(table, "PART", N)
    monkeypatch.setattr(ranks, "MANY", N)
    monkeypatch.setattr(ranks, "IN_CACHE", 7 * N)
    np.testing.assert_array_equal(statistic(x, y), whole)
    np.testing.assert_array_equal(statistic(y, x), turned)
    np.testing.assert_array_equal(statistic(x[:, 0], y[:, 0]), single)


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


def test_groups_of_ties_are_midranks_in_one_count():
    """Against the definition: one to many groups, of two samples and of most, and none."""
    rng = np.random.default_rng(1)
    x, noise = rng.normal(size=(2, N))
    y = [noise.clip(-1, 1), noise.clip(-9, 0.5), np.where(noise > 1, np.round(noise, 1), noise)]
    y += [np.where(np.abs(noise) > 0.5, np.round(noise, 2), noise), noise]
    y = np.column_stack(y) + 0.5 * (x > 0)[:, None]
    ranked, groups = ranks.rank_on_host(x[None]), groups_of(ranks.rank_on_host(y.T))
    with jax.enable_x64(True):
        found = from_groups(ranked, groups, HOEFFDING, "cpu")[0]
    assert groups.others.shape == (5, 256)  # more than 63 in one of them
    np.testing.assert_allclose(found, [midrank_d(x, v) for v in y.T], atol=1e-12)


def test_saturated_columns_are_counted_by_their_groups_either_way(columns, monkeypatch):
    x, y = columns
    monkeypatch.setattr(table, "from_ranks", None)
    monkeypatch.setattr(table, "from_levels", None)
    np.testing.assert_allclose(
        hoeffding_d(x[:, 2], y[:, ::3]), [midrank_d(x[:, 2], v) for v in y[:, ::3].T], atol=1e-7
    )
    assert hoeffding_d(y[:, ::3], x[:, 2]).shape == (34,)


def test_more_groups_than_a_byte_counts_are_left():
    values = np.repeat(np.arange(300.0), 2)[None]
    assert groups_of(ranks.rank_on_host(values[:, :512])) is None
    assert groups_of(ranks.rank_on_host(values[:, :510])).others.shape == (1, 256)
