"""Lateness of blocks: which are the earliest, and the line under them all.

The lateness of a block is when it arrived less its last sample's index over the nominal rate.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daq.clocks.quantiles import median

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

_STEEP = 2e-4  # seconds of lateness over a second that hide which one is the earliest
_LEVEL = 10  # seconds over which a slope can be told from jitter
_FAR = 10.0  # medians of lateness; beyond, it is no longer how latency scatters
_HULL_POINTS = 512


def levelled(index: IntArray, late: FloatArray, epoch: IntArray, *, second: float) -> FloatArray:
    """Return lateness without the slope of each epoch where that hides what came early.

    A sensor whose rate is off by per cent would otherwise keep each second's last, or first.
    `second` is in samples.
    """
    late = late.copy()
    begins = np.flatnonzero(np.diff(epoch, prepend=-1))
    ends = np.append(begins[1:], len(index))
    for first in np.flatnonzero(index[ends - 1] - index[begins] > _LEVEL * second):
        rows = np.arange(begins[first], ends[first])
        half = len(rows) // 2
        rise = late[rows[half:]] - late[rows[: len(rows) - half]]
        slope = median(rise / (index[rows[half:]] - index[rows[: len(rows) - half]]))
        if abs(slope * second) > _STEEP:
            late[rows] -= slope * index[rows]
    return late


def least_of_each(group: IntArray, late: FloatArray, epoch: IntArray) -> IntArray:
    """Return, in order, the row of least lateness in every group of each epoch."""
    order = np.lexsort((late, group, epoch))
    kept = np.ones(len(order), dtype=bool)
    kept[1:] = (np.diff(group[order]) != 0) | (np.diff(epoch[order]) != 0)
    return order[kept]


def scatter_of_least(late: FloatArray, least: FloatArray, begins: BoolArray) -> float:
    """Return by how much the least lateness of groups must scatter, in s, by the others' lateness.

    The least of n scatters by an n-th of what one does, if lateness is exponential; a few groups
    that happen to lie on a line do not show it. `begins` says which rows begin a group.
    """
    others = max(len(late) - len(least) - 1, 1)  # one more lies on the line that was taken out
    above = late - least[np.cumsum(begins) - 1]
    if above.any():
        above = np.minimum(above, _FAR * median(above[above > 0]))
    # Known from few, it may be too little by as much.
    return float(above.sum() / others * (1 + 3 / others) * len(least) / len(late))


def supporting_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return intercept and slope of the highest line under all points at their mean.

    Parameters
    ----------
    x, y : float64, shape (n_points,)
        `x` increasing.
    """
    x0, y0 = float(x[0]), float(y[0])
    x, y = x - x0, y - y0
    if len(x) > _HULL_POINTS:  # the lowest of each group, against a line through them all
        slope = np.polynomial.polynomial.polyfit(x, y, 1)[1]
        groups = np.array_split(np.arange(len(x)), _HULL_POINTS)
        chosen = np.array([group[np.argmin(y[group] - slope * x[group])] for group in groups])
    else:
        chosen = np.arange(len(x))
    hull: list[int] = []
    across, up = x.tolist(), y.tolist()  # plain numbers: arrays are slow one by one
    for point in chosen.tolist():
        while len(hull) > 1 and _turns_down(across, up, hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    right = min(max(int(np.searchsorted(x[hull], x.mean())), 1), len(hull) - 1)
    a, b = hull[right - 1], hull[right]
    slope = float((y[b] - y[a]) / (x[b] - x[a]))
    return y0 + float(y[a]) - slope * (x0 + float(x[a])), slope


def _turns_down(x: list[float], y: list[float], a: int, b: int, c: int) -> bool:
    return (x[b] - x[a]) * (y[c] - y[a]) <= (y[b] - y[a]) * (x[c] - x[a])
