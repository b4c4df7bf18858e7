"""Channels that stand still for part of a recording and move for the rest: dead for a while.

A channel whose count does not change for a moment has lost its signal, or its counts are too
coarse. One that stands still most of the time is no news: it is dead, or always that coarse.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_PARTS = 8  # of a hop, examined one by one
_MIN_SAMPLES = 32  # samples of a part
_STILL = 1e-12  # of its value: a channel that changes less is at rest but for rounding


def stands_still(samples: FloatArray) -> NDArray[np.bool_]:
    """Return which channels change no more than by rounding, along the first axis of `samples`."""
    return np.asarray(np.ptp(samples, axis=0) <= _STILL * np.abs(samples[0]))


class FlatlineDetector:
    """How long each channel has stood still, hop by hop.

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
        self.counts = np.zeros(n_channels + 1, dtype=np.int64)
        """Parts in which each channel stood still, and last the parts seen."""

    def add(self, samples: FloatArray, usable: NDArray[np.bool_]) -> None:
        """Look at whole hops of `samples`, shape (n_samples, n_channels), where all are usable."""
        n_hops = len(samples) // self._hop
        shape = (n_hops, self._hop, samples.shape[1])
        parts = samples[: n_hops * self._hop].reshape(shape)[:, : self._n_parts * self._length]
        parts = parts.reshape(n_hops * self._n_parts, self._length, -1)
        hops = usable[: n_hops * self._hop].reshape(n_hops, self._hop)
        used = hops[:, : self._n_parts * self._length].reshape(len(parts), -1)
        whole: NDArray[np.bool_] = np.ones(len(parts), np.bool_)
        if not usable.all():
            whole[:] = used.all(axis=1)
        self.counts[-1] += int(whole.sum())
        first = parts[:, 0]
        perhaps = np.repeat(whole[:, None], first.shape[1], axis=1)
        for place in range(self._length // 3, self._length, max(1, self._length // 3)):
            perhaps &= np.abs(parts[:, place] - first) <= _STILL * np.abs(first)
            if not perhaps.any():  # of nearly all parts the first tells enough
                return
        for number in np.flatnonzero(perhaps.any(axis=1)):
            self.counts[:-1] += perhaps[number] & stands_still(parts[number])

    def for_a_while(self) -> FloatArray:
        """Return for how long each channel stood still, in seconds; 0 if most of the time."""
        *still, seen = self.counts
        return np.where(2 * np.array(still) < seen, np.array(still) * self._seconds, 0.0)
