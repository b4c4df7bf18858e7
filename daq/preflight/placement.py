"""How sensors stand, from some seconds of their samples: gravity, and the motion that they share.

Two sensors in one motion differ by a rotation, whatever their directions: ``y = R x``. Channels
that have traded places, or a reversed one, make a reflection of it, which no way to turn a sensor
does. Which of several sensors is reflected, the others say.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daq.bench.units import STANDARD_GRAVITY, in_acceleration
from daq.preflight.findings import Finding, Problem

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from daq.bench.model import Channel
    from daq.preflight.preview import SensorPreview

LOW_CORRELATION, HIGH_CORRELATION = 0.3, 0.7
"""Correlation below which a sensor moves by itself, and from which on two others move together."""
SLOW = 10.0
"""Hz up to which sensors are correlated: their clocks differ by milliseconds."""
MIN_OFFSET = 0.5
"""Difference in m/s² from gravity, and from none, that is called an offset."""
ALONG = 0.8
"""Part of a direction from which on it is that of one channel."""
FITS = 0.8
"""Part of a channel's motion that another sensor's must explain, to compare their directions."""


def gravity(each: SensorPreview) -> Iterator[Finding]:
    """Yield an offset, and a vertical channel that does not feel gravity where another one does."""
    channels, means = each.sensor.channels, each.samples.mean(axis=0)
    factors = [in_acceleration(channel.unit) for channel in channels]
    main = [
        n
        for n, channel in enumerate(channels)
        if not channel.auxiliary and factors[n] is not None and np.ptp(each.samples[:, n]) > 0
    ]
    if not main or each.is_clipping:
        return
    felt = np.array([means[n] * (factors[n] or 0.0) for n in main])
    most = float(np.linalg.norm(felt))
    is_whole = len(main) >= 3
    too_little = is_whole and MIN_OFFSET < most < STANDARD_GRAVITY - MIN_OFFSET
    if too_little or most > STANDARD_GRAVITY + MIN_OFFSET:
        yield Finding(Problem.OFFSET, each.sensor.name, value=most)
        return
    up = [n for n in main if _is_vertical(channels[n])]
    strongest = main[int(np.argmax(np.abs(felt)))]
    is_elsewhere = np.abs(felt).max() > ALONG * most and up not in ([], [strongest])
    if is_whole and most > MIN_OFFSET and is_elsewhere:
        both = f"{channels[up[0]].name} and {channels[strongest].name}"
        yield Finding(Problem.SWAPPED, each.sensor.name, both)


def _is_vertical(channel: Channel) -> bool:
    return (channel.direction or "").lower() in {"up", "down", "vertical", "z"}


def placed_wrongly(able: Sequence[SensorPreview]) -> Iterator[Finding]:
    """Yield the sensors that share no motion where others do, and those that are reflected.

    Parameters
    ----------
    able : sequence of SensorPreview
        With enough samples.
    """
    if len(able) < 3:
        return
    end_ns = min(each.last_ns for each in able)
    slow = [_slow(each, end_ns) for each in able]
    n_rows = min(len(rows) for rows in slow)
    slow = [rows[-n_rows:] for rows in slow]
    strongest = np.zeros((len(able), len(able)))
    for i, first in enumerate(slow):
        for j, second in enumerate(slow):
            if i < j and first.shape[1] and second.shape[1]:
                both = np.corrcoef(first.T, second.T)
                d = first.shape[1]
                strongest[i, j] = strongest[j, i] = np.abs(both[:d, d:]).max()
    for i, each in enumerate(able):
        others = np.delete(np.delete(strongest, i, 0), i, 1)
        if others.max() >= HIGH_CORRELATION and strongest[i].max() < LOW_CORRELATION:
            yield Finding(Problem.ALONE, each.sensor.name, value=float(strongest[i].max()))
    yield from _reflected(able, slow)


def _reflected(
    able: Sequence[SensorPreview], slow: Sequence[NDArray[np.float64]]
) -> Iterator[Finding]:
    """Yield the sensors whose motion is a reflection of that of all others, which agree."""
    whole = [
        n
        for n, each in enumerate(able)
        if slow[n].shape[1] == 3 == each.sensor.n_main_channels  # none of them is dead
    ]
    turns = {(i, j): _turn(slow[i], slow[j]) for i in whole for j in whole if i != j}
    for j in whole:
        seen = [turns[i, j] for i in whole if i != j]
        among = [turns[i, k] for i in whole for k in whole if i != k and j not in (i, k)]
        if len(seen) < 2 or not all(turn is not None and np.linalg.det(turn) < 0 for turn in seen):
            continue
        if not all(turn is not None and np.linalg.det(turn) > 0 for turn in among):
            continue
        yield _what_is_reflected(able[j], [turn for turn in seen if turn is not None])


def _turn(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the directions of a sensor's channels as seen by another, shape (3, 3), of length 1.

    None where the motion is too weak, or too much of one direction, to see them.
    """
    solved, *_ = np.linalg.lstsq(first, second, rcond=None)
    left = ((second - first @ solved) ** 2).sum(axis=0)
    if (left > (1 - FITS) * (second**2).sum(axis=0)).any():
        return None
    return np.asarray(solved.T / np.linalg.norm(solved.T, axis=1)[:, None])


def _what_is_reflected(each: SensorPreview, seen: Sequence[NDArray[np.float64]]) -> Finding:
    """Return which channels have traded places, or which one is reversed.

    That is what is seen where the sensors point alike. Where they do not, only the reflection is.
    """
    name = each.sensor.name
    names = [channel.name for channel in each.sensor.channels if not channel.auxiliary]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        order = [0, 1, 2]
        order[a], order[b] = b, a
        if all(turn[range(3), order].min() > ALONG for turn in seen):
            return Finding(Problem.SWAPPED, name, f"{names[a]} and {names[b]}")
    for c in range(3):
        signs = np.where(np.arange(3) == c, -1, 1)
        if all((np.diag(turn) * signs).min() > ALONG for turn in seen):
            return Finding(Problem.REVERSED, name, names[c])
    return Finding(Problem.REFLECTED, name)


def _slow(each: SensorPreview, end_ns: int) -> NDArray[np.float64]:
    """Return the motion below `SLOW` of a sensor's live channels, at 2 `SLOW` rows a second.

    The last row is at `end_ns`: rows of all sensors are of the same moments.
    """
    rate = each.sensor.sampling_rate
    late = max(0, round((each.last_ns - end_ns) * 1e-9 * rate))
    main = [
        n
        for n, channel in enumerate(each.sensor.channels)
        if not channel.auxiliary and np.ptp(each.samples[:, n]) > 0
    ]
    values = each.samples[: len(each.samples) - late, main]
    step = max(1, round(rate / (2 * SLOW)))
    n_rows = len(values) // step
    rows = values[len(values) - n_rows * step :].reshape(n_rows, step, len(main)).mean(axis=1)
    return np.asarray(np.diff(rows, axis=0))
