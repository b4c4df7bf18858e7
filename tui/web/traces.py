"""The last seconds of every channel, as lines of a picture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from tui.wording.formatting import readings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.recording.reader import Recording

SPAN = 10.0
"""Seconds."""
COLUMNS = 150
"""Columns of the picture of a channel, each from the least to the largest sample in it."""
HEIGHT = 40


@dataclass(frozen=True, slots=True)
class WebTrace:
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


def traces(recording: Recording) -> tuple[WebTrace, ...]:
    """Return the traces of all channels that are estimated."""
    found = []
    for sensor in recording.sensors:
        n_samples = min(sensor.n_samples, round(SPAN * sensor.sampling_rate))
        shown = [i for i, channel in enumerate(sensor.channels) if not channel.auxiliary]
        if n_samples < 2 or not shown:
            continue
        counts = sensor.counts(sensor.n_samples - n_samples)
        edges = np.unique(np.linspace(0, n_samples, COLUMNS + 1).astype(np.int64))[:-1]
        ends = np.stack(
            [ufunc.reduceat(counts, edges, axis=0) for ufunc in (np.minimum, np.maximum)], axis=1
        )[..., shown].astype(np.int64)
        least, most = ends.min(axis=(0, 1)), ends.max(axis=(0, 1))
        # down and up in turn: half the points of a box for each column
        ends[1::2] = ends[1::2, ::-1]
        scale = (HEIGHT - 2) / np.maximum(1, most - least)
        y = np.rint(HEIGHT - 1 - scale * (ends - least)).astype(np.int64)
        x = np.rint(np.arange(len(edges)) * COLUMNS / len(edges)).astype(np.int64)
        points = _points()[x[:, None, None], y].reshape(-1, len(shown))
        for column, number in enumerate(shown):
            channel = sensor.channels[number]
            size = int(most[column] - least[column]) / abs(channel.sensitivity)
            (text,), unit = readings([size], channel.unit)
            found.append(
                WebTrace(
                    f"{sensor.name}.{channel.name}",
                    " ".join(points[:, column].tolist()),
                    f"{text} {unit}",
                )
            )
    return tuple(found)


@cache
def _points() -> NDArray[np.object_]:
    """Return each point of a picture as SVG writes it, by column and height."""
    return np.array([[f"{x} {y}" for y in range(HEIGHT)] for x in range(COLUMNS)], object)
