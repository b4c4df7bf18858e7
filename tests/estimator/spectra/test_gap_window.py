"""Segments with gaps: the window, its energy, and the noise it brings in."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.self_noise.three_sensor import three_sensor
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.spectra.windows import WindowLeakage, gap_window, get_window, without_trend
from tests.estimator.csm_models import rotation

LENGTH = 512
BLOCK = 5


def test_the_window_is_zero_in_gaps_and_one_away_from_them() -> None:
    usable = np.ones(100, dtype=np.bool_)
    usable[40:50] = False
    window = gap_window(usable, 100)
    assert np.all(window[40:50] == 0)
    assert np.all(window[:36] == 1)
    assert np.all(window[54:] == 1)
    assert np.all((window[36:40] > 0) & (window[36:40] < 1))
    np.testing.assert_allclose(window[50:54], window[39:35:-1])
    assert np.all(gap_window(np.ones(9, dtype=np.bool_), 100) == 1)
    assert np.all(gap_window(np.zeros(9, dtype=np.bool_), 100) == 0)


@pytest.mark.parametrize("detrend", ["constant", "linear"])
def test_trends_are_fitted_to_present_samples(detrend: str) -> None:
    usable = np.ones(200, dtype=np.bool_)
    usable[50:80] = False
    line = 3.0 + (0.1 * np.arange(200.0) if detrend == "linear" else 0.0)
    samples = np.column_stack([np.broadcast_to(line, 200), -np.broadcast_to(line, 200)])
    samples[~usable] = np.nan
    left = without_trend(samples, gap_window(usable, 200), detrend)
    np.testing.assert_allclose(left, 0, atol=1e-12)


def test_many_missing_blocks_cause_no_bias() -> None:
    """5 % of the blocks of each of three sensors, so that no segment is whole."""
    rng = np.random.default_rng(3)
    n = LENGTH * 60
    directions = np.concatenate([rotation(rng, 3) for _ in range(3)])
    samples = 100 * rng.standard_normal((n, 3)) @ directions.T + rng.standard_normal((n, 9))
    lost = (rng.random((3, n // BLOCK + 1)) < 0.05).any(axis=0)
    usable = ~np.repeat(lost, BLOCK)[:n]
    samples[~usable] = 1e9
    settings = WelchSettings(2.0, LENGTH)  # noise PSD 1
    spectra = CrossSpectra(settings, 9)
    leakage = WindowLeakage(get_window("hann", LENGTH))
    for start in range(0, n - LENGTH + 1, LENGTH // 2):
        span = slice(start, start + LENGTH)
        weight = gap_window(usable[span], LENGTH)
        segment = without_trend(samples[span], weight, "constant")
        spectra.add(segment / np.sqrt(leakage.add(weight)), np.zeros(1, np.int64))
    found = three_sensor(spectra.csm(), dims=(3, 3, 3), n_effective=spectra.n_effective)
    noise, cov = found.noise_psd[2:-2], found.cov[2:-2]
    assert 0.2 < leakage.lost < 0.6
    # Neighbouring bins are correlated, and channels of a sensor are not: 255 / 2 bins of 9.
    assert noise.mean() == pytest.approx(1, abs=4 * np.median(cov) / np.sqrt(noise.size / 2))
    assert np.std(noise) == pytest.approx(np.median(cov), rel=0.1)
    covered = ((found.low < 1) & (found.high > 1))[2:-2].mean()
    assert covered == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / (noise.size / 2)))
    assert np.abs(leakage.bias(found.noise_psd)).mean() < 0.05


def test_the_leakage_is_computed() -> None:
    """Noise that falls by 40 dB: in its quiet half much of it comes from the loud half."""
    rng = np.random.default_rng(5)
    frequency = np.fft.rfftfreq(LENGTH, 0.5)
    level = np.where(frequency < 0.3, 1.0, 1e-4)
    window = get_window("hann", LENGTH)
    leakage = WindowLeakage(window)
    power = np.zeros(len(frequency))
    whole = np.zeros(len(frequency))
    for _ in range(400):
        spectrum = np.fft.rfft(rng.standard_normal(4 * LENGTH))
        fine = np.interp(np.fft.rfftfreq(4 * LENGTH, 0.5), frequency, level)
        noise = np.fft.irfft(spectrum * np.sqrt(fine))[LENGTH : 2 * LENGTH]
        usable = ~np.repeat(rng.random(LENGTH // BLOCK + 1) < 0.1, BLOCK)[:LENGTH]
        weight = gap_window(usable, LENGTH)
        energy = leakage.add(weight)
        power += np.abs(np.fft.rfft(noise * weight * window)) ** 2 / energy
        whole += np.abs(np.fft.rfft(noise * window)) ** 2
    true = (power - whole) / power
    found = leakage.bias((power / power[5:50].mean())[:, None])[:, 0]
    quiet = (frequency > 0.4) & (frequency < 0.9)
    assert true[quiet].mean() > 0.5
    assert found[quiet].mean() == pytest.approx(true[quiet].mean(), abs=0.1)
    assert np.abs(found[(frequency > 0.02) & (frequency < 0.2)]).mean() < 0.1
