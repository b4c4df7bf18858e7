"""The uncertainty of a band's mean is that of simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daq.results.band_summary import band_of
from daq.results.result import Result
from estimator.levels.bands import band_edges, band_levels, bin_correlation, log_edges, widths
from estimator.levels.contributions import Source, contribution, up_to, widened
from estimator.levels.interval import like_psd
from estimator.median import median_of_columns
from tests.tui.example_snapshot import SETTINGS, made_snapshot
from tui.output.results import result_table, result_title


@pytest.mark.parametrize(("name", "overlap"), [("hann", 0.5), ("rectangular", 0.0), ("hann", 0.75)])
def test_cov_of_a_band_mean_agrees_with_simulated_periodograms(name: str, overlap: float) -> None:
    rng = np.random.default_rng(5)
    length, n_segments, n_runs = 64, 40, 1500
    hop = round(length * (1 - overlap))
    window = np.hanning(length + 1)[:-1] if name == "hann" else np.ones(length)
    samples = rng.standard_normal((n_runs, length + hop * (n_segments - 1)))
    segments = np.lib.stride_tricks.sliding_window_view(samples, length, axis=1)[:, ::hop]
    psd = (np.abs(np.fft.rfft(segments * window)) ** 2).mean(axis=1)
    edges = np.array([4, 28])
    truth = psd[:, 4:28].mean(axis=1)
    cov_of_bin = psd[:, 4:28].std(axis=0).mean() / truth.mean()

    scatter = like_psd(psd[0], cov_of_bin * psd[0])[:, :, None]
    found = band_levels(psd[0][:, None], scatter, edges, bin_correlation(window, hop))

    # The standard deviation of n_runs draws is known to 1 / sqrt(2 n_runs) = 1.8 %.
    cov = found.spread[0, 0] / found.mean[0, 0]
    assert cov == pytest.approx(truth.std() / truth.mean(), rel=0.08)
    assert found.mean[0, 0] == pytest.approx(truth[0])
    # Gamma variables: as skew as the mean of so many independent bins
    skewness = 2 * found.cumulants[1] / found.spread**3
    assert skewness[0, 0] == pytest.approx(2 * cov, rel=0.15)


def test_hann_bins_are_correlated_as_in_theory() -> None:
    window = np.hanning(257)[:-1]
    np.testing.assert_allclose(
        bin_correlation(window, 256)[:4], [1, (2 / 3) ** 2, (1 / 6) ** 2, 0], atol=1e-12
    )


def test_few_bins_of_a_sloping_spectrum_are_its_mean() -> None:
    """A third of the bins, at constant ratios: every known bin counts for unknown neighbours."""
    frequency = np.arange(0.1, 50.05, 0.1)
    kept = np.unique(np.round(np.geomspace(1, 500, 250)).astype(int)) - 1
    psd = np.where(np.isin(np.arange(500), kept), frequency**-1.2, np.nan)[:, None]
    edges, known = np.array([19, 60, 200]), np.isfinite(psd)
    scatter = like_psd(psd, 0.1 * psd)
    weights = widths(frequency, known, edges)
    found = band_levels(psd, scatter, edges, np.ones(1), weights=weights)
    whole = [(frequency[low:high] ** -1.2).mean() for low, high in ((19, 60), (60, 200))]
    np.testing.assert_allclose(found.mean[:, 0], whole, rtol=0.02)
    assert not weights[~known].any()


def test_what_is_known_beyond_a_band_leaves_it_as_it_is() -> None:
    frequency = np.arange(0.0, 10.1, 0.1)
    known = ((frequency < 3) | (frequency > 8))[:, None]
    weights = widths(frequency, known, np.array([10, 41, 101]))
    np.testing.assert_allclose(weights[10:30, 0], 0.1)
    np.testing.assert_allclose(weights[81:100, 0], 0.1)


def test_bins_with_nan_are_ignored_and_negative_means_remain_negative() -> None:
    psd = np.array([1.0, np.nan, 3.0, -2.0, -4.0, np.nan])[:, None]
    scatter = like_psd(np.abs(psd), 0.1 * np.abs(psd))
    found = band_levels(psd, scatter, np.array([0, 3, 5, 6]), np.array([1.0, 0.0]))
    np.testing.assert_allclose(found.mean[:, 0], [2.0, -3.0, np.nan])
    spread = np.array([np.hypot(0.1, 0.3), np.hypot(0.2, 0.4)]) / 2
    np.testing.assert_allclose(found.spread[:2, 0], spread)
    assert found.complete[:, 0].tolist() == [False, True, False]
    low, high = found.interval()
    assert 1.96 * spread[0] < high[0, 0] - 2 < 1.2 * 1.96 * spread[0]  # asymmetric
    assert low[1, 0] < -3
    assert np.isnan(high[2, 0])


def test_bands_exclude_zero_frequency_and_nyquist() -> None:
    frequency = np.linspace(0, 100, 1001)
    assert band_edges(frequency, (0.01, 1000)).tolist() == [1, 1000]
    assert frequency[slice(*band_edges(frequency, (1.0, 20.0)))][[0, -1]].tolist() == [1.0, 20.0]
    edges = log_edges(frequency, 70)
    assert edges[0] == 1
    assert edges[-1] == 1000
    assert np.all(np.diff(edges) > 0)
    with pytest.raises(ValueError, match="no frequency between"):
        band_edges(frequency, (120.0, 130.0))


@pytest.mark.parametrize("asked", [(10.0, 98.0), None])
def test_a_band_without_estimates_is_nan(asked: tuple[float, float] | None) -> None:
    snapshot, settings = made_snapshot(), replace(SETTINGS, band=asked)
    snapshot.csm[snapshot.frequency > 80] = np.nan  # resampled
    assert band_of(settings, snapshot)[1] == 80
    title = result_title(Result(snapshot, settings))
    assert "to 80 Hz" in title
    assert ("(98 requested)" in title) == (asked is not None)
    assert "?" not in [row[2] for row in result_table(Result(snapshot, settings)).rows]


def test_a_band_without_deviations_keeps_its_mean() -> None:
    snapshot = made_snapshot()
    snapshot.csm[snapshot.frequency > 80] = np.nan
    assert band_of(replace(SETTINGS, band=(85.0, 95.0)), snapshot) == (85.0, 95.0)


def test_median_of_columns_agrees_with_numpy() -> None:
    rng = np.random.default_rng(2)
    for n_rows in (1, 2, 7, 8):
        values = rng.normal(size=(n_rows, 5))
        values[rng.random(values.shape) < 0.3] = np.nan
        values[0, 0] = 1.0  # columns 0 and 1 have a number and none
        values[:, 1] = np.nan
        found = median_of_columns(values)
        for column, median in zip(values.T, found, strict=True):
            known = column[~np.isnan(column)]
            np.testing.assert_array_equal(median, np.median(known) if known.size else np.nan)
        assert np.isnan(found[1])
    assert np.isnan(median_of_columns(np.empty((0, 3)))).all()


def test_shares_elsewhere_do_not_shrink_beside_bins_that_only_a_bound_tells() -> None:
    """Level 1 within a half, and 10 within 0 and 20, of two causes: mean within 0.25 and 10.75."""
    level, bound, edges = np.array([[1.0], [10.0]]), np.array([[1.0], [20.0]]), np.array([0, 2])
    shares = ([[0.5], [np.inf]], [[0.0], [np.inf]])
    parts = [contribution(Source.MISFIT, (2, 1), share=np.array(each)) for each in shares]
    where, inside = np.array([[False], [True]]), np.ones((2, 1), np.bool_)
    found = [
        each.in_bands(edges, np.ones((2, 1)), level)
        for each in up_to(parts, bound, where, level, inside)
    ]
    mean = level.mean(axis=0)[None]
    low, high = widened(mean, mean, found)
    assert low[0, 0] == pytest.approx(0.25)
    assert high[0, 0] == pytest.approx(10.75)
