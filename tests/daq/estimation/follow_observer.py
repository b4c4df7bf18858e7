"""An observer that keeps what `follow` reports, and the process of a recorder."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.recording.monitor import RecordingStatus


class NoWait(threading.Event):
    """An event for which nobody waits: what would be a pause is none."""

    def wait(self, timeout: float | None = None) -> bool:
        """Return at once."""
        del timeout
        return self.is_set()


class Goes(NoWait):
    """An event during whose pauses something goes on."""

    def __init__(self, goes_on: Callable[[], object]) -> None:
        super().__init__()
        self._goes_on = goes_on

    def wait(self, timeout: float | None = None) -> bool:
        """Go on."""
        self._goes_on()
        return super().wait(timeout)


@dataclass
class Noted:
    """Keeps the calls it receives, in order."""

    cancelled: threading.Event = field(default_factory=NoWait)
    wanted: int = 10**9
    """Looks after which it has seen enough."""
    calls: list[str] = field(default_factory=list)
    seen: list[RecordingStatus] = field(default_factory=list)
    snapshots: list[Snapshot] = field(default_factory=list)
    taken: list[int] = field(default_factory=list)

    def status(self, status: RecordingStatus) -> None:
        """Count it."""
        self.calls.append("look")
        self.seen.append(status)
        if len(self.seen) >= self.wanted:
            self.cancelled.set()

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Keep it."""
        assert settings.segment > 0
        self.calls.append("snapshot")
        self.snapshots.append(snapshot)

    def segments(self, n_segments: int, elapsed: float) -> None:
        """Keep it."""
        assert elapsed > 0
        self.taken.append(n_segments)

    def progress(self, done: int, total: int) -> None:
        """Check it."""
        assert 0 < done <= total


@dataclass
class Process:
    """A recorder's process: notes for how long it is waited for, and then goes on."""

    goes_on: Callable[[], object]
    ended: bool = False
    waits: list[float] = field(default_factory=list)

    def ends_within(self, timeout: float) -> bool:
        """Go on."""
        self.waits.append(timeout)
        self.goes_on()
        return self.ended
