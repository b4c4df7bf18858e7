"""The clock of a polled sensor, of which every sample has its instant."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from daq.timing.clock_model import Clock, ClockSource, ClockState, Epoch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]


def from_instants(
    sensor: str,
    seconds: FloatArray,
    *,
    sampling_rate: float,
    first_samples: IntArray,
    first_rows: IntArray,
) -> Clock:
    """Return the clock of a polled sensor, for which every sample has its instant.

    Parameters
    ----------
    sensor : str
    seconds : float64, shape (n_samples,)
        From the recording's origin, in the order of the file's rows.
    sampling_rate : float
        Nominal, in Hz.
    first_samples, first_rows : int64, shape (n_stretches,)
        Sample index and row at which each contiguous stretch begins. A gap between stretches does
        not end an epoch: time is straight across it. Only time that goes back does.
    """
    rows = np.append(first_rows, len(seconds))
    index = np.arange(len(seconds), dtype=float)
    index += np.repeat(first_samples - first_rows, np.diff(rows))
    goes_back = seconds[first_rows[1:]] <= seconds[first_rows[1:] - 1]
    cuts = [0, *first_rows[1:][goes_back].tolist(), len(seconds)]
    epochs = [
        Epoch(int(index[low]), int(index[high - 1]) + 1, index[low:high], seconds[low:high])
        for low, high in pairwise(cuts)
    ]
    covered = float((seconds[rows[1:] - 1] - seconds[first_rows]).sum())
    intervals = len(seconds) - len(first_rows)
    ppm = (intervals / covered / sampling_rate - 1) * 1e6 if covered > 0 else float("nan")
    state = ClockState(
        sensor=sensor,
        source=ClockSource.SAMPLE_INSTANTS,
        offset=epochs[0].start,
        ppm=ppm,
        ppm_std=0.0,
        wander_ppm=0.0,
        residual=0.0,
        n_epochs=len(epochs),
    )
    return Clock(tuple(epochs), state)
