"""Spectra on another clock, against sinusoids evaluated at the instants of the grid."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.spectra.shifted_windows import order_of, shifted_spectra

LENGTH = 500


@pytest.mark.parametrize(
    ("shift", "drift", "order", "below_db"),
    [
        (0.0, 0.0, 0, -200.0),
        (0.37, 0.0, 0, -110.0),
        (-0.5, 0.0, 0, -105.0),
        (0.37, 5e-6, 1, -100.0),
        (-0.2, 80e-6, 2, -100.0),
        (0.5, -140e-6, 2, -100.0),
    ],
)
def test_spectra_are_those_of_samples_taken_on_the_grid(
    shift: float, drift: float, order: int, below_db: float
) -> None:
    rng = np.random.default_rng(1)
    frequency, phase = rng.uniform(0, 0.45, 800), rng.uniform(0, 2 * np.pi, 800)
    size = rng.standard_normal(800)

    def motion(at: np.ndarray) -> np.ndarray:
        return np.asarray(np.cos(2 * np.pi * np.outer(at, frequency) + phase) @ size)

    k = np.arange(LENGTH)
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * k / LENGTH)
    true = np.fft.rfft(hann * motion(k + shift + drift * (k - LENGTH / 2)))
    found = shifted_spectra(
        motion(k.astype(float))[None],
        np.array([0]),
        np.array([shift]),
        np.array([drift]),
        order=order,
        trends=np.empty((0, LENGTH)),
    )[0, :, 0]
    band = slice(3, int(0.44 * LENGTH))
    error = np.mean(np.abs(found - true)[band] ** 2) / np.mean(np.abs(true[band]) ** 2)
    assert 10 * np.log10(error + 1e-30) < below_db
    assert order_of(drift, LENGTH) == order


def test_a_drift_too_large_for_the_series_is_refused() -> None:
    assert order_of(1e-3, LENGTH) is None
    assert order_of(0.0, 200) is None  # a fraction of a sample at its ends counts
    assert order_of(40e-6, 2000) == 2
    assert order_of(100e-6, 2000) is None
    assert order_of(-3e-6, 2000) == 1
