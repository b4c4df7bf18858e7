"""Sensors in step: the phase that each lag adds to a sensor, so that it can be taken off.

A lag turns the directions of the motion from one frequency to the next. Their mean over many
frequencies, with which `estimator.levels.pooled` divides weak motion from noise, would be of no
motion. The noise itself does not depend on any channel's phase.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.types import ComplexArray, IntArray

FINE = 4
"""Lags for each that the frequencies resolve."""
FARTHEST = 0.25
"""Largest lag as a share of a segment."""
BY_CHANCE = 1e-6
"""Probability at most that independent sensors seem to lag."""


def phases(
    coherency: ComplexArray,
    line: IntArray,
    dims: tuple[int, ...],
    n_effective: float,
    block: IntArray,
) -> ComplexArray | None:
    """Return what brings sensors into step, shape (n_lines, n_channels); None if all are.

    The lag of a sensor is that at which its cross-correlation with the sensor most coherent with
    the others has most energy, of all pairs of their channels together: whatever their axes. It is
    taken off in blocks in which their sum has more energy then: others may have other lags.

    Parameters
    ----------
    coherency : complex128, shape (n_lines, n_channels, n_channels)
        Channels grouped by sensor.
    line : int64, shape (n_lines,)
        Frequencies, in units of their constant distance.
    dims : tuple of int
    n_effective : float
        Independent averages.
    block : int64, shape (n_lines,)
        From 0, rising.
    """
    first = np.cumsum((0, *dims[:-1]))
    shared = np.add.reduceat((np.abs(coherency) ** 2).sum(axis=0), first, axis=0)
    between = np.add.reduceat(shared, first, axis=1) / np.outer(dims, dims)
    reference = int(np.argmax(between.sum(axis=0) - np.diagonal(between)))
    own = slice(first[reference], first[reference] + dims[reference])
    n = FINE * (int(line[-1]) + 1)
    lags = np.rint(np.fft.fftfreq(n, 1 / n)).astype(np.int64)
    near = np.abs(lags) <= FARTHEST * n
    begins = np.flatnonzero(np.diff(block, prepend=-1))
    turns = np.zeros((len(line), len(dims)))
    for sensor, (begin, d) in enumerate(zip(first, dims, strict=True)):
        if sensor == reference:
            continue
        series = np.zeros((n, d, dims[reference]), np.complex128)
        series[line] = coherency[:, begin : begin + d, own]
        energy = (np.abs(np.fft.fft(series, axis=0)) ** 2).sum(axis=(1, 2))
        at = int(np.argmax(np.where(near, energy, 0.0)))
        k, surprise = d * dims[reference], math.log(n / BY_CHANCE)
        limit = k + 2 * math.sqrt(k * surprise) + 2 * surprise
        # twice that of chi squared over two: a window correlates neighbouring lines
        if energy[at] > limit * len(line) / n_effective:
            both = (
                series[line],
                series[line] * np.exp(-2j * np.pi * line * lags[at] / n)[:, None, None],
            )
            alone, turned = (
                (np.abs(np.add.reduceat(each, begins)) ** 2).sum(axis=(1, 2)) for each in both
            )
            turns[:, sensor] = line * lags[at] / n * (turned > alone)[block]
    if not turns.any():
        return None
    return np.asarray(np.exp(-2j * np.pi * np.repeat(turns, dims, axis=1)))
