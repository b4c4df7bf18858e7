"""The interval where its exact form is known, and spectra that are real-valued."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from estimator.levels.interval import cumulants, interval
from estimator.methods import METHODS, self_noise
from estimator.spectra.welch import WelchSettings
from tests.estimator.csm_models import common_motion


@pytest.mark.parametrize("n", [10, 20, 100, 1080])
def test_the_interval_of_a_psd_is_chi_squared(n: int) -> None:
    """Either end by itself, to second order of Cornish and Fisher's expansion, 1 / n."""
    low, high = interval(np.ones(1), cumulants(np.ones((3, 1)), n))
    exact = 2 * n / scipy.stats.chi2.ppf([0.975, 0.025], 2 * n)
    np.testing.assert_allclose([low[0], high[0]], exact, rtol=0.15 / n)


def test_an_estimate_whose_variance_comes_out_negative_has_no_ends() -> None:
    """It had an interval of no width: the triad of three-sensor is singular there."""
    low, high = interval(np.ones(2), np.array([[0.0, -0.1], [0.0, 0.1], [0.0, 0.1]]))
    np.testing.assert_equal([low, high], [[1.0, -np.inf], [1.0, np.inf]])


def test_an_estimated_scatter_gives_the_interval_of_student() -> None:
    """Cross-spectrum of two independent channels: symmetric, of n degrees of freedom."""
    n = 30
    traces = np.array([[0.5], [0.0], [0.125]])  # eigenvalues +- 1/2 of omega G
    low, high = interval(np.zeros(1), cumulants(traces, n))
    assert high[0] == -low[0]
    quantile = scipy.stats.t.ppf(0.975, n)
    kappa = quantile**2 / n
    # the variance grows with the value sought: delta**2 = kappa (t2 + t4 / t2**2 delta**2)
    assert high[0] == pytest.approx(np.sqrt(0.5 * kappa / (1 - 0.5 * kappa)), rel=3e-3)


@pytest.mark.parametrize("averages", [0.2, 0.5, 1.0])
def test_too_few_averages_give_an_infinite_upper_end(averages: float) -> None:
    low, high = interval(np.ones(1), cumulants(np.ones((3, 1)), averages))
    assert 0 < low[0] < 1
    assert np.isinf(high[0])


@pytest.mark.parametrize("method", METHODS)
def test_real_spectra_have_twice_the_variance(method: str) -> None:
    """Averages of squares of real amplitudes, as at 0 Hz and the Nyquist frequency."""
    n, n_draws = 100, 3000
    csm = common_motion(np.tile(np.eye(2), (3, 1)), np.ones(6), snr=1e3).real
    amplitudes = np.random.default_rng(0).standard_normal((n_draws, n, 6))
    amplitudes @= np.linalg.cholesky(csm).T
    sample = (amplitudes.swapaxes(1, 2) @ amplitudes / n).astype(np.complex128)
    real = np.arange(n_draws) % 2 == 0
    found = self_noise(method, sample, dims=(2, 2, 2), n_effective=n, real=real)
    scatter = found.noise_psd.std(axis=0)
    # a deviation of 3000 draws has 1.5 % standard error
    deviation = found.cov * np.abs(found.noise_psd)
    np.testing.assert_allclose(np.nanmedian(deviation[real], axis=0), scatter, rtol=0.06)
    np.testing.assert_allclose(np.nanmedian(deviation[~real], axis=0), scatter / 2**0.5, rtol=0.06)
    covers = (found.low < 1) & (found.high > 1)
    assert 0.93 < covers[real].mean() < 0.97
    assert (found.low[real] >= 1).mean() < 0.035
    assert (found.high[real] <= 1).mean() < 0.035
    assert covers[~real].mean() < 0.90
    error = scatter / np.sqrt(n_draws)
    assert np.all(np.abs(found.noise_psd.mean(axis=0) - 1) < 4 * error)


def test_a_real_spectrum_also_widens_an_interval_below_zero() -> None:
    csm = np.full((2, 3, 3), 0.5, dtype=np.complex128)
    csm += 0.5 * np.eye(3)
    csm[:, 0, 1:] = csm[:, 1:, 0] = 0.68
    found = self_noise(
        "three-channel", csm, dims=(1, 1, 1), n_effective=30, real=np.array([True, False])
    )
    wide, usual = (found.noise_psd[row, 0] - found.low[row, 0] for row in (0, 1))
    assert found.low[1, 0] < 0
    assert np.sqrt(2) * usual < wide < 2 * usual
    open_above = self_noise(
        "three-channel", csm, dims=(1, 1, 1), n_effective=1.5, real=np.array([True, False])
    )
    assert np.all(np.isinf(open_above.high))
    assert np.all(open_above.low < open_above.noise_psd)


@pytest.mark.parametrize(("length", "n_real"), [(64, 2), (63, 1), (1999, 1), (2000, 2)])
def test_real_spectra_are_those_at_zero_and_nyquist(length: int, n_real: int) -> None:
    settings = WelchSettings(0.3, length)
    real = settings.real(settings.frequencies)
    assert real.sum() == n_real
    assert real[0]
    assert real[-1] == (n_real == 2)
