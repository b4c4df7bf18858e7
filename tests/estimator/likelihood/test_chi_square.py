"""The chi-square tail and digamma against those of scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from estimator.likelihood.chi_square import digamma, upper_tail

DEGREES = [0.3, 1.0, 2.0, 7.5, 27.0, 100.0, 433.3, 2000.0, 9000.0, 40000.0]


@pytest.mark.parametrize("degrees", DEGREES)
def test_tail_is_that_of_scipy(degrees: float) -> None:
    share = np.array([0, 1e-3, 0.1, 0.5, 0.9, 0.99, 1.0, 1.01, 1.1, 1.5, 2.0, 5.0, 10.0])
    expected = special.chdtrc(degrees, degrees * share)
    # x**a exp(-x) loses as many digits as its exponent has
    tolerance = 1e-13 + 10 * np.finfo(float).eps * degrees * np.log(degrees + 2)
    found = upper_tail(degrees, degrees * share)
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=1e-290)


def test_tail_of_many_degrees_at_once() -> None:
    degrees, statistic = np.meshgrid(DEGREES[:6], np.geomspace(1e-2, 1e3, 40))
    expected = special.chdtrc(degrees, statistic)
    np.testing.assert_allclose(upper_tail(degrees, statistic), expected, rtol=1e-11, atol=1e-290)


def test_ends_of_the_tail() -> None:
    found = upper_tail([3.0, 3.0, 3.0, 3.0, np.nan], [-1.0, 0.0, np.inf, np.nan, 1.0])
    np.testing.assert_array_equal(found, [1.0, 1.0, 0.0, np.nan, np.nan])


@pytest.mark.parametrize("x", [0.1, 1.0, 1.5, 4.2, 9.99, 10.0, 37.3, 1080.0, 1e6])
def test_digamma_is_that_of_scipy(x: float) -> None:
    assert digamma(x) == pytest.approx(special.digamma(x), rel=1e-13, abs=1e-14)
