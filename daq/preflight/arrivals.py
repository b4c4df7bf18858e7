"""The sampling rate and the scatter of arrivals, from some blocks of one sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daq.protocols.block import Block

MIN_BLOCKS, MAX_RATE_ERROR = 3, 0.01
"""Blocks that a measured rate takes, and its standard error at most, as a fraction of the rate."""
PARTS = 5
"""Parts of the time whose rates show how much they depend on when the host reads."""


@dataclass(frozen=True, slots=True)
class Arrivals:
    """How samples arrive.

    Attributes
    ----------
    rate : float or None
        Samples per second by the host's clock; None if blocks arrived too unevenly.
    error : float
        Its standard error, as a fraction of the rate.
    scatter : float
        Standard deviation of the arrival times about even ones, in s.
    """

    rate: float | None = None
    error: float = float("inf")
    scatter: float = 0.0


def arrivals(blocks: Sequence[Block]) -> Arrivals:
    """Return how samples arrive, without the first block: that may have waited in a buffer.

    Nothing is known from too few blocks; no rate where all of them had waited.
    """
    blocks = blocks[1:]
    if len(blocks) < MIN_BLOCKS:
        return Arrivals()
    samples = np.array([block.end_sample - blocks[0].end_sample for block in blocks])
    arrived = [block.received.monotonic_ns - blocks[0].received.monotonic_ns for block in blocks]
    times = np.array(arrived) * 1e-9
    (period, start), cov = np.polyfit(samples, times, 1, cov=True)
    scatter = float(np.std(times - start - period * samples))
    error = max(float(np.sqrt(cov[0, 0])), _scatter_of_parts(samples, times))
    if not 0 < period >= error / MAX_RATE_ERROR:
        return Arrivals(scatter=scatter)
    return Arrivals(float(1 / period), error / float(period), scatter)


def _scatter_of_parts(samples: NDArray[np.int64], times: NDArray[np.float64]) -> float:
    """Return the standard error of the period, in s, by the periods of `PARTS` of the time.

    On a busy host, delays of consecutive reads are alike: their scatter about a straight line says
    too little. A wrong rate is the same in all parts.
    """
    if len(samples) < PARTS * MIN_BLOCKS:
        return 0.0
    parts = zip(np.array_split(samples, PARTS), np.array_split(times, PARTS), strict=True)
    periods = [np.polyfit(*part, 1)[0] for part in parts]
    return float(np.std(periods, ddof=1) / np.sqrt(PARTS))
