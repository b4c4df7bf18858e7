"""Spectra of a segment on another clock, from samples that are not interpolated.

Theory of operation
-------------------
A segment of the common grid lies, on a sensor's own clock, at ``k + d + e u``: shifted by `d`
samples, stretched by `e`, with ``u`` counted from its middle. Instead of interpolating the samples,
the window is shifted by ``d`` and the stretch is developed to second order; derivatives of the
samples become powers of frequency, those of the window are known in closed form:

    Y = exp(iωd) [F(h0) + iω F(h1) - ω² F(h2)],
    h0 = W - e (W u)' + e²/2 (W u²)'',   h1 = e W u - e² (W u²)',   h2 = e²/2 W u²,

where F is the transform of window times samples and W the shifted window. It must vanish, with its
slope, at the ends of the segment: a Hann window does, others do not.

All windows are products of 1, cos, sin (of the Hann window) and 1, k, k²: a small matrix times
these nine rows.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from estimator.types import ComplexArray, FloatArray, IntArray

PRECISION = 1e-5
"""Error of the series relative to the motion, as an amplitude: -100 dB, as interpolation has."""
_HIGHEST = 0.45  # of the sampling rate: above, clocks that differ allow no estimate
_SHORTEST = 256  # samples: below, the part of a sample at the ends of the window counts
_CACHED_VALUES = 1 << 15  # samples times channels: 256 kB
_LEVER = 1 / 6  # of a segment's length: rms of u under a Hann window


def order_of(drift: float, length: int) -> int | None:
    """Return the order of the series that is precise for a drift; None if none is.

    Parameters
    ----------
    drift : float
        Largest, of the sensor's clock against the grid: 1e-6 is 1 ppm.
    length : int
        Of the segment, in samples.
    """
    if length < _SHORTEST:
        return None
    size = abs(drift) * 2 * np.pi * _HIGHEST * length * _LEVER
    errors = (size, size**2 / 2, size**3 / 6)
    return next((order for order, error in enumerate(errors) if error <= PRECISION), None)


def shifted_spectra(
    samples: FloatArray,
    rows: IntArray,
    shift: FloatArray,
    drift: FloatArray,
    *,
    order: int,
    trends: FloatArray,
    out: ComplexArray | None = None,
) -> ComplexArray:
    """Return spectra of segments under a Hann window that lies on the grid.

    Parameters
    ----------
    samples : float64, shape (n_channels, n_samples)
        Of one sensor.
    rows : int64, shape (n_segments,)
        First sample of each segment.
    shift : float64, shape (n_segments,)
        `d`: position of the grid segment's middle less that of this one's, in samples; a fraction.
    drift : float64, shape (n_segments,)
        `e`: own samples per sample of the grid, less one.
    order : int
        As `order_of` returns it.
    trends : float64, shape (n_trends, length)
        Orthogonal trends that are removed from each segment; `length` is that of the segments.
    out : complex128, shape (n_segments, length // 2 + 1, n_channels), optional
        Takes the spectra.

    Returns
    -------
    complex128, shape (n_segments, length // 2 + 1, n_channels)
    """
    n_segments, n_channels, length = len(rows), len(samples), trends.shape[1]
    n_freqs = length // 2 + 1
    if out is None:
        out = np.empty((n_segments, n_freqs, n_channels), np.complex128)
    fit = trends / np.sum(trends**2, axis=1, keepdims=True)
    weights = _weights(shift, drift, length, order)
    derivative = 2j * np.pi / length * np.arange(n_freqs)
    turn = _turn(shift, length)
    # Few segments at a time, so that all that is made of them stays in the cache.
    block = min(n_segments, max(1, _CACHED_VALUES // (n_channels * length)))
    segments, products = np.empty((2, block, n_channels, length))
    total, lower = np.empty((2, block, n_channels, n_freqs), np.complex128)
    for first in range(0, n_segments, block):
        some = slice(first, min(first + block, n_segments))
        n = some.stop - first
        own, product, found = segments[:n], products[:n], total[:n]
        for number, row in enumerate(rows[some].tolist()):
            own[number] = samples[:, row : row + length]
        for trend, slope in zip(trends, fit, strict=True):
            np.subtract(own, np.multiply((own @ slope)[..., None], trend, out=product), out=own)
        windows = weights[:, some] @ _rows(length)
        for power in range(order, -1, -1):  # Horner's scheme in iω
            np.multiply(own, windows[power, :, None], out=product)
            if power == order:
                np.fft.rfft(product, axis=-1, out=found)
                continue
            found *= derivative
            found += np.fft.rfft(product, axis=-1, out=lower[:n])
        found *= turn[some, None]
        out[some] = found.swapaxes(1, 2)
    return out


def _turn(shift: FloatArray, length: int) -> ComplexArray:
    """Return exp(iωd), shape (n_segments, length // 2 + 1), by powers of one factor, 32 a row."""
    n_rows = length // 64 + 1
    angle = 2j * np.pi / length * shift[:, None]
    fine, coarse = np.exp(angle * np.arange(32)), np.exp(angle * (32 * np.arange(n_rows)))
    turned = (coarse[:, :, None] * fine[:, None]).reshape(len(shift), -1)
    return np.asarray(turned[:, : length // 2 + 1])


def _weights(shift: FloatArray, drift: FloatArray, length: int, order: int) -> FloatArray:
    """Return h0, h1, h2 up to `order` in terms of `_rows`, (order + 1, n_segments, 9)."""
    angle, nothing, one = 2 * np.pi * shift / length, np.zeros_like(shift), np.ones_like(shift)
    cosine, sine = np.cos(angle), np.sin(angle)
    flat = np.stack([one, nothing, nothing])  # in terms of 1, cos and sin of 2 pi k / length
    cos, sin = np.stack([nothing, cosine, sine]), np.stack([nothing, -sine, cosine])
    window, slope = 0.5 * flat - 0.5 * cos, np.pi / length * sin
    curvature = 2 * (np.pi / length) ** 2 * cos
    u0 = np.stack([one, nothing, nothing])  # in terms of 1, k, k²
    u1 = np.stack([-shift, one, nothing])
    u2 = np.stack([shift**2, -2 * shift, one])

    def product(of_window: FloatArray, of_u: FloatArray) -> FloatArray:
        return of_window[:, None] * of_u[None]

    first, second = drift, drift**2
    w, wu, wu2 = (product(window, each) for each in (u0, u1, u2))
    h = [w]
    if order >= 1:
        h[0] = h[0] - first * (product(slope, u1) + w)  # (W u)' = W' u + W
        h.append(first * wu)
    if order >= 2:
        # (W u²)' = W' u² + 2 W u,  (W u²)'' = W'' u² + 4 W' u + 2 W
        h[0] = h[0] + second / 2 * (product(curvature, u2) + 4 * product(slope, u1) + 2 * w)
        h[1] = h[1] - second * (product(slope, u2) + 2 * wu)
        h.append(second / 2 * wu2)
    return np.stack(h).reshape(order + 1, 9, len(shift)).swapaxes(1, 2)


@lru_cache(maxsize=4)
def _rows(length: int) -> FloatArray:
    """Return the products of 1, cos, sin and 1, k, k², shape (9, length); k from the middle."""
    k = np.arange(length) - length / 2
    angle = 2 * np.pi * np.arange(length) / length
    trigonometric = np.stack([np.ones(length), np.cos(angle), np.sin(angle)])
    powers = np.stack([np.ones(length), k, k**2])
    return np.asarray((trigonometric[:, None] * powers[None]).reshape(9, length))
