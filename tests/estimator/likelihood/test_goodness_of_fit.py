"""False alarms where the model holds, detection where it does not."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import scipy

from estimator.errors import InsufficientDataError
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.goodness_of_fit import (
    ModelTest,
    model_test,
    neighbour_correlation,
    pool,
)
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.spectra.windows import effective_averages, get_window
from estimator.types import ComplexArray
from tests.estimator.csm_models import pentagon, plane_waves, random_bench, wishart


def bench(dims: tuple[int, ...], *, snr: float = 1e3) -> ComplexArray:
    return random_bench(np.random.default_rng(1), dims=dims, snr=snr, noise_psd=np.ones(sum(dims)))


@pytest.mark.parametrize(
    ("dims", "degrees"), [((1,) * 3, 1), ((2,) * 3, 10), ((3,) * 3, 27), ((3,) * 5, 129)]
)
@pytest.mark.parametrize("n_averages", [20, 100, pytest.param(1080, marks=pytest.mark.long)])
def test_false_alarms_occur_at_the_one_percent_level(
    dims: tuple[int, ...], degrees: int, n_averages: int
) -> None:
    n_draws = 1500 if len(dims) == 3 else 500
    draws = wishart(bench(dims), n_averages, np.random.default_rng(n_averages), n_draws=n_draws)
    test = model_test(maximise(draws, max(dims)), n_effective=n_averages)
    assert np.all(test.degrees == degrees)
    alarms = np.mean(test.p_value < 0.01)
    scatter = np.sqrt(0.01 * 0.99 / n_draws)
    assert 0.005 - 2 * scatter < alarms < 0.015 + 2 * scatter
    error = np.sqrt(2 / (degrees * n_draws))
    tolerance = 0.03 if n_averages == 20 else 0.01
    assert test.statistic.mean() / degrees == pytest.approx(1, abs=tolerance + 4 * error)


@pytest.mark.long
@pytest.mark.parametrize("n_averages", [4, 6])
def test_estimated_noise_lowers_the_statistic_as_predicted(n_averages: int) -> None:
    """Without motion psi is the diagonal, and Bartlett's factor exact to order 1/n**3.

    Its term 1 / (6 n) is 2 and 1.4 % of the mean here, the error of the mean 0.25 %.
    """
    draws = wishart(
        np.eye(3, dtype=np.complex128), n_averages, np.random.default_rng(8), n_draws=60_000
    )
    test = model_test(maximise(draws, 0), n_effective=n_averages)
    assert np.all(test.degrees == 6)
    assert test.statistic.mean() / 6 == pytest.approx(1, abs=0.008)


def test_correlation_of_neighbouring_bins_by_closed_form() -> None:
    """Hann, no overlap: amplitudes 2/3 and 1/6; rectangular: none."""
    hann = neighbour_correlation(get_window("hann", 256), 256, 100)
    np.testing.assert_allclose(hann, [(2 / 3) ** 2, (1 / 6) ** 2], rtol=1e-10)
    assert len(neighbour_correlation(np.ones(256), 256, 100)) == 0


@pytest.mark.long
@pytest.mark.parametrize("overlap", [0.5, 0.75])
def test_pooled_false_alarms_under_a_taper(overlap: float) -> None:
    """White motion and noise through real Hann segments; bands of 20 bins."""
    rng = np.random.default_rng(4)
    settings = WelchSettings(sampling_rate=1.0, segment_length=64 * 20, overlap=overlap)
    n_segments = 300
    mixing = np.linalg.cholesky(bench((2, 2, 2)).real)
    statistic = []
    for _ in range(6):
        n_samples = settings.segment_length + (n_segments - 1) * settings.hop
        spectra = CrossSpectra(settings, 6)
        samples = rng.standard_normal((n_samples, 6)) @ mixing.T
        spectra.add(samples, np.arange(n_segments, dtype=np.int64) * settings.hop)
        n_effective = spectra.n_effective
        maximum = maximise(spectra.csm()[5:-5], 2)
        statistic.append(model_test(maximum, n_effective=n_effective).statistic)
    window = get_window("hann", settings.segment_length)
    assert n_effective == pytest.approx(effective_averages(window, settings.hop, n_segments))
    r = neighbour_correlation(window, settings.hop, n_segments)
    runs = np.array(statistic)
    p_values = []
    for run in runs:
        test = ModelTest(run, np.full(len(run), 10.0))
        for first in range(0, len(run) - 20, 20):
            band = np.zeros(len(run), np.bool_)
            band[first : first + 20] = True
            p_values.append(pool(test, band, neighbours=r).p_value)
    assert len(p_values) > 150
    assert scipy.stats.kstest(p_values, "uniform").pvalue > 1e-3
    centred = runs / runs.mean() - 1
    for h in (1, 2):
        seen = np.mean(centred[:, h:] * centred[:, :-h]) / np.mean(centred**2)
        assert seen == pytest.approx(r[h - 1] ** 2, abs=4 / np.sqrt(runs.size))


def three_sensor_bias(csm: ComplexArray) -> float:
    """Mean fractional bias of eq. (29) over all channels and orders of three triaxial sensors."""
    blocks = csm.reshape(3, 3, 3, 3).swapaxes(1, 2)
    left = [
        np.diag(blocks[i, i] - blocks[i, k] @ np.linalg.inv(blocks[j, k]) @ blocks[j, i]).real
        for i, j, k in permutations(range(3))
    ]
    return float(np.mean(left)) - 1


def test_incoherence_with_half_the_noise_as_bias_is_detected_in_an_octave() -> None:
    """Ten-second segments: 50 bins from 5 to 10 Hz, Hann at 50 % overlap."""
    positions = pentagon()[:3]

    def excess(snr: float) -> float:
        return three_sensor_bias(plane_waves(np.array([7.0]), positions, snr=snr)[0]) - 0.5

    snr = scipy.optimize.brentq(excess, 1.0, 1e6)
    csm = plane_waves(np.array([7.0]), positions, snr=float(snr))[0]
    n_octaves = 100
    rng = np.random.default_rng(5)
    # Correlated neighbours carry less: as independent bins, the octave has 50 / spread of them.
    draws = wishart(csm, 1080, rng, n_draws=n_octaves * 35)
    test = model_test(maximise(draws, 3), n_effective=1080)
    seen = 0
    for octave in range(n_octaves):
        band = np.arange(n_octaves * 35) // 35 == octave
        seen += pool(test, band).p_value < 0.01
    assert seen >= 0.99 * n_octaves


def test_a_gross_violation_is_detected_at_one_frequency() -> None:
    csm = plane_waves(np.array([20.0]), pentagon()[:3], snr=1e3)[0]
    assert three_sensor_bias(csm) > 1.9
    draws = wishart(csm, 1080, np.random.default_rng(6), n_draws=200)
    assert np.all(model_test(maximise(draws, 3), n_effective=1080).p_value < 0.01)


def test_an_unusable_frequency_is_not_pooled() -> None:
    test = ModelTest(np.array([10.0, np.nan, 12.0]), np.full(3, 10.0))
    band = pool(test, np.ones(3, np.bool_))
    assert band.n_frequencies == 2
    assert band.statistic == 22
    assert 0 < band.p_value < 1
    assert np.isnan(pool(test, np.array([False, True, False])).p_value)


def test_pooling_allows_for_correlated_neighbours() -> None:
    """Amplitudes correlated by 0.5 and statistics by its square: the sum of 10 is that of fewer."""
    test = ModelTest(np.full(10, 13.0), np.full(10, 10.0))
    spread = 1 + 2 * 9 * 0.5**2 / 10
    band = pool(test, np.ones(10, np.bool_), neighbours=np.array([0.5]))
    assert band.p_value == pytest.approx(scipy.stats.chi2.sf(130 / spread, 100 / spread))


def test_a_model_without_degrees_of_freedom_is_refused() -> None:
    draws = wishart(bench((3, 3, 3)), 50, np.random.default_rng(7))
    with pytest.raises(InsufficientDataError, match="no freedom left"):
        model_test(maximise(draws, 6), n_effective=50)
    with pytest.raises(InsufficientDataError, match="averages"):
        model_test(maximise(draws, 3), n_effective=9)
    for n in (np.nan, np.inf, -1):
        with pytest.raises(InsufficientDataError, match="finite number above zero"):
            model_test(maximise(draws, 3), n_effective=n)
