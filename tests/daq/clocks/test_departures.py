"""Single segments that are off the clocks by which they were taken."""

from __future__ import annotations

import numpy as np
import pytest

from daq.clocks.departures import agreement, departing

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


@pytest.mark.parametrize(("seconds", "found_all"), [(0.0, False), (6e-6, True)])
def test_a_clock_that_moves_by_less_than_one_segment_shows_is_found(
    *, seconds: float, found_all: bool
) -> None:
    delays = seconds * np.sin(2 * np.pi * np.arange(600) / 25)
    found = departing(*spectra(1e4, delays), OMEGA, precise=0.5 / RATE)
    assert found is not None
    assert found.all() == found.any() == found_all


def test_neighbours_agree_by_what_they_have_in_common() -> None:
    rng = np.random.default_rng(1)
    errors = rng.standard_normal((400, 1000))
    errors[:, 1:] += 0.3 * errors[:, :-1]  # of segments that overlap
    assert sum(agreement(each) > 0 for each in errors) <= 2  # 4 sigma: 0.013 are expected
    slow = np.sin(2 * np.pi * np.arange(1000) / 60)
    common = np.array([agreement(each + slow) for each in errors])
    assert common.mean() == pytest.approx(0.464, rel=0.02)  # half of 1, and less at the lags
    assert agreement(errors[0, :4]) == agreement(np.zeros(1)) == 0.0
