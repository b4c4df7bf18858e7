"""The state of a sensor, with the same values in recorder, screens, JSON and reports."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from daq.protocols.block import EventKind


class SensorState(StrEnum):
    """State of one sensor of a recording."""

    WAITING = "waiting"
    """Connected, without a block since."""
    LIVE = "live"
    """Blocks arrive and are recorded."""
    LATE = "late"
    """No block for two block periods."""
    STALLED = "stalled"
    """The port is open, but without a block for so long that the sensor is lost."""
    DISCONNECTED = "disconnected"
    """The connection ended; the recorder tries to connect again until the run ends."""
    REFUSED = "refused"
    """The device is not the one in the bench file, or not the one recorded before."""
    SILENT = "silent"
    """The file has no new samples for some seconds, and the recorder has given no reason."""
    ENDED = "ended"
    """The recording is closed, and the sensor was not lost at its end."""

    @property
    def is_lost(self) -> bool:
        """Whether the sensor is lost."""
        return self in _LOST

    @property
    def is_overdue(self) -> bool:
        """Whether the sensor is late or lost."""
        return self is SensorState.LATE or self in _LOST


_LOST = frozenset(
    {SensorState.STALLED, SensorState.DISCONNECTED, SensorState.REFUSED, SensorState.SILENT}
)
STATE_AFTER: Mapping[str, SensorState] = {
    EventKind.CONNECTED: SensorState.WAITING,
    EventKind.LATE: SensorState.LATE,
    EventKind.STALLED: SensorState.STALLED,
    EventKind.DISCONNECTED: SensorState.DISCONNECTED,
    EventKind.REFUSED: SensorState.REFUSED,
}
"""State of a sensor after an event, until its next block; other kinds leave the state unchanged."""
