"""Status of a recording and its sensors, at little cost per refresh."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.end_condition import NEVER, EndCondition
from daq.caveats import NO_CAVEATS, Caveats
from daq.protocols.block import BlockFlag, Event
from daq.recording.sensor_state import STATE_AFTER, SensorState
from estimator.records import dataclass

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from daq.recording.reader import Recording
    from daq.recording.sensor_record import SensorRecord

SILENT_AFTER = 3.0
"""Seconds without samples after which a sensor is silent, while other sensors continue."""
CLIPPING_SHOWN = 5.0
"""Seconds for which a sensor counts as clipping after a clipped block."""
STUCK_AFTER = 5.0
"""Seconds without any change after which a channel is stuck."""
_NS = 1e-9


@dataclass(frozen=True, slots=True)
class SensorStatus:
    """One sensor at one moment; times in seconds.

    Attributes
    ----------
    name, port : str
    sampling_rate : float
        In Hz.
    n_samples, n_gaps, n_missing : int
        A sensor that is lost has one gap more, which grows until it sends again.
    state : SensorState
    overdue_for : float
        Time since the last block of a sensor that is late or lost; 0 in other states.
    reason : str
        The recorder's reason for the state; empty if it gave none.
    is_clipping : bool
        Whether one of the latest blocks reached the end of the range.
    n_clipped : int
        Number of clipped blocks.
    stuck, was_stuck : tuple of str
        Channels with constant values now, and channels with constant values for some time earlier.
    """

    name: str
    port: str
    sampling_rate: float
    n_samples: int
    n_gaps: int
    n_missing: int
    state: SensorState
    overdue_for: float = 0.0
    reason: str = ""
    is_clipping: bool = False
    n_clipped: int = 0
    stuck: tuple[str, ...] = ()
    was_stuck: tuple[str, ...] = ()
    serial_number: str = ""


@dataclass(frozen=True, slots=True)
class RecordingStatus:
    """A recording at one moment.

    Attributes
    ----------
    elapsed : float
        Seconds from its start to the latest block or event; to now if no sensor sends.
    started_utc_ns : int
    closed : bool
    sensors : tuple of SensorStatus
    events : tuple of Event
        All events.
    until : EndCondition
        When it ends by itself.
    speed : float
        Seconds of the recording that pass in one second; 1, unless sensors are simulated.
    caveats : Caveats
    """

    elapsed: float
    started_utc_ns: int
    closed: bool
    sensors: tuple[SensorStatus, ...]
    events: tuple[Event, ...]
    until: EndCondition = NEVER
    speed: float = 1.0
    caveats: Caveats = NO_CAVEATS

    def in_local_time(self, seconds: float | None) -> datetime | None:
        """Return the moment so many seconds from now; None if the recording is not in real time."""
        if seconds is None or self.speed != 1.0:
            return None
        now = self.started_utc_ns * _NS + self.elapsed
        return datetime.fromtimestamp(now + seconds, UTC).astimezone()


class RecordingMonitor:
    """Derives the status of a recording that the caller refreshes.

    Parameters
    ----------
    recording : Recording
    first : Recording, optional
        The one that it continues, from whose start the time counts.
    now : callable
        Time in s of a monotonic clock.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        first: Recording | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._recording, self._first, self._now = recording, first or recording, now
        self._latest_ns, self._since = -1, now()
        self._blocks = {sensor.name: _BlockSummary(sensor) for sensor in recording.sensors}
        self._events: tuple[Event, ...] = ()
        self._latest: dict[str, tuple[Event, SensorState]] = {}
        self._n_samples: dict[str, int] = {}

    def status(self) -> RecordingStatus:
        """Return the current status."""
        recording = self._recording
        self._read_events()
        for blocks in self._blocks.values():
            blocks.update()
        start_ns = self._first.created_at.monotonic_ns
        latest_ns = max(
            start_ns,
            *(blocks.last_ns for blocks in self._blocks.values()),
            *(event.received.monotonic_ns for event in self._events[-1:]),
        )
        sensors = tuple(
            self._sensor(record, self._blocks[record.name], latest_ns)
            for record in recording.sensors
        )
        since_latest = self._since_latest(latest_ns, sensors)
        elapsed = (latest_ns - start_ns) * _NS + since_latest
        return RecordingStatus(
            elapsed=elapsed,
            started_utc_ns=self._first.created_at.utc_ns,
            closed=recording.closed,
            sensors=tuple(
                _with_open_gap(replace(s, overdue_for=s.overdue_for + since_latest))
                if s.state.is_overdue
                else s
                for s in sensors
            ),
            events=self._events,
            until=replace(self._first.until, duration=self._first.duration),
            speed=self._speed,
            caveats=recording.caveats,
        )

    def _since_latest(self, latest_ns: int, sensors: tuple[SensorStatus, ...]) -> float:
        """Return the time since the latest block or event in s if no sensor sends, else 0.

        While sensors send, elapsed time follows from the blocks, whose clock may be faster.
        """
        if latest_ns != self._latest_ns:
            self._latest_ns, self._since = latest_ns, self._now()
        if self._recording.closed or not all(sensor.state.is_overdue for sensor in sensors):
            return 0.0
        return (self._now() - self._since) * self._speed

    @property
    def _speed(self) -> float:
        bench = self._recording.bench
        return 1.0 if bench is None else bench.speed

    def status_with_stuck_channels(self) -> RecordingStatus:
        """Return the current status; read the latest samples to find stuck channels."""
        for blocks in self._blocks.values():
            blocks.find_stuck()
        return self.status()

    def is_any_sensor_quiet(self) -> bool:
        """Return whether a sensor with samples received none since the last call."""
        n_samples = {record.name: record.n_samples for record in self._recording.sensors}
        before, self._n_samples = self._n_samples, n_samples
        return any(count and before.get(name) == count for name, count in n_samples.items())

    def with_late_sensors(
        self, status: RecordingStatus, states: Mapping[str, str]
    ) -> RecordingStatus:
        """Return a status that includes late sensors as reported by the recorder.

        The file has a late sensor's event only after the sensor is lost.

        Parameters
        ----------
        status : RecordingStatus
        states : mapping
            State of each sensor by name, from the recorder's reply.
        """
        latest_ns = round(status.elapsed / _NS) + self._first.created_at.monotonic_ns
        sensors = [
            replace(
                sensor,
                state=SensorState.LATE,
                overdue_for=max(0.0, (latest_ns - self._blocks[sensor.name].last_ns) * _NS),
            )
            if sensor.state is SensorState.LIVE and states.get(sensor.name) == SensorState.LATE
            else sensor
            for sensor in status.sensors
        ]
        return replace(status, sensors=tuple(sensors))

    def _read_events(self) -> None:
        new = self._recording.events_from(len(self._events))
        self._events += new
        for event in new:
            state = STATE_AFTER.get(event.kind)
            if state is not None:
                self._latest[event.sensor] = event, state

    def _sensor(self, record: SensorRecord, blocks: _BlockSummary, latest_ns: int) -> SensorStatus:
        state, since_ns, reason = self._state(record, blocks, latest_ns)
        gaps = record.gaps
        recent = (latest_ns - blocks.clipped_ns) * _NS <= CLIPPING_SHOWN
        return SensorStatus(
            name=record.name,
            port=record.port,
            sampling_rate=record.sampling_rate,
            n_samples=record.n_samples,
            n_gaps=len(gaps),
            n_missing=int(gaps["missing"].sum()),
            state=state,
            overdue_for=max(0.0, (latest_ns - since_ns) * _NS),
            reason=reason,
            is_clipping=blocks.n_clipped > 0 and recent and not self._recording.closed,
            n_clipped=blocks.n_clipped,
            stuck=blocks.stuck,
            was_stuck=tuple(name for name in blocks.ever_stuck if name not in blocks.stuck),
            serial_number=record.serial_number,
        )

    def _state(
        self, record: SensorRecord, blocks: _BlockSummary, latest_ns: int
    ) -> tuple[SensorState, int, str]:
        """Return state, monotonic time in ns from which the sensor is overdue, and reason."""
        has_blocks = blocks.last_ns >= 0
        event, state = self._latest.get(record.name, (None, SensorState.WAITING))
        if event is not None and event.received.monotonic_ns > blocks.last_ns:
            if state.is_overdue:
                since_ns = blocks.last_ns if has_blocks else event.received.monotonic_ns
                return state, since_ns, event.text
            if has_blocks and not self._recording.closed:  # connected again
                return state, latest_ns, event.text
        if self._recording.closed:
            return SensorState.ENDED, latest_ns, ""
        if not has_blocks:
            return SensorState.WAITING, latest_ns, ""
        if (latest_ns - blocks.last_ns) * _NS > SILENT_AFTER:
            return SensorState.SILENT, blocks.last_ns, ""
        return SensorState.LIVE, latest_ns, ""


def _with_open_gap(sensor: SensorStatus) -> SensorStatus:
    """Return a sensor with the samples that it should have sent since it was lost."""
    if not sensor.state.is_lost:
        return sensor
    missing = round(sensor.overdue_for * sensor.sampling_rate)
    return replace(sensor, n_gaps=sensor.n_gaps + 1, n_missing=sensor.n_missing + missing)


class _BlockSummary:
    """Time, clipping and stuck channels of one sensor; reads each block once."""

    def __init__(self, record: SensorRecord) -> None:
        self._record = record
        self._n_blocks = 0
        self.last_ns = -1
        """Host monotonic time at which the last block was received; -1 before the first."""
        self.n_clipped = 0
        self.clipped_ns = 0
        """Host monotonic time at which the last clipped block was received."""
        self.stuck: tuple[str, ...] = ()
        self.ever_stuck: dict[str, None] = {}

    def update(self) -> None:
        """Read the blocks committed since the last call."""
        new = self._record.blocks[self._n_blocks :]
        if len(new) == 0:
            return
        self._n_blocks += len(new)
        self.last_ns = int(new["monotonic_ns"][-1])
        clipped = new[(new["flags"] & int(BlockFlag.CLIPPED)) != 0]
        if len(clipped):
            self.n_clipped += len(clipped)
            self.clipped_ns = int(clipped["monotonic_ns"][-1])

    def find_stuck(self) -> None:
        """Find the channels whose values have not changed for ``STUCK_AFTER``."""
        record = self._record
        wanted = math.ceil(STUCK_AFTER * record.sampling_rate)
        if record.n_samples < wanted:
            return
        constant = np.ptp(record.counts(record.n_samples - wanted), axis=0) == 0
        self.stuck = tuple(
            channel.name
            for channel, is_constant in zip(record.channels, constant, strict=True)
            if is_constant and not channel.auxiliary
        )
        self.ever_stuck |= dict.fromkeys(self.stuck)
