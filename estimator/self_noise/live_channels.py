"""Live channels and sensors of a test: neither dead nor copies of others.

Live channels are estimated as if the other channels did not exist.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from estimator.self_noise.coherency import Coherency
    from estimator.types import FloatArray


@dataclass(frozen=True, slots=True)
class Presence:
    """The live channels and sensors of a bench.

    Attributes
    ----------
    channels : tuple of int
        Channels that are neither dead nor copies of earlier ones.
    sensors : tuple of int
        Sensors with a live channel.
    dims : tuple of int
        Number of live channels of each of `sensors`.
    whole : tuple of int
        Sensors with only live channels.
    """

    channels: tuple[int, ...]
    sensors: tuple[int, ...]
    dims: tuple[int, ...]
    whole: tuple[int, ...]

    def spread(self, values: FloatArray, n_channels: int) -> FloatArray:
        """Return values of live channels, shape (n_freqs, …), extended by NaN for all others."""
        found = np.full((len(values), n_channels), np.nan)
        found[:, list(self.channels)] = values
        return found


def presence(given: Coherency, dims: tuple[int, ...]) -> Presence:
    """Return the channels that are live at most frequencies.

    Parameters
    ----------
    given : Coherency
    dims : tuple of int
        Number of channels of each sensor.
    """
    absent = given.absent[given.valid].mean(axis=0) > 0.5
    sensor_of = np.repeat(np.arange(len(dims)), dims)
    count = np.bincount(sensor_of[~absent], minlength=len(dims))
    return Presence(
        channels=tuple(int(channel) for channel in np.flatnonzero(~absent)),
        sensors=tuple(int(sensor) for sensor in np.flatnonzero(count)),
        dims=tuple(int(n) for n in count if n),
        whole=tuple(int(sensor) for sensor in np.flatnonzero(count == dims)),
    )
