"""How a recording and its sensors are doing now: what is cheap to look at between segments."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daq.protocols.block import BlockFlag

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daq.protocols.block import Event
    from daq.recording.reader import Recording, SensorRecord

SILENT = 3.0
"""Seconds without a sample after which a sensor is called silent, while others go on."""
CLIPS = 5.0
"""Seconds for which a sensor is said to clip after it did."""
STUCK = 5.0
"""Seconds without any change after which a channel is said to stand still."""
OUT_OF_ORDER = frozenset({"late", "stalled", "disconnected", "refused"})
"""Events after which a sensor is out of order until its next block."""
_MARKS_STATE = OUT_OF_ORDER | {"connected"}
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
    state : str
        ``waiting`` for its first block, ``live``, ``silent``, ``ended``, or one of `OUT_OF_ORDER`.
    since : float
        For how long it has been out of order; 0 where it is not.
    why : str
        What the recorder said of it.
    clips : bool
        Whether it was at the end of its range a moment ago.
    n_clipped : int
        Blocks in which it was.
    stuck, was_stuck : tuple of str
        Channels that stand still, and those that did before.
    """

    name: str
    port: str
    sampling_rate: float
    n_samples: int
    n_gaps: int
    n_missing: int
    state: str
    since: float = 0.0
    why: str = ""
    clips: bool = False
    n_clipped: int = 0
    stuck: tuple[str, ...] = ()
    was_stuck: tuple[str, ...] = ()

    @property
    def is_lost(self) -> bool:
        """Whether it has begun and does not come any more."""
        return self.state == "silent" or self.state in OUT_OF_ORDER


@dataclass(frozen=True, slots=True)
class RecordingStatus:
    """A recording at one moment.

    Attributes
    ----------
    elapsed : float
        From its start to the latest that is in it, in seconds.
    started_utc_ns : int
    closed : bool
    sensors : tuple of SensorNow
    events : tuple of Event
        All of them.
    ends_in : float or None
        Seconds until it ends by itself, if it does.
    """

    elapsed: float
    started_utc_ns: int
    closed: bool
    sensors: tuple[SensorStatus, ...]
    events: tuple[Event, ...]
    ends_in: float | None = None


class RecordingMonitor:
    """Looks at a recording that somebody else refreshes.

    Parameters
    ----------
    recording : Recording
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._seen = {sensor.name: _Seen(sensor) for sensor in recording.sensors}
        self._events: tuple[Event, ...] = ()
        self._latest: dict[str, Event] = {}
        self._counts: dict[str, int] = {}

    def look(self) -> RecordingStatus:
        """Return how things are."""
        recording = self._recording
        self._take_events()
        for seen in self._seen.values():
            seen.take_blocks()
        begun = recording.created_at.monotonic_ns
        latest_ns = max(
            begun,
            *(seen.last_ns for seen in self._seen.values()),
            *(event.received.monotonic_ns for event in self._events[-1:]),
        )
        elapsed = (latest_ns - begun) * _NS
        ends = None if recording.closed else recording.duration
        return RecordingStatus(
            elapsed=elapsed,
            started_utc_ns=recording.created_at.utc_ns,
            closed=recording.closed,
            sensors=tuple(
                self._sensor(record, self._seen[record.name], latest_ns)
                for record in recording.sensors
            ),
            events=self._events,
            ends_in=None if ends is None else max(0.0, ends - elapsed),
        )

    def quiet(self) -> bool:
        """Whether a sensor that goes on has sent nothing since this was asked last."""
        counts = {record.name: record.n_samples for record in self._recording.sensors}
        before, self._counts = self._counts, counts
        return any(count and before.get(name) == count for name, count in counts.items())

    def with_states(self, now: RecordingStatus, states: Mapping[str, str]) -> RecordingStatus:
        """Return the same, with sensors late that the recorder says are; the file says it later.

        ``states`` are those of the recorder's status, by sensor.
        """
        latest_ns = round(now.elapsed / _NS) + self._recording.created_at.monotonic_ns
        return replace(
            now,
            sensors=tuple(
                replace(
                    sensor,
                    state="late",
                    since=max(0.0, (latest_ns - self._seen[sensor.name].last_ns) * _NS),
                )
                if sensor.state == "live" and states.get(sensor.name) == "late"
                else sensor
                for sensor in now.sensors
            ),
        )

    def look_closely(self) -> RecordingStatus:
        """Return how things are, and which channels stand still: reads the latest samples."""
        for seen in self._seen.values():
            seen.find_stuck()
        return self.look()

    def _take_events(self) -> None:
        new = self._recording.events_from(len(self._events))
        if new:
            self._events += new
            self._latest |= {event.sensor: event for event in new if event.kind in _MARKS_STATE}

    def _sensor(self, record: SensorRecord, seen: _Seen, latest_ns: int) -> SensorStatus:
        state, since_ns, why = self._state(record, seen, latest_ns)
        gaps = record.gaps
        clipped = (latest_ns - seen.clipped_ns) * _NS <= CLIPS and not self._recording.closed
        return SensorStatus(
            name=record.name,
            port=record.port,
            sampling_rate=record.sampling_rate,
            n_samples=record.n_samples,
            n_gaps=len(gaps),
            n_missing=int(gaps["missing"].sum()),
            state=state,
            since=max(0.0, (latest_ns - since_ns) * _NS),
            why=why,
            clips=seen.n_clipped > 0 and clipped,
            n_clipped=seen.n_clipped,
            stuck=seen.stuck,
            was_stuck=tuple(name for name in seen.ever_stuck if name not in seen.stuck),
        )

    def _state(self, record: SensorRecord, seen: _Seen, latest_ns: int) -> tuple[str, int, str]:
        event = self._latest.get(record.name)
        if event is not None and event.received.monotonic_ns > seen.last_ns:
            at = event.received.monotonic_ns
            if event.kind in OUT_OF_ORDER:
                return event.kind, at if seen.last_ns < 0 else seen.last_ns, event.text
            if seen.last_ns >= 0 and not self._recording.closed:  # it is back, without a block yet
                return "waiting", latest_ns, event.text
        if self._recording.closed:
            return "ended", latest_ns, ""
        if seen.last_ns < 0:
            return "waiting", latest_ns, ""
        if (latest_ns - seen.last_ns) * _NS > SILENT:
            return "silent", seen.last_ns, ""
        return "live", latest_ns, ""


class _Seen:
    """What has been seen of one sensor's blocks; each is looked at once."""

    def __init__(self, record: SensorRecord) -> None:
        self._record = record
        self._n_blocks = 0
        self.last_ns = -1
        self.n_clipped = 0
        self.clipped_ns = 0
        self.stuck: tuple[str, ...] = ()
        self.ever_stuck: dict[str, None] = {}

    def take_blocks(self) -> None:
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
        record = self._record
        wanted = math.ceil(STUCK * record.sampling_rate)
        if record.n_samples < wanted:
            return
        still = np.ptp(record.counts(record.n_samples - wanted), axis=0) == 0
        self.stuck = tuple(
            channel.name
            for channel, is_still in zip(record.channels, still, strict=True)
            if is_still and not channel.auxiliary
        )
        self.ever_stuck |= dict.fromkeys(self.stuck)
