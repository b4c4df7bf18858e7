"""The part of their rounding to whole counts that like channels share.

A rounding error is ``e(x) = sum_m (-1)**m sin(2 pi m x) / (pi m)`` of the value x in counts. Where
x spreads over half a count or more, the errors of two channels at times t apart have the covariance

    ``rho(v) = sum_m exp(-2 pi**2 m**2 v) cos(2 pi m o) / (2 pi**2 m**2)``,

with o the mean and v the variance of the difference of the channels' values at these times: 1/12
where both are 0. It is a cross-spectrum like that of the motion, and the estimate takes it out of
the noise with the motion; between other channels it adds to the noise. The difference is seen after
rounding only, where its variance is ``v + 1/6 - 2 rho(v)``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from estimator.types import ComplexArray, FloatArray, IntArray

NEAR = 1.0
"""Variance of the difference in counts**2 from which nothing is shared: 1e-9 of the rounding."""
MARGIN = 0.5
"""Share of the largest cross-spectrum by which the effect of all on a channel is uncertain; twice
as much of more than three sensors, of which the likelihood may take some for motion."""
CERTAIN = 0.98
"""Share of a variance that is certain to be there: with less of it, more is shared."""
_ORDERS = np.arange(1, 12)
_FEWEST = 4  # frequencies, or distinct samples
_OFF = 0.1
"""Share of a step by which differences of samples may be off its multiples."""
_KNOTS = np.linspace(0.0, np.sqrt(NEAR), 300) ** 2


def step_of(samples: FloatArray) -> float:
    """Return the step of which all differences of samples are multiples; NaN without one.

    As of the digits of a text, or of floats beside a large mean.

    Parameters
    ----------
    samples : float, shape (n_samples,)
    """
    gaps = np.diff(np.sort(samples[np.isfinite(samples)].astype(np.float64)))
    gaps = gaps[gaps > 0]
    if len(gaps) < _FEWEST - 1:
        return np.nan
    step = gaps.sum() / np.rint(gaps / gaps.min()).sum()
    off = np.abs(gaps / step - np.rint(gaps / step)).max()
    return float(step) if off < _OFF else np.nan


def covariance(variance: FloatArray, cosines: FloatArray | float = 1.0) -> FloatArray:
    """Return the covariance of two channels' rounding errors in counts**2.

    Parameters
    ----------
    variance : float64, shape (n,)
        Of the difference of their values, in counts**2.
    cosines : float64, shape (11,), optional
        ``cos(2 pi m o)`` of the mean difference o for m = 1, 2, …; default: of none.
    """
    squares = (np.pi * _ORDERS) ** 2
    return np.asarray(np.exp(-2 * np.outer(variance, squares)) @ (cosines / (2 * squares)))


def before_rounding(seen: FloatArray, cosines: FloatArray | float = 1.0) -> FloatArray:
    """Return the variance of a difference whose rounded values have the variance `seen`.

    Where two variances would have been seen so, the smaller one: more is shared.
    """
    table = np.maximum.accumulate(_KNOTS + 1 / 6 - 2 * covariance(_KNOTS, cosines))
    seen = CERTAIN * seen
    table -= 1e-12 * (len(table) - np.arange(len(table)))  # strictly rising
    return np.where(seen > table[-1], seen - 1 / 6, np.interp(seen, table, _KNOTS))


def shared_rounding(
    csm: ComplexArray,
    frequency: FloatArray,
    *,
    counts: ComplexArray,
    sensor: IntArray,
    means: Callable[[], FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return the rounding that channels share with those of other sensors, and what it does.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided, in unit**2/Hz; what is not finite counts as zero.
    frequency : float64, shape (n_freqs,)
        In Hz, ascending.
    counts : complex128, shape (n_freqs, n_channels)
        Counts per unit; NaN for channels that do not count.
    sensor : int64, shape (n_channels,)
        Sensor of each channel.
    means : callable
        Returns the means of stretches in counts, (n_stretches, n_channels). It is called where
        channels are alike.

    Returns
    -------
    most, lacking : float64, shape (n_freqs, n_channels)
        The largest PSD that a channel shares with another, and the PSD that the estimate of its
        noise lacks, to first order; in counts**2/Hz.
    """
    most, lacking = np.zeros((2, len(frequency), len(sensor)))
    known = np.isfinite(csm[:, 0, 0])
    if np.count_nonzero(known) < _FEWEST:
        return most, lacking
    f, gain = frequency[known], np.nan_to_num(counts[known])
    power = np.einsum("fij,fi,fj->ij", csm[known], np.gradient(f)[:, None] * gain, gain.conj()).real
    own = np.diagonal(power)
    alike = (own[:, None] + own - 2 * np.abs(power) < NEAR) & (own > 0) & (own[:, None] > 0)
    alike &= sensor[:, None] != sensor
    if not alike.any():
        return most, lacking
    sign, at = np.sign(power), means()
    found = {}
    for i, j in np.argwhere(np.triu(alike)).tolist():
        cross = csm[known, i, j] * gain[:, i] * gain[:, j].conj() * sign[i, j]
        both = sum(csm[known, n, n].real * np.abs(gain[:, n]) ** 2 for n in (i, j))
        turns = 2 * np.pi * np.outer(_ORDERS, at[:, i] - sign[i, j] * at[:, j])
        psd = _shared(np.stack([both, cross]), np.cos(turns).mean(axis=1), f, frequency)
        found[i, j] = found[j, i] = psd
        for column in (i, j):
            most[:, column] = np.maximum(most[:, column], np.abs(psd))
    n_others = len(set(sensor.tolist())) - 1
    for i in np.flatnonzero(alike.any(axis=1)).tolist():
        lacking[:, i] = _lacking(found, np.flatnonzero(alike[i]).tolist(), i, n_others)
    return most, lacking


def _lacking(
    found: dict[tuple[int, int], FloatArray], partners: list[int], i: int, n_others: int
) -> FloatArray:
    """Return ``c_ij + c_ik - c_jk``, averaged over pairs of the other sensors."""
    total = np.asarray(2 / n_others * sum(found[i, j] for j in partners))
    pairs = [found[j, k] for j in partners for k in partners if j < k and (j, k) in found]
    return total - 2 / max(n_others * (n_others - 1), 1) * sum(pairs, np.zeros_like(total))


def _shared(
    spectra: ComplexArray, cosines: FloatArray, known: FloatArray, frequency: FloatArray
) -> FloatArray:
    """Return the PSD that two channels share, of the sum of their PSDs and their cross-spectrum."""
    step = float(np.diff(frequency).min())
    even = np.arange(round(frequency[-1] / step) + 1) * step
    filled = [np.interp(even, known, each, left=0.0, right=0.0) for each in spectra]
    power, lagged = np.fft.irfft(filled) * even[-1]
    variance = before_rounding(np.maximum(power[0] - 2 * lagged, 0.0), cosines)
    psd = np.fft.rfft(covariance(variance, cosines)) / even[-1]
    return np.asarray(np.interp(frequency, even, psd.real))
