"""The bins that detrending bends are in no band, curve, verdict or answer."""

from __future__ import annotations

import numpy as np
import pytest

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.results.band_summary import Spectrum, band_of
from estimator.levels.bands import third_octaves
from estimator.spectra.welch import CrossSpectra, WelchSettings

RATE, LENGTH = 50.0, 200


@pytest.mark.parametrize(
    ("window", "detrend", "lowest", "taken"),
    [
        ("hann", "none", 0, 0.0),
        ("hann", "constant", 2, 1 / 6),
        ("hann", "linear", 2, 0.28065),  # numerically, by projecting cosines on a line
        ("boxcar", "constant", 1, 0.0),
        ("blackmanharris", "constant", 3, 0.2311),
    ],
)
def test_bins_that_white_noise_shows_too_low_are_named(
    window: str, detrend: str, lowest: int, taken: float
) -> None:
    settings = WelchSettings(RATE, LENGTH, 0.5, window, detrend)  # type: ignore[arg-type]
    assert settings.lowest == settings.frequencies[lowest]
    n_segments = 8000
    samples = np.random.default_rng(6).standard_normal((LENGTH * (n_segments + 1) // 2, 2))
    spectra = CrossSpectra(settings, 2)
    spectra.add(samples, np.arange(n_segments) * settings.hop)
    psd = np.einsum("fpp->f", spectra.csm()).real * RATE / 4
    assert psd[1] == pytest.approx(1 - taken, abs=4 / np.sqrt(n_segments))
    assert psd[max(lowest, 1) : -1] == pytest.approx(1.0, abs=5 / np.sqrt(n_segments))


@pytest.mark.parametrize(("detrend", "slope"), [("constant", -0.5), ("linear", 0.0)])
def test_the_lowest_level_is_that_of_the_noise(detrend: str, slope: float) -> None:
    """White noise, and noise whose PSD falls with frequency, under ten times as much motion."""
    rng, n_samples = np.random.default_rng(7), 2000 * LENGTH
    frequency = np.fft.rfftfreq(n_samples, 1 / RATE)
    shape = np.maximum(frequency, 0.05) ** slope

    def coloured(size: float) -> np.ndarray:
        white = np.fft.rfft(rng.standard_normal(n_samples))
        return np.asarray(size * np.fft.irfft(white * shape, n_samples))

    motion = coloured(np.sqrt(10.0))
    arrays = {name: (motion + coloured(1.0))[:, None] for name in "ABC"}
    settings = Settings(
        segment=LENGTH / RATE,
        detrend=detrend,  # type: ignore[arg-type]  # of the parameters
        methods=("three-sensor",),
    )
    snapshot = estimate([recording_of_arrays(arrays, sampling_rate=RATE)], settings)
    noise = snapshot.results["three-sensor"]
    lowest = 2
    assert np.isnan(snapshot.data_psd[:lowest]).all()
    assert np.isnan(noise.noise_psd[:lowest]).all()
    assert np.isfinite(noise.noise_psd[lowest:-1]).all()
    band = band_of(settings, snapshot)
    assert band[0] == snapshot.frequency[lowest]
    edges = third_octaves(snapshot.frequency, *band)[:2]
    found = Spectrum(noise, snapshot, settings).levels(edges)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(LENGTH) / LENGTH)
    kernel = (
        np.abs(np.fft.rfft(window * np.cos(4 * np.pi * np.arange(LENGTH) / LENGTH), n_samples)) ** 2
    )
    truth = 2 / RATE * (kernel @ shape**2) / kernel.sum()
    low, high = found.ends(3.5)
    assert found.of_scatter.complete.all()
    assert ((low < truth) & (truth < high)).all()


@pytest.mark.parametrize(("detrend", "power", "size"), [("constant", 1, 1e4), ("linear", 2, 3e6)])
def test_what_drifts_within_segments_leak_is_in_the_interval(
    detrend: str, power: int, size: float
) -> None:
    """A drift has no noise at these frequencies: it leaks there through the window."""
    rng, n_samples = np.random.default_rng(8), 100 * LENGTH
    motion = 10.0 * rng.standard_normal((n_samples, 1))
    arrays = {name: motion + rng.standard_normal((n_samples, 1)) for name in "ABC"}
    arrays["B"][:, 0] += size * np.linspace(-1, 1, n_samples) ** power
    settings = Settings(
        segment=LENGTH / RATE,
        detrend=detrend,  # type: ignore[arg-type]  # of the parameters
        axis_tolerance={"": 0.0},
    )
    snapshot = estimate([recording_of_arrays(arrays, sampling_rate=RATE)], settings)
    noise = next(iter(snapshot.results.values()))
    edges = np.searchsorted(snapshot.frequency, [3.5 * RATE / LENGTH, 6.5 * RATE / LENGTH, 20.0])
    found = Spectrum(noise, snapshot, settings).levels(edges)
    low, high = found.ends()
    truth = 2 / RATE
    assert found.mean[0, 1] > 2 * truth
    assert (low < truth).all()
    assert (high > truth).all()
    assert low[1].min() > 0.8 * truth  # nothing is added where a drift leaks little
