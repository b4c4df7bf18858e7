"""Equalising filters: what they do is what their response says."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import EstimatorError
from estimator.spectra.equaliser import (
    MAX_AMPLIFICATION,
    Equaliser,
    bounded,
    design,
    smoothed,
    tail_leakage,
    with_short_tails,
)

RATE, LENGTH = 100.0, 400
GRID = np.arange(LENGTH // 2 + 1) * RATE / LENGTH


def made(seed: int = 1, reach: int = 7) -> Equaliser:
    taps = np.random.default_rng(seed).standard_normal((3, 2 * reach + 1))
    taps[1] = 0.0
    taps[1, reach] = 1.0
    return Equaliser(RATE, taps)


@pytest.mark.parametrize("n_samples", [15, 100, 1000])
def test_samples_are_convolved_with_the_taps(n_samples: int) -> None:
    filters = made()
    samples = np.random.default_rng(2).standard_normal((n_samples, 3))
    found = filters.apply(samples)
    assert filters.filtered == (0, 2)
    for channel in range(3):
        direct = np.convolve(samples[:, channel], filters.taps[channel], "valid")
        np.testing.assert_allclose(found[:, channel], direct, atol=1e-12)


def test_pieces_give_the_result_of_the_whole() -> None:
    filters = made()
    samples = np.random.default_rng(2).standard_normal((500, 3))
    pieces = [filters.apply(samples[first : first + 100 + 14]) for first in range(0, 486, 100)]
    np.testing.assert_allclose(np.concatenate(pieces), filters.apply(samples), atol=1e-12)


def test_too_few_samples_are_refused() -> None:
    with pytest.raises(EstimatorError, match=r"expected 15 or more of 3 channels"):
        made().apply(np.zeros((14, 3)))


@pytest.mark.parametrize("frequency", [GRID, np.array([3.0]), np.array([0.1, 7.77, 31.4])])
def test_the_response_is_that_of_the_taps(frequency: np.ndarray) -> None:
    filters = made(reach=250)  # longer than the grid's period, too
    lags = np.arange(-250, 251) / RATE
    direct = np.exp(-2j * np.pi * np.outer(frequency, lags)) @ filters.taps.T
    np.testing.assert_allclose(filters.response(frequency), direct, atol=1e-9)


def test_responses_of_cascaded_filters_multiply() -> None:
    one, two = made(1), made(2, reach=3)
    both = one.then(two)
    assert both.filtered == (0, 2)
    expected = one.response(GRID) * two.response(GRID)
    np.testing.assert_allclose(both.response(GRID), expected, atol=1e-9)


def test_a_response_with_few_taps_is_met_by_these_taps() -> None:
    wanted = np.ones((len(GRID), 2), dtype=np.complex128)
    wanted[:, 1] = (1 + 0.5 * np.cos(2 * np.pi * GRID / RATE)) * np.exp(-2j * np.pi * GRID * 0.02)
    filters = design(wanted, RATE, longest=LENGTH // 2 - 1)
    assert filters.filtered == (1,)
    assert filters.reach < 25
    np.testing.assert_allclose(filters.response(GRID), wanted, atol=1e-9)


def test_the_value_at_0_hz_follows_from_the_outer_taps() -> None:
    wanted = (1.5 + np.cos(2 * np.pi * GRID * 0.02)).astype(np.complex128)[:, None]
    disturbed = wanted.copy()
    disturbed[0] += 0.4
    np.testing.assert_allclose(with_short_tails(disturbed), wanted, atol=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_delay_of_half_a_sample_takes_few_taps(sign: int) -> None:
    wanted = sign * np.exp(-1j * np.pi * GRID / RATE)[:, None]
    found = with_short_tails(wanted)
    np.testing.assert_allclose(found[: 9 * LENGTH // 20], wanted[: 9 * LENGTH // 20], atol=0.01)
    taps = [np.fft.irfft(each[:, 0], LENGTH) for each in (found, wanted.real + 1j * wanted.imag)]
    far = slice(LENGTH // 4, 3 * LENGTH // 4)
    short, ringing = (np.abs(each[far]).max() for each in taps)
    assert short < 0.02 * ringing


def test_a_response_without_short_filter_has_more_tail_leakage() -> None:
    resonance = 1 / (1 - (GRID / 10) ** 2 + 1j * GRID / 10 / 50)
    snr = np.full((len(GRID), 1), 1e5)
    to_imitate, to_undo = (
        tail_leakage(np.asarray(each[:, None], dtype=np.complex128), RATE, snr=snr, factor=1 / 48)[
            0
        ]
        for each in (resonance, 1 / resonance)
    )
    assert to_undo < 0.2 * to_imitate


def test_amplification_is_bounded() -> None:
    response = np.ones(11, dtype=np.complex128)
    response[0] = 1e6j
    found = bounded(2 * response)
    assert found[0] == pytest.approx(1j * MAX_AMPLIFICATION)
    np.testing.assert_allclose(found[1:], 1.0)


def test_smoothing_keeps_values_of_large_weight_and_bridges_others() -> None:
    x = np.linspace(0, 1, 51)
    truth = 1 + x**2 + 1j * x
    values, weight = truth.copy(), np.full(51, 1e6)
    values[20:24], weight[20:24] = 7.0, 0.0
    np.testing.assert_allclose(smoothed(values, weight, stiffness=1.0), truth, atol=1e-6)
