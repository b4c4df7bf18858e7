"""Channels and sensors that take part in a test: not dead ones, and not copies of others.

The other channels are estimated as if those did not exist.
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
    """The part of a bench that takes part.

    Attributes
    ----------
    channels : tuple of int
        Those that are alive, and no copies of earlier ones.
    sensors : tuple of int
        Those with any such channel.
    dims : tuple of int
        How many of them each of `sensors` has.
    whole : tuple of int
        Sensors of which every channel takes part.
    """

    channels: tuple[int, ...]
    sensors: tuple[int, ...]
    dims: tuple[int, ...]
    whole: tuple[int, ...]

    def spread(self, values: FloatArray, n_channels: int) -> FloatArray:
        """Return values of these channels, shape (n_freqs, …), with NaN for all others."""
        found = np.full((len(values), n_channels), np.nan)
        found[:, list(self.channels)] = values
        return found


def presence(given: Coherency, dims: tuple[int, ...]) -> Presence:
    """Say which channels take part, at most frequencies.

    Parameters
    ----------
    given : Coherency
    dims : tuple of int
        Channels of each sensor.
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
