"""Band-limited interpolation between samples.

A value is the sum of its 80 neighbours times a windowed sinc (Kaiser window, 120 dB): flat to 0.45
of the sampling rate, with images and aliases below -100 dB. For a lower output rate the kernel is
stretched and thus also is the anti-alias filter.

The kernel is applied in two ways:

- If the output rate is nearly the input rate (free-running oscillators that differ by parts per
  million), the fractional position hardly changes within a span of `SPAN` outputs. The span is
  filtered by fast convolution at a few fixed fractional delays (Chebyshev nodes), and each output
  is interpolated between them: three filters suffice to 25 ppm with an error below -110 dB.
- Otherwise every output has its own row of the kernel.

If all positions are integers, the samples are copied without filtering.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

USABLE = 0.45
"""Fraction of the lower rate up to which interpolation preserves the samples."""
HALF_WIDTH = 40
"""Half width of the kernel, in samples at the lower of the two rates."""
SPAN = 896
"""Number of outputs filtered together; divide long outputs at multiples of it."""

_ATTENUATION_DB = 120.0
_BETA = 0.1102 * (_ATTENUATION_DB - 8.7)  # Kaiser's formula, above 50 dB
_PHASES = 4096  # table steps per sample: the error of linear interpolation is (π/4096)²/8, -142 dB
_FFT_LENGTH = 1024
_TOLERANCE = 3e-6  # of the interpolation between fixed delays, at the Nyquist frequency
_MOST_DELAYS = 8
_WHOLE = 1e-9  # samples; rounding of positions in long recordings
_SPANS_AT_ONCE = 8
_OUTPUTS_AT_ONCE = 2048


def reach(ratio: float = 1.0) -> int:
    """Return the number of input samples needed before the first and after the last position.

    Parameters
    ----------
    ratio : float
        Input rate over output rate.
    """
    return math.ceil(HALF_WIDTH * max(1.0, ratio)) + 1


def all_present(present: BoolArray, positions: FloatArray, *, ratio: float = 1.0) -> BoolArray:
    """Return whether all samples under the kernel are present, for each position.

    Parameters
    ----------
    present : bool, shape (n_samples,)
        Whether each sample is present.
    positions : float64, shape (n_outputs,)
        As for `resample`.
    ratio : float
        Input rate over output rate.
    """
    base, half = np.floor(positions).astype(np.int64), reach(ratio)
    missing = np.concatenate([[0], np.cumsum(~present)])
    low = np.clip(base - half + 1, 0, len(present))
    high = np.clip(base + half + 1, 0, len(present))
    inside = (base >= 0) & (base < len(present))
    return np.asarray(inside & (missing[high] == missing[low]), dtype=np.bool_)


def are_whole(positions: FloatArray) -> bool:
    """Return whether all positions are consecutive integers, within rounding."""
    if len(positions) == 0:
        return True
    expected = np.round(positions[0]) + np.arange(len(positions))
    return bool(np.max(np.abs(positions - expected)) < _WHOLE * max(1.0, abs(expected[-1])))


def resample(samples: FloatArray, positions: FloatArray, *, ratio: float = 1.0) -> FloatArray:
    """Evaluate band-limited `samples` at fractional row numbers.

    Parameters
    ----------
    samples : float64, shape (n_samples, n_channels)
        Zero before the first and after the last row.
    positions : float64, shape (n_outputs,)
        Increasing row numbers; position 2.25 is a quarter of the way from row 2 to row 3.
    ratio : float
        Input rate over output rate. Above 1 the kernel is also the anti-alias filter: flat to 0.45
        of the output rate, zero from 0.55 on.

    Returns
    -------
    float64, shape (n_outputs, n_channels)
    """
    samples = np.asarray(samples, dtype=np.float64)
    positions = np.asarray(positions, dtype=np.float64)
    if len(positions) == 0:
        return np.empty((0, samples.shape[1]))
    if ratio <= 1.0 and are_whole(positions):
        first = round(float(positions[0]))
        return _padded(samples, first, first + len(positions))
    if ratio > 1.0:
        return _direct(samples, positions, ratio)
    starts = np.arange(0, len(positions), SPAN)
    steps = positions - (np.arange(len(positions)) % SPAN)
    highest = np.maximum.reduceat(steps, starts)
    lowest = np.minimum.reduceat(steps, starts)
    middle, spread = (highest + lowest) / 2, (highest - lowest) / 2
    delays = _delays_needed(spread)
    out = np.empty((len(positions), samples.shape[1]))
    for first in range(0, len(starts), _SPANS_AT_ONCE):
        spans = slice(first, first + _SPANS_AT_ONCE)
        for count in sorted(set(delays[spans].tolist())):
            for run in _runs(np.flatnonzero(delays[spans] == count) + first):
                rows = slice(run[0] * SPAN, (run[-1] + 1) * SPAN)
                if count > _MOST_DELAYS:
                    out[rows] = _direct(samples, positions[rows], 1.0)
                    continue
                nodes = spread[run, None] * np.cos(np.pi * (np.arange(count) + 0.5) / count)
                out[rows] = _by_spans(samples, positions[rows], middle[run], nodes)
    return out


def _runs(numbers: IntArray) -> list[IntArray]:
    """Split increasing numbers into runs of consecutive ones."""
    return np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)


def _by_spans(
    samples: FloatArray, positions: FloatArray, middle: FloatArray, nodes: FloatArray
) -> FloatArray:
    """Convolve each span at its fixed delays, and interpolate between them.

    `middle` is the position of a span's first output for the delay at the middle of the span;
    `nodes`, shape (n_spans, n_delays), are the delays around it.
    """
    n_spans, n_channels = len(middle), samples.shape[1]
    base = np.floor(middle).astype(np.int64)
    offsets = np.arange(-HALF_WIDTH + 1, HALF_WIDTH + 1)
    # Output k of a span is between rows base + k and base + k + 1. (n_spans, n_delays, taps)
    taps = _kernel(offsets - (((middle - base)[:, None] + nodes)[:, :, None]))
    responses = np.fft.rfft(taps[:, :, ::-1], n=_FFT_LENGTH, axis=-1)
    start = base + offsets[0]
    low = int(start.min())
    inputs = _padded(samples, low, int(start.max()) + _FFT_LENGTH)
    windows = np.lib.stride_tricks.sliding_window_view(inputs, _FFT_LENGTH, axis=0)
    spectra = np.fft.rfft(windows[start - low], axis=-1)  # (n_spans, n_channels, n_freqs)
    steps = np.zeros((n_spans, SPAN))
    steps.reshape(-1)[: len(positions)] = positions
    steps -= np.arange(SPAN) + middle[:, None]
    result = np.zeros((n_spans, n_channels, SPAN))
    for delay in range(nodes.shape[1]):
        filtered = np.fft.irfft(spectra * responses[:, None, delay], axis=-1)
        valid = filtered[:, :, len(offsets) - 1 : len(offsets) - 1 + SPAN]
        result += valid * _lagrange(steps, nodes, delay)[:, None, :]
    return result.transpose(0, 2, 1).reshape(-1, n_channels)[: len(positions)]


def _direct(samples: FloatArray, positions: FloatArray, ratio: float) -> FloatArray:
    """Apply a separate row of the (stretched) kernel for every output."""
    half = reach(ratio)
    offsets = np.arange(-half + 1, half + 1)
    out = np.empty((len(positions), samples.shape[1]))
    for first in range(0, len(positions), _OUTPUTS_AT_ONCE):
        part = positions[first : first + _OUTPUTS_AT_ONCE]
        base = np.floor(part).astype(np.int64)
        low = int(base[0]) + int(offsets[0])
        inputs = _padded(samples, low, int(base[-1]) + int(offsets[-1]) + 1)
        windows = np.lib.stride_tricks.sliding_window_view(inputs, len(offsets), axis=0)
        taps = _kernel((offsets - (part - base)[:, None]) / ratio) / ratio
        out[first : first + len(part)] = np.einsum(
            "nk,nck->nc", taps, windows[base + int(offsets[0]) - low]
        )
    return out


def _delays_needed(spread: FloatArray) -> IntArray:
    """Return the number of fixed delays that keep the error of interpolation within tolerance.

    Interpolation of exp(iπx) at m Chebyshev nodes over ±spread has an error of at most
    ``(π spread)^m / (2^(m-1) m!)``. A number above `_MOST_DELAYS` means that none suffices.
    """
    needed = np.full(len(spread), _MOST_DELAYS + 1)
    for delays in range(_MOST_DELAYS, 0, -1):
        error = (np.pi * spread) ** delays / (2 ** (delays - 1) * math.factorial(delays))
        needed[error < _TOLERANCE] = delays
    return needed


def _lagrange(x: FloatArray, nodes: FloatArray, which: int) -> FloatArray:
    """Return the weight of node `which` at `x` (n_spans, n); `nodes` is (n_spans, n_delays)."""
    weight = np.ones_like(x)
    for other in range(nodes.shape[1]):
        if other != which:
            distance = nodes[:, which] - nodes[:, other]
            weight *= (x - nodes[:, other, None]) / distance[:, None]
    return weight


@cache
def _table() -> tuple[FloatArray, FloatArray]:
    """Return the kernel and its differences at multiples of 1/_PHASES sample, from 0 on."""
    u = np.arange(HALF_WIDTH * _PHASES + 1) / _PHASES
    window = np.i0(_BETA * np.sqrt(np.maximum(0.0, 1 - (u / HALF_WIDTH) ** 2))) / np.i0(_BETA)
    table = np.append(np.sinc(u) * window, 0.0)
    table[-2] = 0.0
    return table[:-1], np.diff(table)


def _kernel(u: FloatArray) -> FloatArray:
    """Return the windowed sinc at distance `u`, in samples of the lower rate."""
    table, steps = _table()
    place = np.minimum(np.abs(u) * _PHASES, float(len(table) - 1))
    index = place.astype(np.int64)
    return np.asarray(table[index] + (place - index) * steps[index])


def _padded(samples: FloatArray, first: int, last: int) -> FloatArray:
    """Return rows `first` to `last` (not included), padded with zeros."""
    low, high = max(first, 0), min(last, len(samples))
    if low == first and high == last:
        return samples[first:last]
    out = np.zeros((last - first, samples.shape[1]))
    if high > low:
        out[low - first : high - first] = samples[low:high]
    return out
