"""The sampling rate and the gaps behind time stamps that jitter.

A line through all stamps gives the rate: the median step, or the mean one, is off by the jitter, by
gaps, or by the resolution of the stamps. A gap moves all stamps after it; a stamp that is late
moves itself. So at every step that is too long, the stamps before and after are compared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from daq.formats.foreign_sensor import NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LONG_STEP = 1.5  # samples: at a shorter one nothing can be missing
_WINDOW = 32
"""Stamps that are compared on either side of a long step."""
_EXACT = 0.01  # samples: stamps that lie this near a line are taken as they are
_SNAP = 0.1  # samples: a rate that misses a round one by less in all is that one
_SIGMAS = 3.0
_WIDEST = 512
_WIDTHS = (1, *(1 << power for power in range(6, 16)))
"""Stamps between those from which a first rate is taken."""
_HALF = 0.5  # samples: what rises by less is no gap
_REPEATED = 0.2
"""Share of equal stamps above which they are those of a coarse clock."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Where rows lie in time.

    Attributes
    ----------
    sampling_rate : float
        In Hz.
    starts : list of (int, int)
        (row, UTC in ns) of each row that begins a stretch.
    left_out : list of (int, int)
        (first, last + 1) of rows whose time is not known to the sample.
    """

    sampling_rate: float
    starts: list[tuple[int, int]]
    left_out: list[tuple[int, int]]


def grid_of(times: NDArray[np.int64], sampling_rate: float | None) -> Grid:
    """Find the rate and the gaps.

    Parameters
    ----------
    times : int64, shape (n_rows,)
        In ns.
    sampling_rate : float, optional
        In Hz, if it is known.

    Raises
    ------
    ValueError
        The times do not increase; with the row.
    """
    steps = np.diff(times)
    if times.size < 2 or steps.min() < 0 or times[-1] <= times[0]:
        row = int(np.argmin(steps)) + 2 if steps.size else 1
        raise ValueError(
            "expected a time column of two rows or more that always increases; it does not at row"
            f" {row}"
        )
    coarse = np.mean(steps == 0) > _REPEATED
    rows = np.concatenate([[0], np.flatnonzero(steps) + 1]) if coarse else np.arange(len(times))
    stamps = (times[rows] - times[0]).astype(np.float64)
    step = NS_PER_S / sampling_rate if sampling_rate else _typical_step(rows, stamps)
    missing = _missing(rows, stamps, step)
    if sampling_rate is None:
        step = _fitted_step(rows, stamps, missing)
        missing = _missing(rows, stamps, step)
        step = _round_step(rows, stamps, missing, _fitted_step(rows, stamps, missing))
    rate = NS_PER_S / step if sampling_rate is None else sampling_rate
    nearest = round(rate)
    if nearest and abs(rate / nearest - 1) < 1e-12:
        rate = float(nearest)
    index = rows + np.cumsum(missing)
    off = stamps - index * step
    exact = np.ptp(off) < _EXACT * step
    starts, everywhere = [], float(np.median(off))
    for first, end in _stretches(missing):
        own = float(np.median(off[first:end]))
        line = (everywhere if abs(own - everywhere) < _HALF * step else own) + index[first] * step
        start = times[rows[first]] if exact else times[0] + round(line)
        starts.append((int(rows[first]), int(start)))
    begins: list[int] = np.flatnonzero(missing).tolist() if coarse else []
    return Grid(rate, starts, [(int(rows[k - 1]), int(rows[k])) for k in begins])


def _stretches(missing: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return (first, last + 1) of the stamps between gaps."""
    edges = [0, *np.flatnonzero(missing).tolist(), len(missing)]
    return [(first, end) for first, end in pairwise(edges) if end > first]


def _typical_step(rows: NDArray[np.int64], stamps: NDArray[np.float64]) -> float:
    """Return the time from row to row, in ns, from stamps as far apart as scatter the least.

    Jitter counts less the farther they are apart; gaps count more.
    """
    best, step = math.inf, 0.0
    widths = [width for width in _WIDTHS if width * 8 <= len(rows)] or [1]
    for width in widths:
        apart = (stamps[width:] - stamps[:-width]) / (rows[width:] - rows[:-width])
        low, middle, high = np.percentile(apart, (20, 50, 80))
        if width == 1:  # few of many steps show bursts
            low, high = np.percentile(apart, (0.5, 99.5))
        scatter = float((high - low) / middle) if middle > 0 else math.inf
        if scatter < best:
            best, step = scatter, float(middle)
    return step or float(stamps[-1] / rows[-1])


def _missing(
    rows: NDArray[np.int64], stamps: NDArray[np.float64], step: float
) -> NDArray[np.int64]:
    """Return how many samples are missing before each stamp.

    The least lateness and the median lateness must both rise: the one shows no bursts, the other
    no single stamps.
    """
    missing = np.zeros(len(rows), dtype=np.int64)
    ahead = np.diff(stamps) / step - np.diff(rows)
    nearest = np.rint(ahead)
    if np.max(np.abs(ahead - nearest)) < 0.25 and nearest.min() >= 0:  # no jitter to speak of
        missing[1:] = nearest.astype(np.int64)
        return missing
    late = stamps / step - rows
    burst = _burst(ahead)
    scatter = float(np.subtract(*np.percentile(ahead, (84, 16)))) / 2 / math.sqrt(2)
    width = min(_WIDEST, max(_WINDOW, math.ceil(_WINDOW * (scatter / 0.3) ** 2)))
    width = math.ceil(width / burst) * burst if burst > 1 else width
    rise = _rise_of_least(late, width)
    k = 0
    while (found := np.flatnonzero(rise[k:] >= _HALF)).size:
        k += int(found[0])
        before, after = late[max(0, k - width) : k], late[k : k + width]
        by_median = float(np.median(after) - np.median(before)) if k else 0.0
        if by_median >= _HALF and (k + 1 >= len(late) or ahead[k - 1] > _LONG_STEP - 1):
            missing[k] = max(1, round(float(rise[k]) if burst > 1 else by_median))
            late[k:] -= missing[k]
            first = max(0, k - 2 * width)
            part = _rise_of_least(late[first : k + 3 * width], width)
            rise[k : k + 2 * width] = part[k - first : k - first + 2 * width]
        k += 1
    return missing


def _burst(ahead: NDArray[np.float64]) -> int:
    """Return how many stamps come at once, if they come in bursts; or 1."""
    long = np.flatnonzero(ahead > _LONG_STEP - 1)
    if len(long) * _WINDOW < len(ahead):
        return 1
    return int(np.median(np.diff(long)))


def _rise_of_least(late: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return by how much the least lateness of `width` stamps from each on is above that before."""
    padded = np.concatenate([late, np.full(-len(late) % width, np.inf)]).reshape(-1, width)
    forward = np.minimum.accumulate(padded, axis=1).ravel()
    backward = np.minimum.accumulate(padded[:, ::-1], axis=1)[:, ::-1].ravel()
    ends = np.minimum(np.arange(len(late)) + width - 1, len(forward) - 1)
    least = np.minimum(backward[: len(late)], forward[ends])
    before = np.concatenate([np.full(min(width, len(late)), np.inf), least[: -width or None]])
    start = np.minimum.accumulate(late)[: min(width, len(late))]
    before[1 : len(start)] = start[:-1]
    before = before[: len(late)]
    before[0] = least[0]
    return np.asarray(least - before)


def _fitted_step(
    rows: NDArray[np.int64], stamps: NDArray[np.float64], missing: NDArray[np.int64]
) -> float:
    """Return the slope of lines through all stretches, whose gaps are of any length."""
    product = square = 0.0
    for first, end in _stretches(missing):
        centred = rows[first:end] - rows[first:end].mean()
        product += float(np.dot(centred, stamps[first:end] - stamps[first]))
        square += float(np.dot(centred, centred))
    return product / square if square else float(stamps[-1] / (rows[-1] + missing.sum()))


def _round_step(
    rows: NDArray[np.int64],
    stamps: NDArray[np.float64],
    missing: NDArray[np.int64],
    step: float,
) -> float:
    """Return the step of a whole rate in Hz, or of a whole interval in s, if it fits as well."""
    nearest = round(NS_PER_S / step)
    whole = NS_PER_S / nearest if nearest else float(round(step / NS_PER_S) * NS_PER_S)
    first, end = max(_stretches(missing), key=lambda span: span[1] - span[0])
    length = float(rows[end - 1] - rows[first])
    scatter = float(np.std(stamps[first:end] - rows[first:end] * step)) / step
    allowed = _SNAP + _SIGMAS * scatter * math.sqrt(12 / (end - first))
    return whole if abs(step / whole - 1) * length < allowed else step
