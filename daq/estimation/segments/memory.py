"""How much memory an estimate takes, and how many sensors a live one may have.

Most of it are matrices of all channels at all frequencies, and what methods and diagnosis make of
them; and the information on all pairs of channels in each band, by which shared noise is found. The
number of both was measured: docs/validation/torture.md.
"""

from __future__ import annotations

import logging
from bisect import bisect_right
from itertools import accumulate
from typing import TYPE_CHECKING

from daq.alignment.sensor_reader import main_columns
from estimator.diagnostics.shared_noise import MAX_CHANNELS

if TYPE_CHECKING:
    from daq.estimation.settings import Settings
    from daq.recording.interface import ReadableRecording
    from estimator.spectra.welch import WelchSettings

_LOGGER = logging.getLogger(__name__)
MATRICES = 9
"""Matrices that exist at the same time, at most: in the diagnosis."""
PAIR_TABLES = 27
"""Tables of all pairs of channels by all pairs that exist at the same time: some 20 bands."""
LARGE = 1e9
"""Bytes from which on an estimate is announced, and is not live with all sensors."""
PART_BYTES = 60e6
"""Bytes that the matrices of a live estimate of a part of the sensors may take, by the prediction
of a diagnosed one: such an estimate is not diagnosed."""
MIN_SENSORS = 3
"""Minimum number of sensors in a live estimate."""


def bytes_of(n_channels: int, sampling_rate: float, segment: float) -> float:
    """Return the memory that an estimate takes, beside the program.

    Parameters
    ----------
    n_channels : int
    sampling_rate : float
        Of the grid, in Hz.
    segment : float
        In seconds.
    """
    n_pairs = n_channels * (n_channels - 1) / 2 if n_channels <= MAX_CHANNELS else 0.0
    return _matrices(n_channels, sampling_rate, segment) + PAIR_TABLES * 8.0 * n_pairs**2


def _matrices(n_channels: int, sampling_rate: float, segment: float) -> float:
    return MATRICES * 16.0 * (segment * sampling_rate / 2 + 1) * n_channels**2


def live_sensors(recording: ReadableRecording, settings: Settings) -> tuple[str, ...] | None:
    """Return the sensors of a live estimate: the first ones; None where that is all of them."""
    rate = settings.sampling_rate or min(each.sampling_rate for each in recording.sensors)
    n_channels = [*accumulate(len(main_columns(record)) for record in recording.sensors)]
    if bytes_of(n_channels[-1], rate, settings.segment) <= LARGE:
        return None
    matrices = [_matrices(n, rate, settings.segment) for n in n_channels]
    n_sensors = max(MIN_SENSORS, bisect_right(matrices, PART_BYTES))
    names = tuple(record.name for record in recording.sensors)
    return names[:n_sensors] if n_sensors < len(names) else None


def announce(n_channels: int, welch: WelchSettings) -> None:
    """Log how much memory a large estimate is about to take."""
    rate = welch.sampling_rate
    needed = bytes_of(n_channels, rate, welch.segment_length / rate)
    if needed > LARGE:
        _LOGGER.warning(
            "the result of %d channels takes about %.0f GB of memory;"
            " a shorter --segment takes less",
            n_channels,
            needed / 1e9,
        )
