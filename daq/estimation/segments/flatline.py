"""Channels that stand still for part of a recording, or follow a straight line: not measured.

A channel whose count does not change for a moment has lost its signal, or its counts are too
coarse. One that stands still most of the time is no news: it is dead, or always that coarse. A
straight line fills a gap. Whole numbers that lie on one but for rounding may also be slow motion
in coarse counts; not where neighbouring samples usually differ by many.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_PARTS = 8  # of a hop, examined one by one
_MIN_SAMPLES = 32  # samples of a part
_STILL = 1e-12  # of its value: a channel that changes less is at rest but for rounding
_STRAIGHT = 1e-9  # of its change: what leaves the line through its ends less is on it
_ROUNDED = 1 + 1e-9  # counts: half of one at the ends, and half of one between
_SLOPE = 8  # counts from end to end, from which whole numbers follow a line
_ROUGH = 16  # counts of a second difference that is more than rounding


def stands_still(samples: FloatArray) -> NDArray[np.bool_]:
    """Return which channels change no more than by rounding, along the first axis of `samples`."""
    return np.asarray(np.ptp(samples, axis=0) <= _STILL * np.abs(samples[0]))


class FlatlineDetector:
    """How long each channel has stood still or followed a straight line, hop by hop.

    Parameters
    ----------
    hop : int
        Samples from one segment to the next.
    n_channels : int
    sampling_rate : float
        Hz.
    """

    def __init__(self, hop: int, n_channels: int, sampling_rate: float) -> None:
        self._hop = hop
        self._n_parts = max(1, min(_PARTS, hop // _MIN_SAMPLES))
        self._length = hop // self._n_parts
        self._seconds = hop / self._n_parts / sampling_rate
        self.counts = np.zeros((3, n_channels + 1), dtype=np.int64)
        """Parts in which each channel stood still or was on a line, in which its whole numbers were
        on one, and in which they were rough; last the parts seen."""

    def add(self, samples: FloatArray, usable: NDArray[np.bool_]) -> None:
        """Look at whole hops of `samples`, shape (n_samples, n_channels), where all are usable."""
        n_hops = len(samples) // self._hop
        shape = (n_hops, self._hop, samples.shape[1])
        parts = samples[: n_hops * self._hop].reshape(shape)[:, : self._n_parts * self._length]
        parts = parts.reshape(n_hops * self._n_parts, self._length, -1)
        hops = usable[: n_hops * self._hop].reshape(n_hops, self._hop)
        used = hops[:, : self._n_parts * self._length].reshape(len(parts), -1)
        if not usable.all():
            parts = parts[used.all(axis=1)]
        self.counts[:, -1] += len(parts)
        if not len(parts):
            return
        first, change = parts[:, 0], parts[:, -1] - parts[:, 0]
        whole = (np.rint(first) == first) & (np.rint(change) == change)
        rounded = whole & (np.abs(change) >= _SLOPE)
        allowed = np.maximum(_STILL * np.abs(first), _STRAIGHT * np.abs(change))
        allowed = np.where(rounded, _ROUNDED, allowed)
        middle = self._length // 2
        bend = parts[:, middle - 1] - 2 * parts[:, middle] + parts[:, middle + 1]
        self.counts[2, :-1] += (np.abs(bend) >= _ROUGH).sum(axis=0)
        perhaps: NDArray[np.bool_] = np.abs(bend) <= 4 * allowed
        for place in range(self._length // 3, self._length - 1, self._length // 3):
            if not perhaps.any():  # of nearly all parts the first tells enough
                return
            line = first + change * (place / (self._length - 1))
            perhaps &= np.abs(parts[:, place] - line) <= allowed
        along = np.linspace(0.0, 1.0, self._length)[:, None]
        for number in np.flatnonzero(perhaps.any(axis=1)):
            beside = parts[number] - first[number] - along * change[number]
            found = np.abs(beside).max(axis=0) <= allowed[number]
            self.counts[0, :-1] += found & ~rounded[number]
            self.counts[1, :-1] += found & rounded[number]

    def for_a_while(self) -> FloatArray:
        """Return for how long each channel was not measured, in seconds; 0 if most of the time."""
        seen = self.counts[0, -1]
        still, rounded, rough = self.counts[:, :-1]
        still = still + np.where(2 * rough > seen, rounded, 0)
        return np.where(2 * still < seen, still * self._seconds, 0.0)
