"""The claims' rates. References: find_mask for what is masked, Wilson's equation for the intervals,
and systems in which the answer is known."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxdeconf.mask import find_mask
from jaxdeconf.theory import claims, structural
from jaxdeconf.theory.claims import ClaimsConfig, Statistics, rate
from jaxdeconf.theory.structural import BUTTON, CAUSE, FORK, MARK, OBSERVATIONS, PAIR, STATES

KEY = jax.random.key(0)
CONFIG = ClaimsConfig(
    trajectories=(300,), systems=60, broken_systems=50, null_systems=200, strengths=(0.9,)
)


@pytest.fixture(scope="module")
def measured():
    return claims.measure(CONFIG, KEY)


def cases(rows):
    return {row.case: row for row in rows}


@pytest.mark.parametrize(("events", "n"), [(0, 20), (7, 20), (20, 20), (3, 1000)])
def test_an_interval_s_ends_solve_wilson_s_equation(events, n):
    found = rate("", 5, 0.0, np.arange(n) < events)
    assert (found.events, found.n, found.rate) == (events, n, events / n)
    for end in found.interval:
        assert (found.rate - end) ** 2 == pytest.approx(
            1.959964**2 * end * (1 - end) / n, abs=1e-12
        )
    assert found.interval[0] <= found.rate <= found.interval[1]


def test_a_rate_of_nothing_is_unknown():
    found = rate("", 5, 0.0, np.zeros(0, bool))
    assert np.isnan(found.rate)
    assert found.interval == (0.0, 1.0)


def test_what_is_masked_is_what_find_mask_masks():
    structures, strengths = claims.draw_systems(CONFIG, 3, KEY)
    tests = claims.run_tests(structures, KEY, 300, 3)
    gamma = CONFIG.gamma(300)
    keys = jax.random.split(claims.named(KEY, "structural data"), 3)
    for place in range(3):
        one = jax.tree.map(lambda part, place=place: part[place], structures)
        noise = structural.draw_noise(keys[place], 300, 3)
        states, seen, actions = structural.simulate(one, noise)
        mask = find_mask(states[:, 0], seen[:, 0], actions[:, :, None], gamma, None)
        np.testing.assert_array_equal(tests.masked(gamma)[place], mask.mask)
        np.testing.assert_allclose(tests.state_action[place], mask.state_action[..., 0], atol=1e-5)
    assert strengths.tolist() == [0.9] * 3


def test_the_parts_of_a_batch_are_its_systems(monkeypatch):
    structures, _ = claims.draw_systems(CONFIG, 3, KEY)
    whole = claims.run_tests(structures, KEY, 300, 3)
    monkeypatch.setattr(claims, "_CHUNK", 2)
    for one, other in zip(whole, claims.run_tests(structures, KEY, 300, 3), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_strong_causes_are_kept_and_a_fork_is_masked_by_the_intervention_alone(measured):
    rows = cases(claims.conservative(CONFIG, measured, KEY))
    assert rows["edges of 0.9"].rate < 0.15
    for name, row in rows.items():
        if name.startswith(("A1", "A2", "A3", "no density", "only a pair")):
            assert row.rate > 0.9, name
    assert rows[f"{BUTTON}, tested by R"].rate < rows[BUTTON].rate
    fork = cases(claims.strictly_less(CONFIG, measured, KEY))
    assert fork["intervened, a fork"].rate > 0.95
    assert fork["natural, a fork"].rate < 0.6
    assert fork["natural, no fork"].rate > 0.85
    more = cases(claims.no_more_conservative(CONFIG, measured, KEY))
    for name in ("shows the seed", "the mark", "shows a state that moves no action"):
        assert more[name].rate > 0.9
    assert more["the mark"].n == int(measured[300].natural.masked(CONFIG.gamma(300))[:, MARK].sum())


def test_two_states_together_keep_the_cause_that_none_shows_alone():
    found = cases(claims.pairs(replace(CONFIG, broken_systems=30), KEY))
    assert found[f"the cause is masked: {PAIR}, states one at a time"].rate > 0.9
    assert found[f"the cause is masked: {PAIR}, two states together"].rate < 0.3
    for name, row in found.items():
        if "the mark" in name:
            assert row.rate > 0.9, name
        elif "shown alone" in name:
            assert row.rate < 0.3, name


def test_the_threshold_holds_its_error_and_its_power(measured):
    found = claims.threshold(CONFIG, measured, KEY)
    masked = [row.rate for row in found if row.case == "a cause is masked"]
    kept = [row.rate for row in found if row.case == "the mark is kept"]
    assert masked == sorted(masked)
    assert kept == sorted(kept, reverse=True)
    told = [row for row in found if row.predicted is not None]
    assert {row.tests for row in told} == {3, 21, 192}
    for row in told:  # four standard errors, and two points for laws of many samples
        assert row.predicted is not None
        error = 0.02 + 4 * (row.predicted * (1 - row.predicted) / row.n) ** 0.5
        assert row.rate == pytest.approx(row.predicted, abs=error), row.case


def test_a_mask_of_known_statistics():
    """One state, dependent on the first observation and the first action."""
    seen, acted = np.zeros((1, STATES, OBSERVATIONS)), np.zeros((1, STATES, 2))
    seen[0, 1, CAUSE] = seen[0, 0, FORK] = acted[0, 1, 1] = 0.5
    masked = Statistics(seen, acted).masked(0.1)[0]
    assert masked.tolist() == [place != CAUSE for place in range(OBSERVATIONS)]


def test_large_data_sets_are_fewer():
    config = replace(CONFIG, systems=1000, budget=100_000)
    assert [config.count(n, 1000) for n in (50, 100, 1000, 10**6)] == [1000, 1000, 100, 1]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"trajectories": (4,)}, "trajectories: expected an integer >= 5, got 4"),
        ({"strengths": (1.0,)}, r"strengths: expected numbers in \(0, 1\), got 1.0"),
        ({"systems": 0}, "systems: expected a positive integer, got 0"),
        ({"reaction_horizon": 4}, "reaction_horizon: expected an integer <= 3, got 4"),
        ({"alpha": 2.0}, r"alpha: expected a number in \(0, 1\), got 2.0"),
        ({"thresholds": (-1.0,)}, "thresholds: expected a number >= 0, got -1.0"),
    ],
)
def test_a_wrong_number_is_said(wrong, said):
    with pytest.raises(ValueError, match=said):
        ClaimsConfig(**wrong)
