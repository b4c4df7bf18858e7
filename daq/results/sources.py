"""What the recordings of an estimate say of themselves: sensors, run, checksum, events."""

from __future__ import annotations

import contextlib
import hashlib
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from daq.estimation.recording_set import continuations
from daq.protocols.block import READING_INTERVAL_NS, EventKind, Quantity, Reading
from daq.recording.reader import Recording
from daq.recording.signing import signed_by
from daq.recording.storage.locking import is_being_written
from estimator.records import dataclass

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from daq.bench.model import Bench
    from daq.clocks.clock_model import ClockState
    from daq.recording.reader import SensorRecord

_SECOND_NS = 1_000_000_000
State: TypeAlias = Literal["closed", "growing", "continued", "left-open"]


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
class Source:
    """One recording, and what is not in its description.

    Attributes
    ----------
    path : Path
    sha256 : str
        Of the whole file as it is now; empty while it is being written.
    n_bytes : int
    started : datetime
        UTC.
    last : datetime
        UTC of the last block received.
    state : {"closed", "growing", "continued", "left-open"}
        Continued in the file that follows, because the disk refused this one. Left open by a
        recorder that was killed, and not repaired since.
    recording : Recording
        Its description; its file is closed.
    logged_events : tuple of LoggedEvent
        In time order.
    readings : tuple of Reading
        What devices and the host stated of themselves, in time order; of a recording of an earlier
        version what the devices stated at its start.
    signed_by : str
        Id of the key of the signature beside the recording; empty if there is none, or it does not
        fit. The contents are compared by ``huddle verify`` only.
    """

    path: Path
    sha256: str
    n_bytes: int
    started: datetime
    last: datetime
    state: State
    recording: Recording
    logged_events: tuple[LoggedEvent, ...]
    readings: tuple[Reading, ...] = ()
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
        state = "continued" if continued else "left-open"
        if is_being_written(path):
            state = "growing"
    return Source(
        path=path,
        sha256="" if state == "growing" else _sha256(path),
        n_bytes=path.stat().st_size,
        started=recording.created.astimezone(UTC),
        last=datetime.fromtimestamp(last / _SECOND_NS, tz=UTC),
        state=state,
        recording=recording,
        logged_events=tuple(logged_events),
        readings=recording.readings or _stated_at_start(recording),
        signed_by=signed_by(path) if state == "closed" else "",
    )


def _stated_at_start(recording: Recording) -> tuple[Reading, ...]:
    return tuple(
        Reading(sensor.name, Quantity.TEMPERATURE, sensor.temperature, recording.created_at)
        for sensor in recording.sensors
        if sensor.temperature is not None
    )


@dataclass(frozen=True, slots=True)
class Condition:
    """Lowest and highest value of a quantity during a test.

    Attributes
    ----------
    sensor : str
        Empty for the computer that recorded.
    quantity : Quantity or str
    lowest, highest : float
    n_readings : int
        One a minute.
    limits : (float, float) or None
        Range of the data sheet.
    """

    sensor: str
    quantity: Quantity | str
    lowest: float
    highest: float
    n_readings: int
    limits: tuple[float, float] | None = None

    @property
    def is_outside(self) -> bool:
        """Whether a value was outside of the data sheet's range."""
        return self.limits is not None and not (
            self.limits[0] <= self.lowest and self.highest <= self.limits[1]
        )


def conditions(
    found: Sequence[Source],
    about: Bench | None = None,
    *,
    start: datetime | None = None,
    end: datetime | None = None,
) -> tuple[Condition, ...]:
    """Return the conditions of a test, sensor by sensor, then those of the computer.

    Parameters
    ----------
    found : sequence of Source
    about : Bench, optional
        With the data sheets of the sensors.
    start, end : datetime, optional
        Of the test, if it is a part of the recordings. Readings up to a minute before and after
        belong to it.
    """
    values: dict[tuple[str, Quantity | str], list[float]] = {}
    for source in found:
        for reading in source.readings:
            at = reading.received.utc_ns
            if (start is None or at >= _ns(start) - READING_INTERVAL_NS) and (
                end is None or at <= _ns(end) + READING_INTERVAL_NS
            ):
                values.setdefault((reading.sensor, reading.quantity), []).append(reading.value)
    limits = {
        sensor.name: sensor.data_sheet.temperature
        for sensor in (() if about is None else about.sensors)
        if sensor.data_sheet is not None
    }
    names = [*(sensor.name for sensor in found[0].recording.sensors), ""]
    return tuple(
        Condition(
            sensor,
            quantity,
            min(several),
            max(several),
            len(several),
            limits.get(sensor) if quantity == Quantity.TEMPERATURE else None,
        )
        for sensor in names
        for (owner, quantity), several in values.items()
        if owner == sensor
    )


def _ns(at: datetime) -> int:
    return round(at.timestamp() * _SECOND_NS)


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
