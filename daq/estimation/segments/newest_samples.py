"""Samples of the newest segment of a growing recording: half of them are in the next one too."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.alignment.aligned_recording import AlignedRecording

    FloatArray = NDArray[np.float64]
    BoolArray = NDArray[np.bool_]

MOST_VALUES = 1 << 19
"""Samples times channels that are kept at most: 4 MB."""


class NewestSamples:
    """Reads a recording's grid without reading twice what overlaps, as long as its clocks stay."""

    def __init__(self, aligned: AlignedRecording) -> None:
        self._aligned = aligned
        self._begin = self._n_settings = 0
        self._samples, self._valid = np.empty((0, 0)), np.empty(0, dtype=np.bool_)

    def read(self, begin: int, end: int) -> tuple[FloatArray, BoolArray]:
        """Return grid samples, and whether each is valid, as `AlignedRecording.read` does."""
        known = self._begin + len(self._samples)
        if self._n_settings == self._aligned.n_settings and self._begin <= begin < known <= end:
            new, new_valid = self._aligned.read(known, end)
            samples = np.concatenate([self._samples[begin - self._begin :], new])
            valid = np.concatenate([self._valid[begin - self._begin :], new_valid])
        else:
            samples, valid = self._aligned.read(begin, end)
        if samples.size <= MOST_VALUES:
            self._begin, self._n_settings = begin, self._aligned.n_settings
            self._samples, self._valid = samples.copy(), valid
        return samples, valid
