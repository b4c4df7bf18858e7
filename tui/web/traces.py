"""The last seconds of every channel, as lines of a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tui.wording.formatting import readings

if TYPE_CHECKING:
    from daq.recording.reader import Recording

SPAN = 10.0
"""Seconds."""
COLUMNS = 150
"""Columns of the picture of a channel, each from the least to the largest sample in it."""
HEIGHT = 40


@dataclass(frozen=True, slots=True)
class Trace:
    """The last samples of a channel.

    Attributes
    ----------
    name : str
        Sensor and channel.
    points : str
        Of a line in a picture of `COLUMNS` by `HEIGHT`.
    size : str
        From the least to the largest sample, with its unit.
    """

    name: str
    points: str
    size: str


def traces(recording: Recording) -> tuple[Trace, ...]:
    """Return the traces of all channels that are estimated."""
    found = []
    for sensor in recording.sensors:
        n_samples = min(sensor.n_samples, round(SPAN * sensor.sampling_rate))
        if n_samples < 2:
            continue
        counts = sensor.counts(sensor.n_samples - n_samples)
        edges = np.unique(np.linspace(0, n_samples, COLUMNS + 1).astype(np.int64))[:-1]
        low, high = (ufunc.reduceat(counts, edges, axis=0) for ufunc in (np.minimum, np.maximum))
        for column, channel in enumerate(sensor.channels):
            if channel.auxiliary:
                continue
            least, most = int(low[:, column].min()), int(high[:, column].max())
            scale = (HEIGHT - 2) / max(1, most - least)
            # down and up in turn: half the points of a box for each column
            ends = np.stack((low[:, column], high[:, column]), axis=1).astype(float)
            ends[1::2] = ends[1::2, ::-1]
            y = HEIGHT - 1 - scale * (ends.ravel() - least)
            x = np.repeat(np.arange(len(edges)) * COLUMNS / len(edges), 2)
            points = np.rint(np.stack((x, y), axis=1)).astype(np.int64).ravel().tolist()
            size = (most - least) / abs(channel.sensitivity)
            (text,), unit = readings([size], channel.unit)
            found.append(
                Trace(
                    f"{sensor.name}.{channel.name}",
                    " ".join(map(str, points)),
                    f"{text} {unit}",
                )
            )
    return tuple(found)
