"""Samples that a sensor lost, or repeated, without counting them.

Theory of operation
-------------------
A logger without a counter loses a block, a buffer overflows, a gap is counted that was none: from
then on all samples are late, or early, by a whole number of samples. Arrival times hardly show one
sample; delays measured from the motion show a step. A step is a *slip* if it lasts for a few
segments, is a whole number of samples, and arrival times do not contradict it.

When many samples are lost, delays cannot be measured from then on. Arrivals are then late for good;
the step is first taken from them, and what is left of it shows in the delays of the next pass.

The moment is known to the segments that hold it. The samples of this span are not used; after it
the count goes on with the lost samples added, so that the clock needs no new start.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from daq.clocks.lower_envelope import least_of_each
from daq.clocks.quantiles import median
from estimator.records import dataclass

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

LASTING = 4
"""Segments on either side of a step, by which it is known."""
_LEAST = 3  # of them, next to an end or to another step
_CERTAIN = 8.0  # standard deviations of what steps
_WHOLE = 0.15  # samples that a step may be off a whole number
_SPAN = 4  # segments that one step disturbs at most
_MARGIN = 0.25  # of half a segment: one that holds a step may show the delay of its smaller part
_SLOPES = 11  # differences by whose median the rate is known
_NODE = 10.0  # seconds of arrivals, the earliest of which counts
_NODES = 6  # of these on either side of a step
_LATE = 0.05  # seconds by which arrivals must be late for good
_CONTRADICTS = 6.0  # standard deviations
_JITTER = 5e-4  # seconds that the earliest arrivals scatter at least


@dataclass(frozen=True, slots=True)
class Slip:
    """A whole number of samples that were lost without being counted.

    Attributes
    ----------
    first_sample, end_sample : int
        Indices in the recording between which it happened.
    n_samples : int
        Lost samples; negative: samples counted twice.
    """

    first_sample: int
    end_sample: int
    n_samples: int


@dataclass(frozen=True, slots=True)
class Step:
    """A step of lateness: positions in seconds around it, and its size in s."""

    before: float
    after: float
    size: float


class Slips:
    """The slips of one sensor, in order."""

    def __init__(self, slips: Iterable[Slip] = ()) -> None:
        self.all: tuple[Slip, ...] = tuple(slips)

    def __len__(self) -> int:
        return len(self.all)

    @property
    def total(self) -> int:
        """All lost samples."""
        return sum(each.n_samples for each in self.all)

    def ahead(self, index: FloatArray | IntArray) -> IntArray:
        """Return how many samples were lost before each index, at the middle of a slip's span."""
        middles = [(each.first_sample + each.end_sample) / 2 for each in self.all]
        lost = np.cumsum([0, *(each.n_samples for each in self.all)])
        return np.asarray(lost[np.searchsorted(middles, index, side="right")])

    def recorded(self, counted: float) -> float:
        """Return the index of a sample by its number with all lost ones counted."""
        lost = 0
        for each in self.all:
            if counted >= each.end_sample + lost + each.n_samples:
                lost += each.n_samples
        return counted - lost

    def holds(self, index: FloatArray | IntArray) -> BoolArray:
        """Return which indices lie in the span of a slip."""
        inside = np.zeros(len(index), np.bool_)
        for each in self.all:
            inside |= (index >= each.first_sample) & (index < each.end_sample)
        return inside

    def stretches(self, first_sample: int, end_sample: int) -> list[tuple[int, int, int, bool]]:
        """Return the stretches between slips, and those that hold one, in order.

        Of each the first sample, the one after the last, how many were lost before, and whether the
        times are known.
        """
        found, first, lost = [], first_sample, 0
        for each in self.all:
            found += [(first, each.first_sample, lost, True)]
            found += [(each.first_sample, each.end_sample, lost, False)]
            first, lost = each.end_sample, lost + each.n_samples
        return [*found, (first, end_sample, lost, True)]

    def added(self, slip: Slip) -> Slips:
        """Return these slips and one more; it is added to another one that it overlaps."""
        rest, merged = [], slip
        for each in self.all:
            if each.first_sample < merged.end_sample and merged.first_sample < each.end_sample:
                merged = Slip(
                    min(each.first_sample, merged.first_sample),
                    max(each.end_sample, merged.end_sample),
                    each.n_samples + merged.n_samples,
                )
            else:
                rest.append(each)
        return Slips(sorted([*rest, merged], key=lambda each: each.first_sample))


def steps(at: FloatArray, late: FloatArray, std: FloatArray, *, least: float) -> list[Step]:
    """Return the steps of a sensor's lateness between stretches in which it is smooth.

    Parameters
    ----------
    at, late, std : float64, shape (n,)
        When delays were measured, increasing; lateness and its standard deviation, in s.
    least : float
        Smallest step in s.
    """
    if len(at) < 2 * _LEAST:
        return []
    wide = np.maximum(np.diff(at), 1e-9)
    slope = np.diff(late) / wide
    margin = _MARGIN * median(wide)
    half = _SLOPES // 2
    padded = np.pad(slope, half, mode="reflect" if len(slope) > half else "edge")
    usual = np.sort(np.lib.stride_tricks.sliding_window_view(padded, _SLOPES), axis=1)[:, half]
    rest = (slope - usual) * wide
    noise = np.maximum(1.4826 * median(np.abs(rest)), np.hypot(std[1:], std[:-1]))
    odd = np.flatnonzero(np.abs(rest) > np.maximum(_CERTAIN * noise, least / 20))
    groups = np.split(odd, np.flatnonzero(np.diff(odd) > 2) + 1) if len(odd) else []
    groups = [each for each in groups if each[-1] - each[0] < _SPAN]
    bounds = [-1, *(int(each[-1]) for each in groups), len(at) - 1]
    ends = [int(each[0]) for each in groups] + [len(at) - 1]
    found = []
    for number, group in enumerate(groups):
        low, high = int(group[0]), int(group[-1]) + 1
        before = np.arange(max(bounds[number] + 1, low - LASTING + 1), low + 1)
        after = np.arange(high, min(ends[number + 1], high + LASTING - 1) + 1)
        if min(len(before), len(after)) < _LEAST:
            continue
        inner = np.concatenate([slope[before[:-1]], slope[after[:-1]]])
        rate = median(inner)
        left, right = (late[rows] - rate * at[rows] for rows in (before, after))
        size = median(right) - median(left)
        spread = max(float(np.ptp(left)), float(np.ptp(right)))
        error = max(spread, float(std[before].max())) / np.sqrt(_LEAST)
        if abs(size) > max(least / 2, _CERTAIN / 2 * error):
            found.append(Step(float(at[low]) - margin, float(at[high]) + margin, float(size)))
    return found


def lost_by_delays(
    step: Step,
    sampling_rate: float,
    arrivals: tuple[FloatArray, FloatArray],
    *,
    known_to: float = _JITTER,
) -> int:
    """Return how many samples were lost at a step of measured delays, negative for repeated ones.

    0 where it is no whole number, or arrivals contradict it.

    Parameters
    ----------
    step : Step
    sampling_rate : float
        Hz.
    arrivals : (float64, float64), shape (n,)
        When blocks arrived on the sensor's own count, increasing, and their lateness, in s.
    known_to : float
        Standard deviation of the earliest of them at least, in s.
    """
    number = round(step.size * sampling_rate)
    if abs(step.size * sampling_rate - number) > _WHOLE:
        return 0
    arrived = _step_of_arrivals(step.before, step.after, arrivals)
    if arrived is not None:
        size, scatter = arrived
        if abs(size - step.size) > _CONTRADICTS * max(scatter, known_to, _JITTER):
            return 0
    return number


def arrive_otherwise(arrivals: tuple[FloatArray, FloatArray], *, node: float) -> list[Step]:
    """Return steps from which on all blocks arrive late, or early (a negative size).

    Parameters
    ----------
    arrivals : (float64, float64), shape (n,)
        As for `lost_by_delays`, between two restarts.
    node : float
        Seconds in which some blocks arrive.
    """
    seconds, late = arrivals
    number = ((seconds - seconds[0]) // node).astype(np.int64)
    first = least_of_each(number, late, np.zeros(len(number), np.int64))
    at, least = seconds[first], late[first]
    if len(at) < 2 * _LEAST:
        return []
    least = least - median(np.diff(least) / np.diff(at)) * at
    change = np.diff(least)
    certain = max(_LATE, _CERTAIN * 1.4826 * median(np.abs(change)))
    found = []
    for low in np.flatnonzero(np.abs(change) > certain).tolist():
        before, after = least[max(0, low - _NODES + 1) : low + 1], least[low + 1 :]
        half = abs(change[low]) / 2  # else they are held up for a while
        for_good = after.min() > before.max() + half or after.max() < before.min() - half
        short, long = sorted((low + 1, len(after)))
        if for_good and (short >= _LEAST or long >= _NODES):
            size = median(after[:_NODES]) - median(before)
            found.append(Step(float(at[low]), float(at[low + 1]), size))
    return found


def _step_of_arrivals(
    before: float, after: float, arrivals: tuple[FloatArray, FloatArray]
) -> tuple[float, float] | None:
    """Return by how much the earliest arrivals step between two instants, and its deviation, in s.

    None if too few arrive.
    """
    seconds, late = arrivals
    times, least = [], []
    for low, high in ((before - _NODES * _NODE, before), (after, after + _NODES * _NODE)):
        mine = np.flatnonzero((seconds >= low) & (seconds <= high))
        node = ((seconds[mine] - low) // _NODE).astype(np.int64)
        first = mine[least_of_each(node, late[mine], np.zeros(len(mine), np.int64))]
        times.append(seconds[first])
        least.append(late[first])
    if min(map(len, times)) < 2:
        return None
    slopes = [np.diff(y) / np.diff(x) for x, y in zip(times, least, strict=True)]
    slope = median(np.concatenate(slopes))
    left, right = (y - slope * x for x, y in zip(times, least, strict=True))
    scatter = max(1.4826 * median(np.abs(side - median(side))) for side in (left, right))
    return median(right) - median(left), scatter
