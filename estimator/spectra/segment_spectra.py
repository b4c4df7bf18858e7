"""Spectra of single segments at a few frequencies, which show changes with time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from estimator.types import ComplexArray, IntArray

KEPT_FREQUENCIES = 48
MAX_SEGMENTS, MAX_VALUES = 4096, 1 << 21
"""Maximum numbers of kept segments and values; beyond, every second segment is kept, then every
fourth, and so on."""


def kept_bins(n_freqs: int) -> IntArray:
    """Return the kept bins, with a constant ratio where they are distinct.

    Parameters
    ----------
    n_freqs : int
        Number of frequencies of a spectrum, from 0 to half the sampling rate.

    Returns
    -------
    int64, shape (n_kept,)
        Without the two lowest bins and the highest tenth.
    """
    highest = int(0.9 * (n_freqs - 1))
    if highest <= 2:
        return np.empty(0, np.int64)
    kept = np.round(np.geomspace(2, highest, KEPT_FREQUENCIES)).astype(np.int64)
    return np.array(sorted(set(kept.tolist())), dtype=np.int64)


class SegmentSpectra:
    """Spectra of single segments at `bins`.

    Parameters
    ----------
    bins : int64, shape (n_kept,)
    n_channels : int

    Attributes
    ----------
    every : int
        Every `every`-th segment is kept.
    most : int
        Maximum number of kept segments.
    """

    def __init__(self, bins: IntArray, n_channels: int) -> None:
        self.bins = bins
        self.every = 1
        self.most = max(1, min(MAX_SEGMENTS, MAX_VALUES // max(1, len(bins) * n_channels)))
        self._n_channels = n_channels
        self._n_seen = 0
        self._kept = np.empty((0, len(bins), n_channels), np.complex64)
        self._n_kept = 0

    def add(self, spectra: ComplexArray) -> None:
        """Add the spectra of segments, in order of time.

        Parameters
        ----------
        spectra : complex, shape (n_segments, n_kept, n_channels)
        """
        number = self._n_seen + np.arange(len(spectra))
        self._n_seen += len(spectra)
        kept = number % self.every == 0
        while self._n_kept + np.count_nonzero(kept) > self.most:
            self.thin(2 * self.every)
            kept = number % self.every == 0
        end = self._n_kept + int(np.count_nonzero(kept))
        if end > len(self._kept):
            # One array that grows: small ones would lie between others that are freed.
            n_rows = max(end, min(2 * len(self._kept), self.most))
            room = np.empty((n_rows, *self._kept.shape[1:]), np.complex64)
            room[: self._n_kept] = self.values()
            self._kept = room
        self._kept[self._n_kept : end] = spectra[kept]
        self._n_kept = end

    def __len__(self) -> int:
        """Return the number of kept segments."""
        return self._n_kept

    def thin(self, every: int) -> None:
        """Keep every `every`-th segment from now on, a multiple of the current value."""
        if every != self.every:
            self._kept = self.values()[:: every // self.every].copy()
            self._n_kept = len(self._kept)
            self.every = every

    def values(self) -> NDArray[np.complex64]:
        """Return the kept spectra, (n_segments, n_kept, n_channels), not scaled to a density.

        Later segments do not change them.
        """
        return self._kept[: self._n_kept]
