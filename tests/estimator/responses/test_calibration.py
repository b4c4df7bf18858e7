"""Calibration of one sensor against another: values are found, and errors cover them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator.errors import InsufficientDataError
from estimator.levels.bands import bin_correlation
from estimator.responses.calibration import CommonMotion, SensorCalibration
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.spectra.windows import get_window
from tests.estimator.csm_models import white

FloatArray = NDArray[np.float64]

RATE, LENGTH, N = 50.0, 100, 6000
DIMS = (3, 3, 3)
CORRELATION = bin_correlation(get_window("hann", 512), 256)
TURNED = np.deg2rad(2.0)
TRUE = np.array(
    [[np.cos(TURNED), np.sin(TURNED), 0.0], [-np.sin(TURNED), np.cos(TURNED), 0.0], [0.0, 0.0, 1.0]]
) * np.array([[1.02], [0.97], [1.0]])
"""Turned by 2° about the third axis, with gains."""
DELAY = 2e-3


def averaged(seed: int, *, noise: float = 0.1) -> CrossSpectra:
    rng = np.random.default_rng(seed)
    mixed = np.array([[1.0, 0.3, 0.0], [0.0, 0.7, 0.2], [0.0, 0.0, 0.8]])
    motion = rng.standard_normal((N, 3)) @ mixed
    frequency = np.arange(N // 2 + 1) * RATE / N
    turn = np.exp(-2j * np.pi * frequency * DELAY)[:, None]
    late = np.fft.irfft(np.fft.rfft(motion, axis=0) * turn, N, axis=0)
    parts = [motion, late @ TRUE.T, motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]]
    samples = np.hstack(parts) + noise * rng.standard_normal((N, 9))
    spectra = CrossSpectra(WelchSettings(RATE, LENGTH), 9)
    spectra.add(samples, np.arange(0, N - LENGTH + 1, LENGTH // 2))
    return spectra


def motion_of(spectra: CrossSpectra, factor: FloatArray | float = 1.0) -> CommonMotion:
    csm, frequency = spectra.csm() * factor, spectra.settings.frequencies
    return CommonMotion(csm, frequency, DIMS, 0, spectra.n_effective, CORRELATION)


def calibrated(spectra: CrossSpectra, band: tuple[float, float] = (1.0, 20.0)) -> SensorCalibration:
    return motion_of(spectra).calibrated(1, band)


def test_without_noise_all_values_are_exact() -> None:
    found = calibrated(averaged(1, noise=1e-6))
    # what a delay leaves at the ends of segments: 2 ms of 2 s
    np.testing.assert_allclose(found.matrix.value, TRUE, atol=2e-3)
    np.testing.assert_allclose(found.gain.value, [1.02, 0.97, 1.0], atol=2e-3)
    np.testing.assert_allclose(found.rotation_deg.value, [0, 0, 2.0], atol=0.1)
    np.testing.assert_allclose(found.angle_deg.value, [2.0, 2.0, 0.0], atol=0.1)
    np.testing.assert_allclose(found.orthogonality_deg.value, 0.0, atol=0.1)
    np.testing.assert_allclose(found.delay.value, DELAY, atol=2e-5)
    np.testing.assert_allclose(np.diag(found.cross_axis.value), 1.0)


def test_errors_cover_the_truth() -> None:
    scores: dict[str, list[FloatArray]] = {}
    excess = []
    n_draws = 40
    for seed in range(n_draws):
        found = calibrated(averaged(seed))
        excess.append(found.excess)
        for name, truth in (
            ("matrix", TRUE),
            ("gain", np.array([1.02, 0.97, 1.0])),
            ("rotation_deg", np.array([0.0, 0.0, 2.0])),
            ("delay", np.full(3, DELAY)),
        ):
            value = getattr(found, name)
            scores.setdefault(name, []).append((value.value - truth) / value.error)
    for each in scores.values():
        # standard deviation of a variance of 40 draws of three or more values: 13 to 18 %
        assert np.mean(np.square(each)) == pytest.approx(1.0, abs=0.5)
    assert np.mean(excess) == pytest.approx(1.0, abs=0.1)


def test_weak_motion_does_not_lower_gains() -> None:
    """What instruments tell by chance would, by two thirds of their error at an SNR of 10."""
    scores = [
        (found.gain.value - [1.02, 0.97, 1.0]) / found.gain.error
        for found in (calibrated(averaged(seed, noise=0.35)) for seed in range(30))
    ]
    # 30 draws of three gains that share half of their scatter: 0.14
    assert np.mean(scores) == pytest.approx(0.0, abs=0.35)


def scores(
    seed: int,
    *,
    d: int,
    snr: tuple[float, ...],
    n: int,
    n_freqs: int,
    quantities: tuple[str, ...] = ("gain",),
) -> FloatArray:
    """Return errors over standard errors for equal sensors, from Wishart matrices of n averages."""
    rng = np.random.default_rng(seed)
    p = d * len(snr)
    noise = np.repeat(1 / np.sqrt(snr), d)[:, None]
    motion = white(rng, n_freqs, d, n)
    samples = np.tile(motion, (1, len(snr), 1)) + noise * white(rng, n_freqs, p, n)
    csm = np.asarray(samples @ samples.conj().swapaxes(1, 2) / n, dtype=np.complex128)
    frequency = np.asarray(1.0 + 0.5 * np.arange(n_freqs), dtype=np.float64)
    common = CommonMotion(csm, frequency, (d,) * len(snr), 0, n, np.ones(1))
    found = common.calibrated(1, (0.9, 1.0 + 0.5 * n_freqs))
    truth = {"matrix": np.eye(d), "gain": 1.0, "delay": 0.0}
    return np.concatenate(
        [
            np.ravel(
                (getattr(found, each).value - truth.get(each, 0.0)) / getattr(found, each).error
            )
            for each in quantities
        ]
    )


@pytest.mark.parametrize(("n", "snr"), [(50, (5.0, 1e3, 1e3)), (20, (10.0, 10.0, 10.0))])
def test_noise_of_the_reference_does_not_lower_gains(n: int, snr: tuple[float, ...]) -> None:
    """Weights by each frequency's own residual would, by 1.5 standard errors."""
    found = [scores(seed, d=1, snr=snr, n=n, n_freqs=400) for seed in range(40)]
    # 40 draws of one gain: 0.16
    assert np.mean(found) == pytest.approx(0.0, abs=0.5)


def test_errors_cover_the_truth_with_few_averages() -> None:
    """Residuals of ten averages from three fitted elements are too small by three tenths."""
    quantities = ("matrix", "orthogonality_deg", "delay")
    found = [
        scores(seed, d=3, snr=(100.0,) * 3, n=10, n_freqs=40, quantities=quantities)
        for seed in range(60)
    ]
    # 60 draws of 15 values: 5 % at least; without the correction 1.5
    assert np.mean(np.square(found)) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("n", [9, 14, 18])
def test_many_sensors_and_few_averages_do_not_lower_gains(n: int) -> None:
    found = [scores(seed, d=3, snr=(30.0,) * 5, n=n, n_freqs=60) for seed in range(15)]
    # 15 draws of three gains: 0.15; by chance alone three standard errors
    assert np.mean(found) == pytest.approx(0.0, abs=0.5)


def test_too_few_averages_for_any_instrument_are_refused() -> None:
    with pytest.raises(InsufficientDataError, match="averages are too few"):
        scores(0, d=3, snr=(100.0,) * 3, n=4, n_freqs=60)


def test_a_line_in_the_noise_keeps_its_small_weight() -> None:
    spectra = averaged(5)
    csm, f = spectra.csm(), spectra.settings.frequencies
    usual = calibrated(spectra)
    csm[np.argmin(np.abs(f - 10.0)), 3:6, 3:6] += 1e4 * np.eye(3) * csm[0, 0, 0].real
    motion = CommonMotion(csm, f, DIMS, 0, spectra.n_effective, CORRELATION)
    found = motion.calibrated(1, (1.0, 20.0))
    np.testing.assert_allclose(found.gain.error, usual.gain.error, rtol=0.1)


def test_a_response_that_varies_over_the_band_is_detected() -> None:
    spectra = averaged(3, noise=0.02)
    rising = np.ones((len(spectra.settings.frequencies), 9))
    rising[:, 3:6] += 0.06 * spectra.settings.frequencies[:, None] / 25
    found = motion_of(spectra, rising[:, :, None] * rising[:, None, :]).calibrated(1, (1.0, 20.0))
    assert found.excess > 1.5
    assert found.varies
    rising[:, 3:6] = 1 + (rising[:, 3:6] - 1) / 3  # from .1 to 1.6 %, in a scatter as large
    found = motion_of(spectra, rising[:, :, None] * rising[:, None, :]).calibrated(1, (1.0, 20.0))
    assert 1.05 < found.excess < 1.5
    assert np.all(found.gain.error > 0.5 * 0.02 * 19 / 25 / np.sqrt(12))


def test_curves_follow_the_response() -> None:
    spectra = averaged(4)
    found = motion_of(spectra).curve(1, np.geomspace(1.0, 20.0, 7))
    truth = TRUE * np.exp(-2j * np.pi * found.frequency * DELAY)[:, None, None]
    for part in ("real", "imag"):
        score = (getattr(found.matrix, part) - getattr(truth, part)) / found.error
        assert np.mean(score**2) == pytest.approx(1.0, abs=0.6)


def test_a_band_without_frequencies_is_refused() -> None:
    with pytest.raises(InsufficientDataError):
        calibrated(averaged(1), (10.0, 10.2))
