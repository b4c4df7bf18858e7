"""The chi-square distribution and digamma against those of scipy."""

from __future__ import annotations

import math
import sys

import pytest
from scipy import special

from estimator.likelihood.goodness_of_fit import critical_value, digamma, trigamma, upper_tail

DEGREES = [0.3, 1.0, 2.0, 7.5, 27.0, 100.0, 433.3, 2000.0, 9000.0, 40000.0]


SHARES = [0, 1e-3, 0.1, 0.5, 0.9, 0.99, 1, 1.01, 1.1, 1.5, 2, 5, 10]


@pytest.mark.parametrize("degrees", DEGREES)
def test_tail_agrees_with_scipy(degrees: float) -> None:
    # x**a exp(-x) loses as many digits as its exponent has
    tolerance = 1e-13 + 10 * sys.float_info.epsilon * degrees * math.log(degrees + 2)
    expected = [special.chdtrc(degrees, degrees * share) for share in SHARES]
    found = [upper_tail(degrees, degrees * share) for share in SHARES]
    assert found == pytest.approx(expected, rel=tolerance, abs=1e-290)


@pytest.mark.parametrize(
    ("statistic", "expected"), [(-1.0, 1.0), (0.0, 1.0), (math.inf, 0.0), (math.nan, math.nan)]
)
def test_the_tail_is_correct_at_its_ends(statistic: float, expected: float) -> None:
    assert upper_tail(3.0, statistic) == pytest.approx(expected, nan_ok=True)


def test_the_tail_of_nan_is_nan() -> None:
    assert math.isnan(upper_tail(math.nan, 1.0))


@pytest.mark.parametrize("degrees", DEGREES[1:8])
def test_critical_value_agrees_with_scipy(degrees: float) -> None:
    probabilities = [0.5, 0.01, 0.01 / 3, 1e-9]
    expected = [special.chdtri(degrees, probability) for probability in probabilities]
    found = [critical_value(degrees, probability) for probability in probabilities]
    assert found == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("x", [0.1, 1.0, 1.5, 4.2, 9.99, 10.0, 37.3, 1080.0, 1e6])
def test_digamma_agrees_with_scipy(x: float) -> None:
    assert digamma(x) == pytest.approx(special.digamma(x), rel=1e-13, abs=1e-14)
    assert trigamma(x) == pytest.approx(special.polygamma(1, x), rel=1e-13)
