"""How the times of two sensors are known against each other, by the states of their clocks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from daq.clocks.clock_model import ClockSource, ClockState, OffsetSource, RelativeTime


def clock(sensor: str, source: ClockSource) -> ClockState:
    return ClockState(sensor, source, 0.0, 0.0, 0.0, 0.0, 0.0, 1)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"shared_clock": "rack"}, RelativeTime.STATED),
        (
            {"shared_clock": "rack", "offset_source": OffsetSource.SAMPLES},
            RelativeTime.WHOLE_SAMPLES,
        ),
        ({"source": ClockSource.DEVICE_UTC}, RelativeTime.STATED),
        ({"source": ClockSource.DEVICE_UTC, "refined": True}, RelativeTime.ALIGNED),
        ({"source": ClockSource.DEVICE_UTC, "corrected": 1e-6}, RelativeTime.ALIGNED),
        ({"source": ClockSource.DEVICE_UTC, "drifts": True}, RelativeTime.ALIGNED),
        ({"source": ClockSource.NOMINAL_RATE}, RelativeTime.WHOLE_SAMPLES),
        ({"source": ClockSource.NOMINAL_RATE, "residual": math.nan}, RelativeTime.ALIGNED),
        ({"source": ClockSource.SAMPLE_INSTANTS}, RelativeTime.ALIGNED),
        ({}, RelativeTime.ALIGNED),
    ],
)
def test_how_times_of_two_sensors_are_known(
    changed: dict[str, Any], expected: RelativeTime
) -> None:
    common = {key: changed[key] for key in ("source", "shared_clock") if key in changed}
    one = replace(clock("a", ClockSource.ARRIVAL_TIMES), **common)
    other = replace(clock("b", ClockSource.ARRIVAL_TIMES), **changed)

    assert one.relative_time(other) is other.relative_time(one) is expected


def test_utc_tells_nothing_of_a_sensor_without_it() -> None:
    stated = clock("a", ClockSource.DEVICE_UTC)

    assert stated.relative_time(clock("b", ClockSource.ARRIVAL_TIMES)) is RelativeTime.ALIGNED
