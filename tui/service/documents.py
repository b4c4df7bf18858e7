"""JSON documents of a service: every key with its type and a note, as in `tui.output.documents`."""

from __future__ import annotations

from typing import Annotated, TypedDict

from daq.recording.sensor_state import SensorState
from tui.output.documents import CaveatsDocument, Finite, Time
from tui.service.records.run_state import RunState

_Times = Annotated[str | None, ("format", "date-time")]


class RunDocument(CaveatsDocument):
    """One run of a schedule."""

    bench: Annotated[str, "Name of the bench."]
    entry: Annotated[str, "Name of its entry in the schedule."]
    due: Annotated[Time, "When it is due, UTC."]
    state: Annotated[RunState, "Where it is in its life."]
    reason: Annotated[str, "Why it failed or was missed, or what went wrong."]
    verdict: Annotated[str | None, "pass, fail or not-decided; null without limits or result."]
    started: Annotated[_Times, "When it started, UTC."]
    ended: Annotated[_Times, "When it ended, UTC."]
    duration: Annotated[Finite | None, "How long to record, in seconds."]
    target_cov: Annotated[Finite | None, "C.o.v. that ends it."]
    until: Annotated[str | None, "What ends it, in words."]
    recordings: Annotated[list[str], "Its files, in the folder of the recordings."]
    pinned: Annotated[bool, "Whether it is protected from removal."]
    removed: Annotated[_Times, "When its recordings were removed, UTC."]


class RecordedSensorDocument(TypedDict):
    """One sensor of a running recorder."""

    state: Annotated[SensorState, "State."]
    samples: Annotated[int, "Samples that are safe on the disk."]
    gaps: Annotated[int, "Number of gaps."]
    missing: Annotated[int, "Missing samples."]


class RecordingRunDocument(RunDocument):
    """The run that is being recorded."""

    ends: Annotated[_Times, "When it ends, UTC."]
    elapsed: Annotated[Finite | None, "Seconds that are recorded; null while it starts or ends."]
    sensors: Annotated[dict[str, RecordedSensorDocument], "Its sensors, by name."]


class DiskDocument(TypedDict):
    """Disk of the recordings."""

    free_bytes: Annotated[int, "Free space."]
    total_bytes: Annotated[int, "Size."]
    min_free_bytes: Annotated[int, "Free space below which recordings end."]


class ServiceClockDocument(TypedDict):
    """Clock of the computer."""

    utc: Annotated[Time, "Its time, UTC."]
    synchronised: Annotated[bool | None, "Whether it is synchronised; null if not known."]


class StatusDocument(TypedDict):
    """What huddle status --json writes."""

    bench: Annotated[str, "Name of the bench."]
    running: Annotated[bool, "Whether a service runs."]
    recording: Annotated[RecordingRunDocument | None, "The run that is being recorded."]
    estimating: Annotated[list[RunDocument], "Runs that are being estimated."]
    waiting: Annotated[list[RunDocument], "Runs that are due and wait for another."]
    next: Annotated[RunDocument | None, "The next run."]
    last: Annotated[RunDocument | None, "The last run that is over."]
    unfinished: Annotated[int, "Runs that are recorded or estimated."]
    untold: Annotated[int, "Hooks that are not carried out."]
    disk: DiskDocument
    clock: ServiceClockDocument
