"""How many samples a dependence takes. References: the law near independence in closed form, and
data sets drawn at random."""

import numpy as np
import pytest

import jaxdeconf as jd
from jaxdeconf.independence.power import detection_power, least_strength, moments
from jaxdeconf.mask import MaskConfig


def drawn(strength, n, count, seed):
    """D of so many data sets of a Gaussian pair."""
    random = np.random.default_rng(seed)
    x, rest = random.normal(size=(2, count, n))
    return np.array(
        [
            jd.hoeffding_d(a, strength * a + (1 - strength**2) ** 0.5 * b)
            for a, b in zip(x, rest, strict=True)
        ]
    )


def test_near_independence_d_is_its_closed_form():
    """30 E (rho phi phi)^2 of two normal variables is 30 rho^2 / (12 pi^2)."""
    for strength in (0.001, 0.01):
        assert moments(strength)[0] / strength**2 == pytest.approx(2.5 / np.pi**2, rel=2e-3)


def test_the_moments_are_those_of_data():
    d, variance = moments(0.5)
    found = drawn(0.5, 300, 400, seed=0)
    assert found.mean() == pytest.approx(d, abs=3 * (variance / 300 / 400) ** 0.5)
    assert found.std() == pytest.approx((variance / 300) ** 0.5, rel=0.12)


@pytest.mark.parametrize(
    ("strength", "tests", "power"), [(0.3, 36, 0.9), (0.5, 36, 0.5), (0.7, 200, 0.9)]
)
def test_as_many_as_are_required_show_it(strength, tests, power):
    n = jd.required_trajectories(strength, tests, power)
    level = max(MaskConfig.threshold, jd.threshold(n, tests))
    seen = (drawn(strength, n, 600, seed=tests) > level).mean()
    # Three standard errors of the draws, and two points for the first order in 1 / N.
    assert seen == pytest.approx(power, abs=0.02 + 3 * (power * (1 - power) / 600) ** 0.5)


def test_one_fewer_does_not_and_one_more_does():
    for strength, tests in ((0.2, 24), (0.6, 1)):
        n = jd.required_trajectories(strength, tests)
        assert detection_power(strength, n, tests) >= 0.9 > detection_power(strength, n - 1, tests)


def test_the_least_strength_is_the_inverse():
    for n in (30, 300, 3000):
        assert jd.required_trajectories(least_strength(n, 36), 36) == pytest.approx(n, rel=0.002)


def test_it_takes_more_for_weaker_ones_more_tests_and_more_power():
    least = jd.required_trajectories(0.3, 24)
    assert least < jd.required_trajectories(0.2, 24)
    assert least < jd.required_trajectories(0.3, 240)
    assert least < jd.required_trajectories(0.3, 24, power=0.99)
    assert least < jd.required_trajectories(0.3, 24, alpha=0.001)
    assert least == jd.required_trajectories(
        0.3, 24, threshold=0.0
    )  # gamma is below the tests' own


def test_the_defaults_are_those_of_a_mask():
    named = jd.required_trajectories.__defaults__
    assert named == (0.9, MaskConfig.alpha, MaskConfig.threshold)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((0.05, 24), "strength: expected more than 0.0628, which threshold 0.001 hides from any "),
        ((1.0, 24), r"strength: expected a correlation in \(0, 1\), got 1.0"),
        ((0.5, 0), "tests: expected a positive integer, got 0"),
        ((0.5, 24, 1.0), r"power: expected a probability in \(0, 1\), got 1.0"),
        ((0.5, 24, 0.9, 0.0), r"alpha: expected a probability in \(0, 1\), got 0.0"),
        ((0.5, 24, 0.9, 0.05, -1), "threshold: expected a number >= 0, got -1"),
    ],
)
def test_what_cannot_be_asked_is_said(arguments, said):
    with pytest.raises(ValueError, match=said):
        jd.required_trajectories(*arguments)


def test_a_weak_dependence_is_seen_where_no_gamma_hides_it():
    assert jd.required_trajectories(0.05, 24, threshold=0.0) > 5000
