"""Segments of the grid in each sensor's own samples: what needs no interpolation.

A segment lies on a sensor's clock at a whole number of samples, a fraction and a drift, as long as
that clock is straight within it. Where samples are missing, clocks restart or bend, or rates
differ, there are no such segments, and the grid is interpolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.clocks.grid import Grid
    from daq.clocks.sensor_reader import SensorSource

    FloatArray = NDArray[np.float64]

_BEND = 1e-4
"""Samples by which a clock may depart from a straight line in half a segment.

Half a microsecond at 200 Hz: refined clocks are no better.
"""


@dataclass(frozen=True, slots=True, eq=False)
class OwnSamples:
    """Samples of one sensor, and where the segments of the grid lie among them.

    Attributes
    ----------
    samples : float64, shape (n_samples, n_channels)
        In physical units, none missing.
    rows : int64, shape (n_segments,)
        First row of each segment.
    shift : float64, shape (n_segments,)
        By how much a segment's middle on the grid lies after that of its rows, in samples.
    drift : float64, shape (n_segments,)
        Own samples per sample of the grid, less one.
    """

    samples: FloatArray
    rows: NDArray[np.int64]
    shift: FloatArray
    drift: FloatArray

    @classmethod
    def of(
        cls, source: SensorSource, grid: Grid, begins: NDArray[np.int64], length: int
    ) -> OwnSamples | None:
        """Return the segments that begin at grid samples `begins`; None where they are not whole.

        Parameters
        ----------
        source : SensorSource
        grid : Grid
        begins : int64, shape (n_segments,)
            Increasing.
        length : int
            Of each segment.
        """
        if source.record.sampling_rate != grid.sampling_rate:
            return None
        offsets = np.array([0.0, length / 2, length])
        seconds = grid.start + (begins[:, None] + offsets) / grid.sampling_rate
        epochs = source.known_clock.between(seconds[0, 0], seconds[-1, -1])
        if len(epochs) != 1 or not epochs[0].is_placed:
            return None
        first, middle, last = epochs[0].position(seconds.ravel()).reshape(seconds.shape).T
        if np.abs(middle - (first + last) / 2).max() > _BEND:
            return None
        at = np.floor(middle - length / 2 + 0.5).astype(np.int64)
        low, high = int(at.min()), int(at.max()) + length
        # The interpolated grid has no samples either where a clock is prolonged.
        if low < epochs[0].first_sample or high > epochs[0].end_sample:
            return None
        samples = np.empty((high - low, len(source.columns)))
        if not source.fill(samples, low).all() or not math.isfinite(samples.sum()):
            return None
        return cls(samples, at - low, middle - length / 2 - at, (last - first) / length - 1)
