"""Sensors that state UTC among the others of a recording."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daq.alignment.sensor_reader import SensorSource

_LATEST = 5.0  # maximum delay in s of the blocks of a device with UTC
_OF_A_CLOCK = 2  # sensors that are compared: one may be broken


def undoubted(sources: Sequence[SensorSource], reference: int | None) -> tuple[int, ...]:
    """Return sensors whose stated UTC is not doubted, some of each clock; the reference first."""
    seen: dict[str, int] = {}
    found = [] if reference is None else [reference]
    for number, source in enumerate(sources):
        taken = seen.get(source.clock_name, 0)
        if source.device_utc and not source.doubted and taken < _OF_A_CLOCK:
            seen[source.clock_name] = taken + 1
            found += [number] if number != reference else []
    return tuple(found)


def take_drift(sources: Sequence[SensorSource], drift: Mapping[int, float], reference: int) -> None:
    """Set by how much stated UTC drifts: the most of any sensor on a clock, and NaN if none knows.

    The clock of the reference does not drift: what drifts beside it is a sensor.
    """
    for source in sources:
        if not source.device_utc or source.doubted:
            continue
        found = [each for n, each in drift.items() if sources[n].clock_name == source.clock_name]
        known = [each for each in found if not math.isnan(each)]
        if source.clock_name == sources[reference].clock_name:
            known = [0.0] * bool(known)
        if found:
            source.drift = max(known, default=math.nan)


def place_stated(sources: Sequence[SensorSource]) -> None:
    """Shift devices' UTC to arrival times, if the computer's UTC, used by other sensors, is wrong.

    It is wrong if no device's blocks arrive at possible times. A block of all channels arrives with
    its slowest channel: if channels are not synchronised, up to twice its duration after its end.
    """
    stated = [source.arrivals for source in sources if source.device_utc]
    if 0 < len(stated) < len(sources):
        wrong = all(not 0 <= each.latency < _LATEST + 2 * each.longest_block for each in stated)
        for each in stated:
            each.moved = min(other.latency for other in stated) if wrong else 0.0
