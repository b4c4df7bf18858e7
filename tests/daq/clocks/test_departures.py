"""Single segments that are off the clocks by which they were taken."""

from __future__ import annotations

import numpy as np
import pytest

from daq.clocks.departures import departing

RATE = 200.0
OMEGA = 2 * np.pi * np.geomspace(0.4, 90.0, 48)


def spectra(snr: float, delays: np.ndarray, *, burst: int = -1) -> tuple[np.ndarray, np.ndarray]:
    """Two triaxial sensors on one motion; in segment `burst` the second one is disturbed."""
    rng = np.random.default_rng(1)

    def noise() -> np.ndarray:
        return np.asarray(rng.standard_normal((48, len(delays), 3, 2)) @ np.array([1, 1j]))

    motion, turn = np.sqrt(snr) * noise(), np.linalg.qr(rng.standard_normal((3, 3)))[0]
    size = np.ones(len(delays))
    size[burst] = 30.0 if burst >= 0 else 1.0
    late = np.exp(-1j * np.outer(OMEGA, delays))[:, :, None]
    return motion + noise(), (motion @ turn) * late + size[:, None] * noise()


@pytest.mark.parametrize("seconds", [60e-6, 1 / RATE, 20.3 / RATE, -1 / RATE])
def test_segments_off_their_clock_are_found_and_no_others(seconds: float) -> None:
    delays = np.zeros(600)
    delays[[17, 300]] = seconds
    found = departing(*spectra(1e4, delays), OMEGA, precise=0.5 / RATE)
    assert found is not None
    assert np.flatnonzero(found).tolist() == [17, 300]


def test_a_motion_too_weak_to_show_half_a_sample_tells_nothing() -> None:
    delays = np.zeros(600)
    assert departing(*spectra(1e-3, delays), OMEGA, precise=0.5 / RATE) is None
    found = departing(*spectra(3.0, delays), OMEGA, precise=0.5 / RATE)
    assert found is not None
    assert not found.any()


def test_a_disturbance_hides_no_other_segment() -> None:
    delays = np.zeros(600)
    delays[17] = 1 / RATE
    found = departing(*spectra(1e4, delays, burst=40), OMEGA, precise=0.5 / RATE)
    assert found is not None
    assert found[17]
    assert found.sum() <= 2
