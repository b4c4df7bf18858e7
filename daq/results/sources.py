"""What the recordings of an estimate say of themselves: sensors, run, checksum, events."""

from __future__ import annotations

import contextlib
import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from daq.estimation.recording_set import continuations
from daq.protocols.block import EventKind
from daq.recording.reader import Recording
from daq.recording.signing import signed_by
from daq.recording.storage.locking import is_being_written

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from daq.bench.channel import Channel
    from daq.bench.model import Bench
    from daq.clocks.clock_model import ClockState
    from daq.recording.reader import SensorRecord

_SECOND_NS = 1_000_000_000
State: TypeAlias = Literal["closed", "growing", "continued", "left open"]


@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """An event or a gap: when (UTC), of which sensor ("" for the run), what kind, and in words."""

    utc_ns: int
    sensor: str
    kind: str
    text: str


def uncounted_events(clocks: Iterable[ClockState]) -> tuple[LoggedEvent, ...]:
    """Return the samples that an estimate shows to be lost without being counted, as events."""
    found = [
        LoggedEvent(each.utc_ns, clock.sensor, EventKind.UNCOUNTED, each.in_words)
        for clock in clocks
        for each in clock.slips
    ]
    return tuple(sorted(found, key=lambda each: each.utc_ns))


def with_uncounted(
    recorded: Iterable[LoggedEvent], uncounted: Sequence[LoggedEvent]
) -> tuple[LoggedEvent, ...]:
    """Return events in order: those of an estimate instead of what the run recorded of the same."""
    sensors = {each.sensor for each in uncounted}
    kept = (
        each for each in recorded if each.kind != EventKind.UNCOUNTED or each.sensor not in sensors
    )
    return tuple(sorted([*kept, *uncounted], key=lambda each: each.utc_ns))


@dataclass(frozen=True, slots=True)
class RecordedSensor:
    """One sensor as a recording has it."""

    name: str
    model: str
    serial_number: str
    driver: str
    sampling_rate: float
    channels: tuple[Channel, ...]
    temperature: float | None = None
    """In °C, as the device reported at the start."""


@dataclass(frozen=True, slots=True)
class Source:
    """One recording.

    Attributes
    ----------
    path : Path
    sha256 : str
        Of the whole file as it is now; empty while it is being written.
    n_bytes : int
    run_id, software, operator, location : str
    started : datetime
        UTC.
    last : datetime
        UTC of the last block received.
    state : {"closed", "growing", "continued", "left open"}
        Continued in the file that follows, because the disk refused this one. Left open by a
        recorder that was killed, and not repaired since.
    recording : Recording
        Its description; its file is closed.
    sensors : tuple of RecordedSensor
    simulated : bool
        Whether a sensor was simulated.
    logged_events : tuple of LoggedEvent
        In time order.
    signed_by : str
        Id of the key of the signature beside the recording; empty if there is none, or it does not
        fit. The contents are compared by ``huddle verify`` only.
    """

    path: Path
    sha256: str
    n_bytes: int
    run_id: str
    software: str
    operator: str
    location: str
    started: datetime
    last: datetime
    state: State
    recording: Recording
    sensors: tuple[RecordedSensor, ...]
    simulated: bool
    logged_events: tuple[LoggedEvent, ...]
    signed_by: str = ""

    @property
    def bench(self) -> Bench | None:
        """The whole bench, if one was recorded."""
        return self.recording.bench


def sources(paths: Sequence[str | Path]) -> tuple[Source, ...]:
    """Read what recordings, and those that continue them, say; growing ones up to now.

    Raises
    ------
    RecordingError
        If one cannot be read.
    """
    with contextlib.ExitStack() as opened:
        recordings = [opened.enter_context(Recording.open(path)) for path in paths]
        for recording in tuple(recordings):
            following = continuations(recording, recordings)
            recordings.extend(map(opened.enter_context, following))
        continued = {recording.continues for recording in recordings}
        return tuple(_source(each, continued=each.run_id in continued) for each in recordings)


def _source(recording: Recording, *, continued: bool) -> Source:
    path = recording.path
    created = recording.created_at.utc_ns
    last = max(
        (int(s.blocks[-1:]["utc_ns"][0]) for s in recording.sensors if len(s.blocks)),
        default=created,
    )
    logged_events = [
        LoggedEvent(event.received.utc_ns, event.sensor, event.kind, event.text)
        for event in recording.events
    ]
    for sensor in recording.sensors:
        logged_events += _gaps(sensor, created)
    logged_events.sort(key=lambda each: each.utc_ns)
    state: State = "closed"
    if not recording.closed:
        state = "continued" if continued else "left open"
        if is_being_written(path):
            state = "growing"
    return Source(
        path=path,
        sha256="" if state == "growing" else _sha256(path),
        n_bytes=path.stat().st_size,
        run_id=recording.run_id,
        software=recording.software,
        operator=recording.operator,
        location=recording.location,
        started=recording.created.astimezone(UTC),
        last=datetime.fromtimestamp(last / _SECOND_NS, tz=UTC),
        state=state,
        recording=recording,
        sensors=tuple(
            RecordedSensor(
                sensor.name,
                sensor.model,
                sensor.serial_number,
                sensor.driver,
                sensor.sampling_rate,
                sensor.channels,
                sensor.temperature,
            )
            for sensor in recording.sensors
        ),
        simulated=recording.simulated,
        logged_events=tuple(logged_events),
        signed_by=signed_by(path) if state == "closed" else "",
    )


def _gaps(sensor: SensorRecord, created_ns: int) -> list[LoggedEvent]:
    """Return gaps at the time at which the block before each was received."""
    gaps, received_ns = sensor.gaps, sensor.blocks["utc_ns"]
    before = np.searchsorted(sensor.blocks["first_sample"], gaps["first_sample"], side="left") - 1
    found = []
    for gap, place in zip(gaps, before, strict=True):
        missing = int(gap["missing"])
        about = "about " if gap["estimated"] else ""
        text = (
            f"{about}{missing} {'sample' if missing == 1 else 'samples'} missing"
            f" ({missing / sensor.sampling_rate:.3g} s): {gap['reason'].decode(errors='replace')}"
        )
        at = int(received_ns[place]) if place >= 0 else created_ns
        found.append(LoggedEvent(at, sensor.name, "gap", text))
    return found


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
