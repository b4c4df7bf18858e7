"""Tests drawn at random: their truth is true, and they are judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import welch

from benchmarks.studies.random_arrays import RATE, draw_scene, noise_psd, random_tests, simulate


def test_without_motion_the_samples_have_the_stated_noise() -> None:
    rng = np.random.default_rng(1)
    scene = replace(draw_scene(rng), seconds=1200.0, snr=1e-12, colours=(0.0, 0.9), corner=None)
    samples, deviations = simulate(scene, rng)
    series = np.hstack(list(samples.values()))
    assert series.shape == (120_000, scene.n_sensors * scene.n_channels)
    frequency, psd = welch(series, RATE, nperseg=500, axis=0)
    inside = (frequency > 1) & (frequency < 40)
    ratio = psd[inside] / noise_psd(scene, deviations, frequency[inside])
    # 480 segments half overlapped: 4.8 % at one frequency, 0.7 % over some 80
    np.testing.assert_allclose(ratio.mean(axis=0), 1, atol=0.03)


@pytest.mark.long
@pytest.mark.parametrize("length", [0.03])
def test_intervals_cover_and_advice_is_true(length: float) -> None:
    study = random_tests(lambda *_: None, length=length)
    assert study.agrees
    assert {series.quantity for _, series in study.series()} == {"share"}
