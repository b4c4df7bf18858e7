"""Words for enumerated values, for screens, tables and reports alike."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.recording.sensor_state import SensorState
from daq.timing.clock_model import ClockSource

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daq.timing.clock_model import ClockState

STATE_MEANINGS: Mapping[SensorState, str] = {
    SensorState.LIVE: "samples arrive",
    SensorState.WAITING: "connected, but no sample yet",
    SensorState.LATE: "no block for two block periods",
    SensorState.STALLED: "connected, but sends nothing; reconnected automatically",
    SensorState.DISCONNECTED: "connection lost; retried until the recording ends",
    SensorState.REFUSED: "not the device that the bench file names, or that was there before",
    SensorState.SILENT: "no samples, while other sensors continue",
    SensorState.ENDED: "the recording is closed",
}
"""A state is called by its value; this says what it means."""
STATE_ALERTS: Mapping[SensorState, str] = {
    SensorState.LATE: "{sensor} is late: no block for {time}",
    SensorState.STALLED: "{sensor} has been stalled for {time}: check power and cable;"
    " reconnects automatically",
    SensorState.DISCONNECTED: "{sensor} has been disconnected for {time}: check cable and power;"
    " reconnects automatically",
    SensorState.REFUSED: "{sensor} is refused: {reason}",
    SensorState.SILENT: "{sensor} has been silent for {time}: check power and cable",
}
"""What is wrong, and what to do, in each state in which a sensor is overdue."""


def clock_source(clock: ClockState, *, short: bool = False) -> str:
    """Return how the times of a sensor's samples are known."""
    words = clock.source.value
    if clock.source is ClockSource.SHARED_CLOCK:
        words = f"clock of {clock.shared_clock}"
    elif short and clock.source is ClockSource.ARRIVAL_TIMES:
        words = "arrivals"
    if clock.offset_source is not None:
        words += f", whole samples apart by {clock.offset_source}"
    return words
