"""How sensors stand, from some seconds of their samples: gravity, and the motion that they share.

Two sensors in one motion differ by a rotation, whatever their directions: ``y = R x``. Channels
that have traded places, or a reversed one, make a reflection of it, which no way to turn a sensor
does. Which of several sensors is reflected, the others say.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.units import STANDARD_GRAVITY, in_acceleration, order_of
from daq.preflight.findings import Finding, Problem

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from daq.bench.channel import Channel
    from daq.preflight.common_motion import CommonMotion
    from daq.preflight.preview import SensorPreview

LOW_CORRELATION, HIGH_CORRELATION = 0.3, 0.7
"""Correlation below which a sensor moves by itself, and from which on two others move together."""
SLOW = 10.0
"""Hz up to which sensors are correlated: their clocks differ by milliseconds."""
MIN_OFFSET = 0.5
"""Difference in m/s² from gravity, and from none, that is called an offset."""
ALONG = 0.8
"""Part of a direction from which on it is that of one channel."""
SOME_CORRELATION = 0.5
"""Correlation with another sensor from which on a sensor shares motion."""


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


def strongest_correlations(able: Sequence[SensorPreview]) -> NDArray[np.float64]:
    """Return the correlation of the channels of two sensors that move most alike.

    Parameters
    ----------
    able : sequence of SensorPreview
        With enough samples.

    Returns
    -------
    float64, shape (n_sensors, n_sensors)
        Zero on the diagonal.
    """
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
    return strongest


def alone(able: Sequence[SensorPreview]) -> Iterator[Finding]:
    """Yield the sensors that share no motion where others do, and those of which that is unsure."""
    if len(able) < 3:
        yield Finding(Problem.TOO_FEW_SENSORS)
        return
    strongest = strongest_correlations(able)
    for i, each in enumerate(able):
        others = np.delete(np.delete(strongest, i, 0), i, 1)
        most = float(strongest[i].max())
        if most < LOW_CORRELATION and others.max() >= HIGH_CORRELATION:
            yield Finding(Problem.ALONE, each.sensor.name, value=most)
        elif most < SOME_CORRELATION:
            yield Finding(Problem.NOT_COMPARABLE, each.sensor.name)


def wrong_polarity(motion: CommonMotion) -> Iterator[Finding]:
    """Yield the sensors whose motion is a reflection of that of all others, which agree."""
    places = range(len(motion.sensors))
    if len(places) < 3:
        yield Finding(Problem.TOO_FEW_SENSORS)
        return
    turns = {(i, j): motion.turn(i, j) for i in places for j in places if i != j}
    hands = {
        pair: 0.0 if turn is None else float(np.sign(np.linalg.det(turn)))
        for pair, turn in turns.items()
    }
    for j in places:
        each = motion.sensors[j]
        seen = [turn for i in places if i != j and (turn := turns[i, j]) is not None]
        if not seen:
            yield Finding(Problem.NOT_COMPARABLE, each.sensor.name)
            continue
        if len(seen) < 2 or not all(hands[i, j] <= 0 for i in places if i != j):
            continue
        among = [hands[i, k] for i in places for k in places if i != k and j not in (i, k)]
        if among and min(among) >= 0 and max(among) > 0:
            yield _what_is_reflected(each, seen)


def _what_is_reflected(each: SensorPreview, seen: Sequence[NDArray[np.float64]]) -> Finding:
    """Return which channels have traded places, or which one is reversed.

    That is what is seen where the sensors point alike. Where they do not, only the reflection is.
    """
    name = each.sensor.name
    names = [channel.name for channel in each.sensor.channels if not channel.auxiliary]
    d = len(names)
    for a, b in itertools.combinations(range(d), 2):
        order = list(range(d))
        order[a], order[b] = b, a
        if all(turn[range(d), order].min() > ALONG for turn in seen):
            return Finding(Problem.SWAPPED, name, f"{names[a]} and {names[b]}")
    for c in range(d):
        signs = np.where(np.arange(d) == c, -1, 1)
        if all((np.diag(turn) * signs).min() > ALONG for turn in seen):
            return Finding(Problem.REVERSED, name, names[c])
    return Finding(Problem.REFLECTED, name)


def _slow(each: SensorPreview, end_ns: int) -> NDArray[np.float64]:
    """Return the motion below `SLOW` of a sensor's live channels, at 2 `SLOW` rows a second.

    It is the change of acceleration. The last row is at `end_ns`: rows of all sensors are of the
    same moments.
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
    for column, channel in enumerate(main):
        for _ in range(2 - order_of(each.sensor.channels[channel].unit)):
            rows[:, column] = np.gradient(rows[:, column])
    return np.asarray(np.diff(rows, axis=0))
