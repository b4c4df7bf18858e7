"""The interval where its exact form is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from estimator.uncertainty import score_interval


@pytest.mark.parametrize("n", [10, 20, 100, 1080])
def test_of_a_mere_psd_it_is_the_chi_squared_interval(n: int) -> None:
    """Either end by itself, to second order of Cornish and Fisher's expansion, 1 / n."""
    low, high = score_interval(np.ones(1), np.ones((3, 1)), averages=n)
    exact = 2 * n / stats.chi2.ppf([0.975, 0.025], 2 * n)
    np.testing.assert_allclose([low[0], high[0]], exact, rtol=0.15 / n)


@pytest.mark.parametrize("averages", [0.2, 0.5, 1.0])
def test_too_few_averages_leave_it_open_above(averages: float) -> None:
    low, high = score_interval(np.ones(1), np.ones((3, 1)), averages=averages)
    assert 0 < low[0] < 1
    assert np.isinf(high[0])
