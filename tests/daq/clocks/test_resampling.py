"""Band-limited interpolation against tones, whose value between samples is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.clocks.resampling import SPAN, are_whole, reach, resample

FloatArray = NDArray[np.float64]


def error_db(frequency: float, positions: FloatArray, n: int, ratio: float = 1.0) -> float:
    """Power of the error against a tone of `frequency` cycles per input sample, in dB."""
    phase = 2 * np.pi * frequency
    tone = np.stack([np.cos(phase * np.arange(n)), np.sin(phase * np.arange(n))], axis=1)
    expected = np.stack([np.cos(phase * positions), np.sin(phase * positions)], axis=1)
    error = resample(tone, positions, ratio=ratio) - expected
    return float(10 * np.log10(2 * np.mean(error**2)))


def inner(n: int, step: float, ratio: float = 1.0) -> FloatArray:
    margin = reach(ratio)
    return np.arange(margin + 0.37, n - margin - 1, step)


@pytest.mark.parametrize("ppm", [-20.0, 0.0, 20.0, 100.0, 1000.0, 10_000.0])
@pytest.mark.parametrize("frequency", [0.003, 0.1, 0.3, 0.45])
def test_tones_up_to_the_usable_edge_have_errors_below_100_db(ppm: float, frequency: float) -> None:
    n = 6000
    assert error_db(frequency, inner(n, 1 + ppm * 1e-6), n) < -100


@pytest.mark.parametrize("ratio", [1.25, 2.0, 5.0])
def test_a_lower_rate_keeps_its_band_and_removes_what_would_alias(ratio: float) -> None:
    n = 12_000
    positions = inner(n, ratio * (1 + 20e-6), ratio)
    for edge in (0.01, 0.3, 0.45):
        assert error_db(edge / ratio, positions, n, ratio) < -100
    for gone in (0.56, 0.7, 0.95):
        frequency = min(gone / ratio, 0.5)
        if frequency * ratio < 0.55:
            continue
        tone = np.cos(2 * np.pi * frequency * np.arange(n) + 0.3)[:, None]
        left = resample(tone, positions, ratio=ratio)
        assert 10 * np.log10(2 * np.mean(left**2)) < -100


def test_samples_at_integer_positions_are_bit_exact() -> None:
    samples = np.random.default_rng(1).standard_normal((3000, 3))
    assert np.array_equal(resample(samples, np.arange(100.0, 2900.0)), samples[100:2900])
    assert are_whole(np.arange(7.0, 1e7, 1000.0)[:1])
    assert not are_whole(np.arange(100.0) + 0.001)


def test_pieces_divided_at_spans_equal_the_whole() -> None:
    rng = np.random.default_rng(2)
    samples = rng.standard_normal((8 * SPAN, 2))
    # From 8 to 28 ppm: two, three and four delays a span.
    positions = 60.4 + np.arange(7 * SPAN) * (1 + 8e-6 + 20e-6 * np.arange(7 * SPAN) / (14 * SPAN))
    whole = resample(samples, positions)
    pieces = np.concatenate(
        [resample(samples, positions[a : a + 2 * SPAN]) for a in range(0, 7 * SPAN, 2 * SPAN)]
    )
    assert np.max(np.abs(whole - pieces)) < 1e-11  # of samples of unit variance


def test_spans_and_single_rows_of_the_kernel_agree() -> None:
    # 26 ppm needs four delays a span, 20 ppm three, 2 % a row of the kernel for every output.
    n = 4 * SPAN
    rng = np.random.default_rng(3)
    spectrum = np.zeros(n // 2 + 1, dtype=complex)
    band = slice(5, int(0.44 * n))
    spectrum[band] = rng.standard_normal(spectrum[band].shape) * np.exp(2j * np.pi * rng.random())
    samples = np.fft.irfft(spectrum, n)[:, None]
    middle = 2.0 * SPAN
    values = [
        resample(samples, np.array([middle - step, middle, middle + step]))[1, 0]
        for step in (1.0, 1.0 + 20e-6, 1.0 + 26e-6, 1.02)
    ]
    assert np.ptp(values) < 1e-5 * np.std(samples)


def test_input_beyond_the_samples_is_zero() -> None:
    samples = np.ones((50, 1))
    assert np.array_equal(resample(samples, np.arange(-3.0, 2.0))[:, 0], [0, 0, 0, 1, 1])
    assert resample(samples, np.array([])).shape == (0, 1)
