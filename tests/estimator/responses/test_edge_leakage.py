"""Leakage of unequal responses, against closed forms and exact matrices."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.checks.advice import Rank
from estimator.checks.advice_on_sensors import UnequalResponses
from estimator.methods import self_noise
from estimator.responses.edge_leakage import (
    band_shares,
    channel_responses,
    scatter_of_slopes,
    slope_factor,
)
from estimator.responses.equalisation import (
    correction,
    leakage_advice,
    leakage_threshold,
    significant_minimum,
)
from estimator.spectra.windows import get_window
from tests.estimator.csm_models import wishart

DIMS = (3, 3, 3)
T = 10.0
FREQUENCY = np.arange(1001) / T
SNR = 1e5
FACTOR = 1 / (3 * T**2)


def turned(seed: int, n_sensors: int = 3) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(n_sensors)]


def low_pass(f: np.ndarray) -> np.ndarray:
    s = 1j * f / 30
    return np.asarray(1 / (1 + np.sqrt(2) * s + s**2))


def exact(seed: int = 1, n_sensors: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return averages without scatter: motion, what leaks of it, noise; and the response of B."""
    response = low_pass(FREQUENCY)
    slope = (low_pass(FREQUENCY + 1e-4) - low_pass(FREQUENCY - 1e-4)) / 2e-4
    p = 3 * n_sensors
    one, other = np.ones((2, p, 1001), dtype=np.complex128)
    one[3:6], other[:] = response, 0.0
    other[3:6] = slope
    directions = np.vstack(turned(seed, n_sensors))
    csm = np.zeros((1001, p, p), dtype=np.complex128)
    for factor, by in ((1.0, one), (FACTOR, other)):
        loading = by.T[:, :, None] * directions
        csm += factor * SNR * loading @ loading.conj().swapaxes(1, 2)
    return csm + np.eye(p), slope


def test_the_slope_factor_of_a_hann_window_is_that_of_the_integral() -> None:
    assert slope_factor(get_window("hann", 2000), 200.0) == pytest.approx(FACTOR, rel=1e-5)


def test_a_delay_of_one_sample_under_a_rectangular_window() -> None:
    # method.md, item 6: seen +1070 % at SNR 1e4
    factor = slope_factor(np.ones(2000), 200.0)
    assert factor * (2 * np.pi / 200) ** 2 * 1e4 == pytest.approx(10.7, rel=0.1)


def predicted_by_a_rectangular_window(response: np.ndarray) -> np.ndarray:
    """Leakage into three sensors of one channel, of which B has a response, under 2000 ones."""
    loading = np.ones((1001, 3), dtype=np.complex128)
    loading[:, 1] = response
    csm = SNR * loading[:, :, None] * loading[:, None].conj() + np.eye(3)
    motion = SNR * np.abs(loading) ** 2
    found = channel_responses(csm, FREQUENCY, dims=(1, 1, 1))
    leakage, *_ = found.leakage_from_afar(motion, np.ones(2000), 200.0, n_effective=24.0)
    return leakage


def test_a_delay_leaks_through_both_ends_of_a_rectangular_window() -> None:
    # Of an average of 10 s, 5 ms at either end are in one sensor only.
    leakage = predicted_by_a_rectangular_window(np.exp(-2j * np.pi * FREQUENCY * 0.005))
    np.testing.assert_allclose(leakage[100:900, 1], 2 * SNR * 0.005 / T, rtol=0.03)
    assert np.abs(leakage[:, [0, 2]]).max() < 0.1


def test_motion_leaks_from_where_responses_differ_far_away() -> None:
    # The integral of 1 / (2000 sin²(pi f / 200) 200) / 2 over 50 to 150 Hz: half of the samples'.
    f, leakage = (
        FREQUENCY[100:450],
        predicted_by_a_rectangular_window(np.where(FREQUENCY < 50, 1, -1)),
    )
    low, high = (1 / np.tan(np.pi * (end - f) / 200) for end in (50, 150))
    share = (low - high) / (2 * np.pi * 2000)
    np.testing.assert_allclose(leakage[100:450, 1], 4 * SNR * share, rtol=0.03)


@pytest.mark.parametrize("n_sensors", [3, 12])  # of twelve, not every sensor is a third one
def test_responses_are_found_for_any_orientation(n_sensors: int) -> None:
    csm, _ = exact(n_sensors=n_sensors)
    found = channel_responses(csm, FREQUENCY, dims=(3,) * n_sensors)
    inside = slice(10, 990)
    for channel in (3, 4, 5):
        for other in (0, *range(2, n_sensors)):
            ratio = found.ratio[inside, channel, other] / found.ratio[200, channel, other]
            expected = low_pass(FREQUENCY)[inside] / low_pass(FREQUENCY[200:201])
            np.testing.assert_allclose(ratio, expected, rtol=2e-3)
    assert np.isnan(found.ratio[:, 3, 1]).all()


def test_predicted_leakage_is_that_of_the_three_sensor_estimate() -> None:
    csm, slope = exact()
    noise = self_noise("three-sensor", csm, dims=DIMS, n_effective=1e9).noise_psd
    motion = np.einsum("fpp->fp", csm).real - noise
    leakage, deviation = channel_responses(csm, FREQUENCY, dims=DIMS).leakage(
        motion, FACTOR, n_effective=200.0
    )
    inside = slice(20, 980)
    expected = FACTOR * np.abs(slope[inside]) ** 2 * SNR
    assert expected.max() > 0.9
    np.testing.assert_allclose(leakage[inside, 3:6].mean(axis=1), expected, rtol=0.03)
    np.testing.assert_allclose(noise[inside, 3:6].mean(axis=1) - 1, expected, rtol=0.03)
    assert np.abs(leakage[inside, [0]]).max() < 0.01
    # (1 / g - 1) P / n at two frequencies: noise and leakage of the channel, noise of the other
    own = noise[200, 3] + np.abs(low_pass(FREQUENCY[200])) ** 2
    assert deviation[200, 3] == pytest.approx(1.67 / 4 / 3 * own / 200, rel=0.1)


@pytest.mark.parametrize("n_sensors", [3, 4, 5])
def test_equal_sensors_leak_nothing_whatever_the_signs_of_their_predictions(n_sensors: int) -> None:
    rng = np.random.default_rng(n_sensors)
    dims, n, f = (3,) * n_sensors, 100, np.arange(301) / T
    loading = np.vstack([np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in dims])
    amplitude = np.hstack([1e3 * loading, np.eye(len(loading))])  # SNR 1e6
    draws = rng.standard_normal((2, len(f), amplitude.shape[1], n)) / np.sqrt(2 * n)
    spectra = amplitude @ (draws[0] + 1j * draws[1])
    csm = spectra @ spectra.conj().swapaxes(1, 2)
    motion = np.einsum("fpp->fp", csm).real
    found = channel_responses(csm, f, dims=dims).leakage(motion, FACTOR, n_effective=n)
    share, deviation = band_shares(*found, np.ones_like(motion), f)
    assert significant_minimum(share, deviation, f).max() < leakage_threshold(n)


def test_equal_sensors_leak_nothing_where_motion_ends() -> None:
    """A slope is as uncertain as the frequencies on both sides, of which one lacks the motion."""
    frequency = np.arange(501) / T
    edge = np.cos(np.pi / 2 * np.clip((frequency - 40) / 5, 0, 1)) ** 2
    for seed in range(20):
        directions = np.vstack(turned(seed))
        csm = 1e5 * edge[:, None, None] * directions @ directions.T + np.eye(9)
        averages = wishart(csm.astype(np.complex128), 45, np.random.default_rng(seed))[0]
        found = channel_responses(averages, frequency, dims=DIMS)
        motion = np.einsum("fpp->fp", averages).real - 1
        left, deviation = found.leakage(motion, FACTOR, n_effective=45)
        share = significant_minimum(
            *band_shares(left, deviation, np.ones((501, 9)), frequency), frequency
        )
        assert (share <= leakage_threshold(45)).all()


def test_the_sensor_that_differs_is_the_one_filtered() -> None:
    csm, _ = exact()
    noise = self_noise("three-sensor", csm, dims=DIMS, n_effective=1e9).noise_psd
    motion = np.einsum("fpp->fp", csm).real - noise
    wanted, reference = correction(
        channel_responses(csm, FREQUENCY, dims=DIMS),
        FREQUENCY,
        dims=DIMS,
        motion_psd=motion,
        noise_psd=noise,
        n_effective=200.0,
        factor=FACTOR,
    )
    assert reference in {0, 2}
    np.testing.assert_array_equal((wanted != 1).any(axis=0), np.repeat([False, True, False], 3))
    equal = wanted[10:890, 4] * low_pass(FREQUENCY)[10:890]
    np.testing.assert_allclose(equal / equal[100], 1.0, atol=0.005)


def test_shares_are_of_bands_and_allow_for_scatter() -> None:
    leakage = np.full((1001, 1), 0.1)
    share, deviation = band_shares(leakage, leakage, np.full((1001, 1), 0.5), FREQUENCY)
    np.testing.assert_allclose(share, 0.2)
    # 0.2 times the root of 2 over the number of frequencies: 8 at first, 206 in the last band
    assert deviation[1, 0] == pytest.approx(0.1)
    assert deviation[-1, 0] == pytest.approx(0.2 * np.sqrt(2 / 206), rel=0.3)
    least = significant_minimum(share, deviation, FREQUENCY)[:, 0]
    assert least[1] == 0
    assert 0.08 < least[880] < 0.2
    assert least[-1] == 0  # near half the sampling rate


def advised(share: np.ndarray, share_without: np.ndarray, *by: str) -> list[UnequalResponses]:
    return list(
        leakage_advice(
            FREQUENCY, share, share_without, dims=DIMS, n_effective=200.0, equalised_by=by
        )
    )


def test_advice_names_the_sensor_that_leaks_and_how_much() -> None:
    share = np.zeros((1001, 9))
    share[100:200, 4] = 0.4
    share[100:200, 0] = 0.02
    (found,) = advised(share, share)
    assert found.sensors == (1,)
    assert found.channel == 4
    assert found.band == (FREQUENCY[100], FREQUENCY[199])
    assert found.rank is Rank.INVALIDATES
    (better,) = advised(0 * share, share, "estimated")
    assert better.rank is Rank.TO_KNOW
    assert better.share_without == 0.4
    assert not advised(0.01 * share, 0.01 * share)
    assert leakage_threshold(1e9) == pytest.approx(0.01)


@pytest.mark.parametrize(("window", "share"), [("hann", 0.16), ("rectangular", 5.07)])
def test_the_scatter_of_slopes_is_that_of_a_windows_jumps(window: str, share: float) -> None:
    """Hann: (1 / 3 T²) 2 (1 - 1/36) T² / 4. Rectangular: 2 L / (4 π²) 2 / 4."""
    assert scatter_of_slopes(get_window(window, 200), 50.0) == pytest.approx(share, rel=0.02)
