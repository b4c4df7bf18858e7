"""The life of a scheduled run, as one state machine.

::

    due ──▶ recording ──▶ estimating ──▶ done
     │          │              │
     ▼          └──────────────┴───────▶ failed
    missed

A run is written to the database before anything is done in its new state. So whatever ends the
service, the database says what is left to do: a run in `RECORDING` has its recorder awaited, or the
rest of its window recorded; one in `ESTIMATING` is estimated again, which changes nothing where it
was estimated before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Any

from daq.bench.end_condition import NEVER, EndCondition
from daq.caveats import NO_CAVEATS, Caveats
from daq.errors import HuddleError

RUN = "service_run"
"""Attribute of ``/results`` of the last recording of a run: its `Run.record`, with the outcome."""


class RunState(StrEnum):
    """Where a run is in its life."""

    DUE = "due"
    """Planned, or waiting for another run to end."""
    RECORDING = "recording"
    """Its window is being recorded."""
    ESTIMATING = "estimating"
    """Recorded, and being repaired, estimated and reported."""
    DONE = "done"
    """Has its result."""
    FAILED = "failed"
    """Has no result; the reason says why."""
    MISSED = "missed"
    """Was not started; the reason says why."""


NEXT: dict[RunState, frozenset[RunState]] = {
    RunState.DUE: frozenset({RunState.RECORDING, RunState.MISSED}),
    RunState.RECORDING: frozenset({RunState.ESTIMATING, RunState.FAILED}),
    RunState.ESTIMATING: frozenset({RunState.DONE, RunState.FAILED}),
    RunState.DONE: frozenset(),
    RunState.FAILED: frozenset(),
    RunState.MISSED: frozenset(),
}
UNFINISHED = (RunState.RECORDING, RunState.ESTIMATING)


class WrongStateError(HuddleError):
    """A run cannot go from its state to another; an error of the program."""


@dataclass(frozen=True, slots=True)
class RecordedNoise:
    """Mean noise of one channel in one band, as one run found it; PSD in unit²/Hz.

    ``low`` and ``high`` bound the 95 % interval.
    """

    sensor: str
    model: str
    serial_number: str
    channel: str
    unit: str
    method: str
    low_hz: float
    high_hz: float
    psd: float
    low: float
    high: float

    @classmethod
    def of(cls, *values: Any) -> RecordedNoise:  # noqa: ANN401 - of the fields, in order
        """Return it from the fields in order; numbers that are None are not known, or no end."""
        unknown = (math.nan,) * 3 if values[-3] is None else (math.nan, -math.inf, math.inf)
        numbers = zip(values[-3:], unknown, strict=True)
        return cls(*values[:-3], *(none if value is None else value for value, none in numbers))


@dataclass(frozen=True, slots=True)
class Run:
    """One scheduled run.

    Attributes
    ----------
    bench, entry : str
        Names of the bench, and of the entry of its schedule.
    due : datetime
        UTC.
    state : RunState
    reason : str
        Why it failed, was missed, or ended early; what was done about it.
    duration : float
        Length of its window in s; with `until` the longest.
    until : EndCondition
        What ends its recording by the live estimate.
    queue : bool
        Whether it waits for a run that still records.
    started, ended : datetime or None
        UTC; when recording began, and when the last state was reached.
    parts : tuple of str
        File names of its recordings: more than one where it was interrupted.
    verdict : str
        On the limits of the bench file; empty where it has none.
    attempts : int
        Number of estimates begun.
    pinned : bool
        Whether it must be kept.
    removed : datetime or None
        When its files were removed.
    pending_hooks : tuple of str
        Hooks that have not been carried out.
    caveats : Caveats
        Earlier versions did not keep them.
    """

    bench: str
    entry: str
    due: datetime
    duration: float
    until: EndCondition = NEVER
    queue: bool = False
    state: RunState = RunState.DUE
    reason: str = ""
    started: datetime | None = None
    ended: datetime | None = None
    parts: tuple[str, ...] = ()
    verdict: str = ""
    attempts: int = 0
    pinned: bool = False
    removed: datetime | None = None
    pending_hooks: tuple[str, ...] = ()
    caveats: Caveats = NO_CAVEATS
    noise: tuple[RecordedNoise, ...] = field(default=(), compare=False)

    @property
    def key(self) -> str:
        """What no other run has: bench, entry and time."""
        return f"{self.bench}/{self.entry}/{utc_text(self.due)}"

    @property
    def name(self) -> str:
        """The run in messages."""
        return f"{self.entry} of {self.due:%Y-%m-%d %H:%M %Z}"

    @property
    def window_end(self) -> datetime | None:
        """When its recording is to end; None before it has begun."""
        return None if self.started is None else self.started + timedelta(seconds=self.duration)

    @property
    def is_over(self) -> bool:
        """Whether the run has reached its last state."""
        return not NEXT[self.state]

    def to(self, state: RunState, **changes: Any) -> Run:  # noqa: ANN401 - fields
        """Return the run in its next state.

        Raises
        ------
        WrongStateError
            If that state does not follow.
        """
        if state not in NEXT[self.state]:
            raise WrongStateError(f"run {self.name}: {state} cannot follow {self.state}")
        return replace(self, state=state, **changes)

    def because(self, reason: str) -> Run:
        """Return the run with further reasons, separated by semicolons, without repetitions."""
        reasons = [*(self.reason.split("; ") if self.reason else []), *reason.split("; ")]
        return replace(self, reason="; ".join(dict.fromkeys(reasons)))

    def record(self) -> dict[str, Any]:
        """Return what a recording keeps, from which the database can be made again."""
        return self.document() | {"queue": self.queue}

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> Run:
        """Return the run that is done, from `record` with ``verdict`` and ``noise``.

        Raises
        ------
        KeyError, TypeError, ValueError
            If it is no such record.
        """
        due, started = from_text(record["due"]), from_text(record["started"])
        if due is None:
            raise ValueError("a run without a due time")
        return cls(
            bench=str(record["bench"]),
            entry=str(record["entry"]),
            due=due,
            duration=float(record["duration"]),
            until=EndCondition.of_text(record["until"] or ""),
            queue=bool(record["queue"]),
            state=RunState.DONE,
            reason=str(record["reason"]),
            started=started,
            ended=None if started is None else started + timedelta(seconds=record["duration"]),
            parts=tuple(map(str, record["recordings"])),
            verdict=str(record["verdict"] or ""),
            noise=tuple(RecordedNoise.of(*each.values()) for each in record["noise"]),
        )

    def document(self) -> dict[str, Any]:
        """Return the run as JSON (docs/service.md)."""
        return {
            "bench": self.bench,
            "entry": self.entry,
            "due": utc_text(self.due),
            "state": self.state,
            "reason": self.reason,
            "verdict": self.verdict or None,
            "started": utc_text(self.started),
            "ended": utc_text(self.ended),
            "duration": self.duration,
            "target_cov": self.until.cov,
            "until": self.until.text or None,
            "recordings": list(self.parts),
            **self.caveats.keys,
            "pinned": self.pinned,
            "removed": utc_text(self.removed),
        }


def utc_text(moment: datetime | None) -> str | None:
    """Return an instant as ISO 8601 in UTC."""
    if moment is None:
        return None
    return moment.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def from_text(text: str | None) -> datetime | None:
    """Return the instant of `utc_text`."""
    return None if text is None else datetime.fromisoformat(text)
