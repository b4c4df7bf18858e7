"""What every reader of a foreign format returns, before it becomes a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from daq.protocols.block import CountsArray

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Contiguous samples of one sensor.

    Attributes
    ----------
    start_utc_ns : int
        UTC of the first sample, in ns since 1970.
    counts : ndarray, shape (n_samples, n_channels)
        Raw values, integers or floats.
    """

    start_utc_ns: int
    counts: CountsArray

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.counts.shape[0])


@dataclass(frozen=True, slots=True)
class ForeignSensor:
    """One sensor as a foreign file has it; between its stretches lie gaps.

    ``units`` holds one unit per channel, or is empty where the format does not say.
    """

    name: str
    channels: tuple[str, ...]
    sampling_rate: float
    stretches: tuple[Stretch, ...]
    source: str
    units: tuple[str, ...] = ()

    def first_sample(self, stretch: Stretch) -> int:
        """Index of a stretch's first sample on the grid that begins with the first stretch."""
        elapsed_ns = stretch.start_utc_ns - self.stretches[0].start_utc_ns
        return round(elapsed_ns * self.sampling_rate / NS_PER_S)


def finite_stretches(
    counts: CountsArray, *, start_utc_ns: int, sampling_rate: float
) -> tuple[Stretch, ...]:
    """Cut samples at every row that holds a value that is not a number.

    Parameters
    ----------
    counts : ndarray, shape (n_samples, n_channels)
    start_utc_ns : int
        UTC of the first row, in ns.
    sampling_rate : float
        In Hz.

    Returns
    -------
    tuple of Stretch
        None of them empty.
    """
    if not np.issubdtype(counts.dtype, np.floating):
        return (Stretch(start_utc_ns, counts),) if counts.shape[0] else ()
    whole = np.isfinite(counts).all(axis=1)
    edges = np.flatnonzero(np.diff(whole, prepend=False, append=False))
    return tuple(
        Stretch(start_utc_ns + round(int(first) * NS_PER_S / sampling_rate), counts[first:end])
        for first, end in edges.reshape(-1, 2)
    )
