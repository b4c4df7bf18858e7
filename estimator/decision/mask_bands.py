"""The bands in which a noise mask is judged, and the mask in them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.levels.bands import third_octaves

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from estimator.types import FloatArray

BENT = 2.0
"""Ratio of a mask to a straight line through its band from which on its points divide the band."""


def mask_edges(
    frequency: FloatArray, mask: FloatArray, points: FloatArray, *, known: float
) -> NDArray[np.int64]:
    """Return edges of third-octave bands within a mask's frequencies, each with a bin or more.

    Where the mask leaves a straight line through a band by more than `BENT`, its own points divide
    the band: notches, peaks and steps.

    Parameters
    ----------
    frequency : float64, shape (n_freqs,)
        Hz.
    mask : float64, shape (n_freqs,)
        PSD of the mask, with the values of its ends beyond them.
    points : float64, shape (n_points,)
        Frequencies that define the mask, in Hz, rising.
    known : float
        Frequency above which nothing is known.
    """
    low = max(float(points[0]), float(frequency[1]))
    high = min(float(points[-1]), float(frequency[-2]), known)
    if high <= low:
        return np.empty(0, dtype=np.int64)
    edges = third_octaves(frequency, low, high)
    bent = _is_bent(np.log(frequency[edges[0] : edges[-1]]), np.log(mask), edges)
    inner = np.searchsorted(frequency, points[1:-1])
    inner = inner[(inner >= edges[0]) & (inner < edges[-1])]
    inner = inner[bent[np.searchsorted(edges, inner, side="right") - 1]]
    return np.unique(np.concatenate([edges, inner])).astype(np.int64)


def _is_bent(x: FloatArray, log_mask: FloatArray, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether a mask leaves a straight line in log-log, by band."""
    y = log_mask[edges[0] : edges[-1]]
    starts, counts = edges[:-1] - edges[0], np.diff(edges)
    first, last = starts, starts + counts - 1
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = np.nan_to_num((y[last] - y[first]) / (x[last] - x[first]))
    line = np.repeat(y[first], counts) + np.repeat(slope, counts) * (
        x - np.repeat(x[first], counts)
    )
    return np.asarray(np.maximum.reduceat(np.abs(y - line), starts) > np.log(BENT))


def mean_mask(frequency: FloatArray, mask: FloatArray, edges: NDArray[np.int64]) -> FloatArray:
    """Return the mean of a mask over the frequencies of each band, as that of the noise."""
    first, last = int(edges[0]), int(edges[-1])
    starts, width = edges[:-1] - first, np.gradient(frequency)[first:last]
    weighted = np.add.reduceat(mask[first:last] * width, starts)
    return np.asarray(weighted / np.add.reduceat(width, starts))
