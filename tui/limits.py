"""Noise masks of the bench file, and which channels do not stay below them.

A mask is judged in bands a third of an octave wide, where single frequencies scatter less: a
channel fails where even the lower end of the band mean's 95 % interval is above the mask.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tui.bands import band_means
from tui.results import correlation_of
from tui.text import level

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.bench import Bench, Limit
    from daq.estimation import Settings, Snapshot
    from tui.bands import FloatArray

BANDS_PER_OCTAVE = 3


@dataclass(frozen=True, slots=True)
class Exceeded:
    """One channel above one mask, at the band where it is furthest above; PSD in unit²/Hz."""

    limit: str
    sensor: str
    channel: str
    method: str
    frequency: float
    noise_psd: float
    limit_psd: float

    def __str__(self) -> str:
        return (
            f"{self.sensor}.{self.channel} does not meet {self.limit!r}: {self.method} "
            f"{level(self.noise_psd)} dB at {self.frequency:.3g} Hz, limit "
            f"{level(self.limit_psd)} dB"
        )


def exceeded(bench: Bench | None, snapshot: Snapshot, settings: Settings) -> list[Exceeded]:
    """Return every channel that does not meet a mask, judged by the first method that was asked."""
    if bench is None or not bench.limits or not snapshot.results:
        return []
    method = next(iter(snapshot.results))
    noise = snapshot.results[method]
    correlation = correlation_of(settings)
    found = []
    for limit in bench.limits:
        edges = _edges(snapshot.frequency, limit)
        if edges.size < 2:
            continue
        centre = np.sqrt(snapshot.frequency[edges[:-1]] * snapshot.frequency[edges[1:] - 1])
        mask = _at(limit, centre)
        for column, label in enumerate(snapshot.channels):
            if limit.sensors and label.sensor not in limit.sensors:
                continue
            if limit.channels and label.channel not in limit.channels:
                continue
            means = band_means(
                noise.noise_psd[:, column],
                noise.cov[:, column],
                edges,
                correlation,
                weights=np.gradient(snapshot.frequency),
            )
            above = np.nan_to_num(means.low / mask, nan=0.0)
            worst = int(np.argmax(above))
            if above[worst] > 1:
                found.append(
                    Exceeded(
                        limit.name,
                        label.sensor,
                        label.channel,
                        method,
                        float(centre[worst]),
                        float(means.mean[worst]),
                        float(mask[worst]),
                    )
                )
    return found


def _edges(frequency: FloatArray, limit: Limit) -> NDArray[np.int64]:
    """Return edges of third-octave bands within a mask's frequencies, each with a bin or more."""
    low = max(limit.frequency[0], float(frequency[1]))
    high = min(limit.frequency[-1], float(frequency[-2]))
    if high <= low:
        return np.empty(0, dtype=np.int64)
    n_bands = max(1, round(BANDS_PER_OCTAVE * np.log2(high / low)))
    edges = np.searchsorted(frequency, np.geomspace(low, high, n_bands + 1))
    edges[-1] += 1
    return np.unique(edges).astype(np.int64)


def _at(limit: Limit, frequency: FloatArray) -> FloatArray:
    """Return a mask between its points: straight in log-log."""
    return np.asarray(
        np.exp(np.interp(np.log(frequency), np.log(limit.frequency), np.log(limit.psd)))
    )
