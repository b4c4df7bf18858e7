"""Segments of one recording that have short gaps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.spectra.gap_window import Leakage, gap_window, without_trend
from estimator.spectra.welch import CrossSpectra
from estimator.spectra.windows import get_window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from estimator.spectra.welch import WelchSettings

    FloatArray = NDArray[np.float64]


class GapBridge:
    """Spectra of segments with gaps, and what their windows bring in.

    Parameters
    ----------
    welch : WelchSettings
    n_channels : int
    most : float
        Share of a segment that gaps may take, with the ramps beside them.
    """

    def __init__(self, welch: WelchSettings, n_channels: int, *, most: float) -> None:
        self._welch, self._most = welch, most
        self.spectra = CrossSpectra(welch, n_channels, threads=1)
        self.leakage = Leakage(get_window(welch.window, welch.segment_length))

    def take(
        self,
        samples: FloatArray,
        usable: NDArray[np.bool_],
        clipped: NDArray[np.bool_] | None,
        starts: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """Take the segments at `starts` that have short gaps and are not clipped; return which."""
        length = self._welch.segment_length
        segments, taken = [np.empty((0, samples.shape[1]))], []
        for start in starts.tolist():
            span = slice(start, start + length)
            weight = gap_window(usable[span], length)
            if np.count_nonzero(weight < 1) > self._most * length:
                continue
            if clipped is not None and (clipped[span] & usable[span]).any():
                continue
            segment = without_trend(samples[span], weight, self._welch.detrend)
            segments.append(segment / np.sqrt(self.leakage.add(weight)))
            taken.append(start)
        self.spectra.add(np.concatenate(segments), np.arange(len(taken)) * length)
        return np.array(taken, dtype=np.int64)
