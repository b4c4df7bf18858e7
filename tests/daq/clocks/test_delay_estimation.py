"""Delays from the common motion, and the interpolation that removes them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.clocks.delay_estimation import DelayEstimator
from daq.clocks.resampling import SPAN, are_whole, reach, resample

FloatArray = NDArray[np.float64]

RATE, LENGTH, HOP = 200.0, 1000, 500
WINDOW = np.hanning(LENGTH + 1)[:-1]
COLUMNS = (slice(0, 2), slice(2, 4))


def shifted(n: int, delays: FloatArray) -> FloatArray:
    """White motion in two directions, read late by a curve given at the middles of segments."""
    motion = np.random.default_rng(5).standard_normal((n + 200, 2))
    middles = np.arange(len(delays)) * HOP + LENGTH / 2
    rows = np.arange(n) - RATE * np.interp(np.arange(n), middles, delays)
    return resample(motion, 100.5 + rows)


def huddle(n_segments: int, delays: FloatArray, noise: float, seed: int) -> FloatArray:
    """Two sensors, the second turned by 25° and delayed."""
    rng = np.random.default_rng(seed)
    n = (n_segments - 1) * HOP + LENGTH
    cos, sin = np.cos(0.44), np.sin(0.44)
    second = shifted(n, delays) @ np.array([[cos, -sin], [sin, cos]])
    samples = np.hstack([shifted(n, np.zeros(n_segments)), 1.02 * second])
    return np.asarray(samples + noise * rng.standard_normal(samples.shape))


def test_known_delays_are_measured_within_their_stated_error() -> None:
    n = 80
    delays = 4e-4 + 2e-4 * np.sin(np.arange(n) / 9.0)
    samples = huddle(n, delays, 0.03, 1)
    meter = DelayEstimator(RATE, WINDOW, COLUMNS)
    measured, std = meter.measure(samples, np.arange(n) * HOP)
    whole = measured[:, 1] + meter.frame_delays()[1]
    # The curve bends by some 1 µs within a segment.
    error = whole - delays
    assert not measured[:, 0].any()  # the reference's own
    assert abs(error.mean()) < 5e-6
    assert np.std(error) < 1.3 * np.median(std[:, 1]) + 1e-6
    assert np.std(error) > 0.5 * np.median(std[:, 1])
    assert np.median(std[:, 1]) < 2e-5


def z_of(motion: FloatArray, felt: FloatArray, noise: float, seed: int) -> FloatArray:
    """Return delays that are none, over their stated deviations."""
    rng = np.random.default_rng(seed)
    samples = np.hstack([motion, felt])
    samples += noise * rng.standard_normal(samples.shape)
    meter = DelayEstimator(RATE, WINDOW, COLUMNS, hop=HOP)
    starts = np.arange((len(motion) - LENGTH) // HOP + 1) * HOP
    batches = [meter.measure(samples, starts[first : first + 40]) for first in (0, 40, 80)]
    measured, std = (np.concatenate([each[n] for each in batches])[:, 1] for n in (0, 1))
    known = np.isfinite(std)
    assert known.mean() > 0.9
    return np.asarray((measured[known] - np.median(measured[known])) / std[known])


@pytest.mark.parametrize("seed", range(3))
def test_bursts_at_the_edges_of_segments_are_no_delay_where_responses_differ(seed: int) -> None:
    """Without what the edges add, delays are off by up to 18 stated deviations."""
    rng = np.random.default_rng([18, seed])
    n = 119 * HOP + LENGTH
    loud = np.zeros(n)
    loud[rng.integers(0, n, 60)] = rng.uniform(0.5, 3.0, 60)
    decay = np.exp(-np.arange(LENGTH) / 30)
    motion = rng.standard_normal((n, 2)) * (np.convolve(loud, decay)[:n, None] + 0.03)
    frequency = np.fft.rfftfreq(n, 1 / RATE)[:, None]
    resonance = 1 / (1 - (frequency / 50.0) ** 2 + 0.2j * frequency / 50.0)
    felt = np.fft.irfft(np.fft.rfft(motion, axis=0) * resonance, n, axis=0)
    z = z_of(motion, felt, 0.003, seed)
    assert abs(z).max() < 6
    assert 0.5 < z.std() < 1.5


def test_noise_that_a_loud_moment_lets_pass_says_nothing_of_a_delay() -> None:
    """Where it is quiet, most that is predicted is noise: its curvature is not that of J."""
    rng = np.random.default_rng(18)
    n = 119 * HOP + LENGTH
    frequency = np.maximum(np.fft.rfftfreq(n, 1 / RATE), 0.1)[:, None]
    spectrum = np.fft.rfft(rng.standard_normal((n, 2)), axis=0) / (1 + (frequency / 4.0) ** 2)
    motion = np.fft.irfft(spectrum, n, axis=0)
    motion *= np.where(np.arange(n) % 8000 < 800, 30.0, 1.0)[:, None]
    z = z_of(motion, motion.copy(), 0.05, 18)
    assert 0.5 < z.std() < 1.5


def test_later_batches_are_measured_in_the_frame_of_the_first() -> None:
    n = 80
    delays = np.concatenate([np.zeros(40), np.full(40, 3e-3)])  # more than half a sample
    samples = huddle(n, delays, 0.03, 2)
    meter = DelayEstimator(RATE, WINDOW, COLUMNS)
    starts = np.arange(n) * HOP
    first, _ = meter.measure(samples, starts[:38])
    second, _ = meter.measure(samples, starts[42:])
    assert second[:, 1].mean() - first[:, 1].mean() == pytest.approx(3e-3, abs=5e-6)


def test_without_common_motion_no_delay_is_returned() -> None:
    rng = np.random.default_rng(3)
    n = 60
    samples = rng.standard_normal(((n - 1) * HOP + LENGTH, 4))
    meter = DelayEstimator(RATE, WINDOW, COLUMNS, hop=HOP)
    starts = np.arange(n) * HOP
    measured, std = meter.measure(samples, starts)
    assert np.isnan(measured).all()
    assert np.isinf(std).all()
    moved = huddle(n, np.full(n, 1e-3), 0.03, 3)  # begins later, and defines the frame
    measured, std = meter.measure(moved, starts)
    assert np.isfinite(std).all()
    assert measured[:, 1].mean() + meter.frame_delays()[1] == pytest.approx(1e-3, abs=2e-6)


@pytest.mark.parametrize("dead", [False, True])
def test_a_reference_without_the_common_motion_is_replaced(dead: bool) -> None:
    n = 40
    delays = 2e-4 * np.sin(np.arange(n) / 9.0)
    samples = huddle(n, delays, 0.03, 1)
    alone = np.random.default_rng(7).standard_normal((len(samples), 2)) * (not dead)
    columns = (slice(0, 2), slice(2, 4), slice(4, 6))
    for others in ((0, 2), (0, 1), (1, 2)):
        parts = [alone] * 3
        for number, part in zip(others, (samples[:, :2], samples[:, 2:]), strict=True):
            parts[number] = part
        meter = DelayEstimator(RATE, WINDOW, columns)
        measured, std = meter.measure(np.hstack(parts), np.arange(n) * HOP)
        assert not std[:, others[0]].any()
        error = measured[:, others[1]] + meter.frame_delays()[others[1]] - delays
        assert np.sqrt(np.mean(error**2)) < 2e-5
        assert np.median(std[:, ({0, 1, 2} - set(others)).pop()]) > 1e-4


@pytest.mark.parametrize("seed", range(3))
def test_hum_does_not_shift_sensors_by_half_periods(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 120 * HOP + LENGTH
    phase = np.cumsum(0.002 * rng.standard_normal((n, 2)), axis=0) + np.array([0.0, 1.2])
    common = 10 * np.cos(2 * np.pi * 50.0 / RATE * np.arange(n)[:, None] + phase)
    common += 0.03 * rng.standard_normal((n, 2))
    samples = np.hstack([common, common @ np.array([[0.9, -0.44], [0.44, 0.9]])])
    samples += 0.3 * rng.standard_normal(samples.shape)
    meter = DelayEstimator(RATE, WINDOW, COLUMNS)
    meter.measure(samples, np.arange(120) * HOP)
    assert abs(meter.frame_delays()[1]) < 1e-3  # half a period: 10 ms


@pytest.mark.parametrize("delay", [0.9, 1.5, 1.9, -1.5])  # a segment lasts 5 s
def test_a_long_constant_delay_is_distinguished_from_its_alias(delay: float) -> None:
    motion = np.random.default_rng(5).standard_normal((100 * HOP, 2))
    motion += 0.03 * np.random.default_rng(6).standard_normal(motion.shape)
    samples = np.hstack([motion, np.roll(motion, round(delay * RATE), axis=0)])[LENGTH:-LENGTH]
    meter = DelayEstimator(RATE, WINDOW, COLUMNS)
    measured, _ = meter.measure(samples, np.arange(90) * HOP)
    assert np.nanmean(measured[:, 1]) + meter.frame_delays()[1] == pytest.approx(delay, abs=1e-3)


def test_too_few_segments_define_no_frame() -> None:
    samples = huddle(10, np.zeros(10), 0.03, 4)
    measured, std = DelayEstimator(RATE, WINDOW, COLUMNS).measure(samples, np.arange(10) * HOP)
    assert np.isnan(measured).all()
    assert np.isinf(std).all()


@pytest.mark.parametrize(("noise", "is_known"), [(None, False), (1.5, True)])
@pytest.mark.parametrize(("n_segments", "hop"), [(24, 3000), (60, 1500)])
def test_noise_of_many_frequencies_is_no_motion(
    n_segments: int, hop: int, noise: float | None, *, is_known: bool
) -> None:
    """The sum over 2,700 frequencies is significant, and yet all of it is noise of P."""
    length, three = 6000, (slice(0, 3), slice(3, 6))
    rng = np.random.default_rng(31)
    samples = rng.standard_normal((hop * (n_segments - 1) + length, 6))
    if noise is not None:
        motion = rng.standard_normal((len(samples), 3))
        samples = noise * samples + np.hstack([motion, motion])
    meter = DelayEstimator(100.0, np.hanning(length + 1)[:-1], three, hop=hop)
    _, std = meter.measure(samples, np.arange(n_segments) * hop)
    assert np.isfinite(std[:, 1]).all() == is_known
    assert np.isfinite(std[:, 1]).any() == is_known


# --- resampling ------------------------------------------------------------------------------


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
