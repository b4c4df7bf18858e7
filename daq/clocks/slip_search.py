"""Which of a recording's sensors lost samples without counting them, and when.

A slip of the reference shows in the delays of all others, at one time and by one amount. With two
sensors only arrival times can say which of them slipped; where they do not, it is the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daq.clocks.slips import Slip, arrive_otherwise, lost_by_delays, steps

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daq.clocks.sensor_reader import SensorSource
    from daq.clocks.slips import Step

    FloatArray = NDArray[np.float64]

_NODE = 10.0  # seconds of arrivals, the earliest of which counts, and
_BLOCKS = 4  # blocks at least
_SAME = 0.1  # share by which the sizes of one step may differ between sensors


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What delays show of one sensor; instants are by the reference's clock, in s."""

    source: SensorSource
    index: FloatArray
    seconds: FloatArray
    steps: list[Step]

    def at(self, before: float, after: float) -> tuple[float, float]:
        """Return the sensor's samples at two instants."""
        low, high = np.interp([before, after], self.seconds, self.index).tolist()
        return low, high


def find_by_motion(reference: SensorSource, others: Sequence[SensorSource]) -> None:
    """Add to each sensor the slips that measured delays show and that it does not have yet.

    Parameters
    ----------
    reference : SensorSource
    others : sequence of SensorSource
        With delays measured against it.
    """
    seen = [_seen(each, reference) for each in others if not (each.device_utc or each.polled)]
    if not seen:
        return

    def of_reference(before: float, after: float) -> tuple[float, float]:
        low, high = reference.known_clock.position(np.array([before, after])).tolist()
        return low, high

    def reference_slipped(step: Step) -> bool:
        if reference.device_utc or reference.polled:
            return False
        at = of_reference(step.before, step.after)
        return _slipped(reference, replace(step, size=-step.size), *at)

    shared = [
        step
        for step in seen[0].steps
        if all(any(_together(step, one) for one in each.steps) for each in seen)
    ]
    taken = [step for step in shared if len(seen) > 1 and reference_slipped(step)]
    for each in seen:
        for step in each.steps:
            if any(_together(step, one) for one in taken):
                continue
            own = _slipped(each.source, step, *each.at(step.before, step.after))
            if not own and len(seen) == 1:
                reference_slipped(step)


def find_by_arrivals(source: SensorSource) -> None:
    """Add to a sensor the slips from which on all its blocks arrive late.

    They arrive early for good where a gap was counted in which no sample was lost.
    """
    if source.device_utc or source.polled:
        return
    rate, counted = source.record.sampling_rate, source.heard.counting(source.slips)
    node = max(_NODE, _BLOCKS * source.arrivals.longest_block)
    for _, _, index, seconds in counted.earliest():
        for step in arrive_otherwise((index / rate, seconds - index / rate), node=node):
            # slips so far are in these indices, and not in those of the recording
            before, after = (source.slips.recorded(at * rate) for at in (step.before, step.after))
            n = round(step.size * rate)
            if n < 0 and not any(before < run.first_sample <= after for run in source.runs):
                continue
            source.slips = source.slips.added(Slip(math.ceil(before), int(after), n))


def _seen(source: SensorSource, reference: SensorSource) -> _Seen:
    index, seconds, std = source.delays(reference)
    at_reference = np.sort(source.learnt.values[:, 1])
    when = reference.known_clock.at(at_reference)
    known = source.slips.holds(index) | reference.slips.holds(at_reference)
    rate = source.record.sampling_rate
    if not (reference.device_utc or reference.polled):  # by counts: its clock follows its slips
        counted = at_reference + reference.slips.ahead(at_reference)
        seconds = seconds - when + counted / reference.record.sampling_rate
    late = seconds - (index + source.slips.ahead(index)) / rate
    restarts = source.arrivals.restarts
    epoch = np.searchsorted(restarts, index, side="right") + np.searchsorted(
        reference.arrivals.restarts, at_reference, side="right"
    )
    least = min(1 / rate, 1 / reference.record.sampling_rate)
    found: list[Step] = []
    for number in sorted(set(epoch.tolist())):  # np.unique loads numpy.ma
        mine = np.flatnonzero((epoch == number) & ~known)
        some = mine[np.isfinite(std[mine])]
        found += steps(when[some], late[some], std[some], least=least)
    return _Seen(source, index, when, found)


def _together(one: Step, other: Step) -> bool:
    """Whether two steps are at one time and of one size."""
    overlap = one.before < other.after and other.before < one.after
    return overlap and abs(one.size - other.size) < _SAME * abs(one.size)


def _slipped(source: SensorSource, step: Step, before: float, after: float) -> bool:
    """Add a slip between two samples, if the step is one of this sensor."""
    counted = source.heard.counting(source.slips)
    n = lost_by_delays(
        replace(step, before=_count(source, before), after=_count(source, after)),
        source.record.sampling_rate,
        counted.lateness(),
        known_to=counted.hidden,
    )
    if n:
        source.slips = source.slips.added(Slip(math.ceil(before), int(after), n))
    return n != 0


def _count(source: SensorSource, index: float) -> float:
    """Return the seconds that the sensor has counted at a sample."""
    lost = int(source.slips.ahead(np.array([index]))[0])
    return (index + lost) / source.record.sampling_rate
