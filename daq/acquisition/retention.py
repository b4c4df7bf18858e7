"""Which recordings are too old, and whether the clock that says so can be believed."""

from __future__ import annotations

import logging
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

from daq.errors import HuddleError, RecordingError
from daq.recording.reader import Recording
from daq.recording.storage.journal import journal_path
from daq.recording.storage.locking import is_being_written

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

_LOGGER = logging.getLogger(__name__)
RELEASED = datetime(2026, 11, 1, tzinfo=UTC)
"""No clock that is right shows an earlier time to this software."""
KEPT = 3
"""Number of the newest recordings of a bench that are never removed, however old."""
JUMP = timedelta(hours=1)
"""Difference between the system's clock and elapsed time that counts as a jump of the clock."""
DISTRUST = timedelta(days=1)
"""Time after a jump in which nothing is removed."""
OF_A_RUN = (".json", ".csv", ".html", ".pdf")
"""Suffixes of the other files of a run, which are removed with its recording."""


class ClockTrust:
    """Whether the system's clock can be believed, from how it went since it was looked at.

    Parameters
    ----------
    now : callable
        The system's clock.
    monotonic : callable
        Seconds of a clock that is never set.
    """

    def __init__(self, now: Callable[[], datetime], monotonic: Callable[[], float]) -> None:
        self._now, self._monotonic = now, monotonic
        self._last = now(), monotonic()
        self._jumped: float | None = None

    def doubt(self) -> str:
        """Return why the clock cannot be believed, or an empty text."""
        now, at = self._now(), self._monotonic()
        before, at_before = self._last
        self._last = now, at
        jump = now - before - timedelta(seconds=at - at_before)
        if abs(jump) > JUMP:
            self._jumped = at
        if now < RELEASED:
            return f"the system's clock shows {now:%Y-%m-%d}, before this software was released"
        if self._jumped is not None and at - self._jumped < DISTRUST.total_seconds():
            return (
                f"the system's clock was set by more than {JUMP.total_seconds() / 3600:.0f} h"
                f" less than {DISTRUST.days} d ago, or the computer was asleep"
            )
        return ""


def remove_old(
    directory: Path, retention: float, *, bench: str, now: datetime, kept: int = KEPT
) -> list[Path]:
    """Remove runs of a bench that are older than ``retention`` seconds; return their recordings.

    With a recording go its journal, results and reports (`OF_A_RUN`). Only closed recordings of the
    bench with that name are removed: never other files, recordings of other benches, imported or
    growing ones, or those left open by a crash; nor the newest ones.

    Parameters
    ----------
    directory : Path
    retention : float
        In seconds.
    bench : str
        Name of the bench.
    now : datetime
    kept : int
        Number of the newest closed recordings that stay.

    Raises
    ------
    RecordingError
        If some files cannot be removed; the others are removed all the same.
    """
    limit = now - timedelta(seconds=retention)
    found = [(created, path) for path in directory.glob("*.h5") if (created := _age(path, bench))]
    removed, failures = [], []
    for created, path in sorted(found)[: len(found) - kept]:
        if created >= limit:
            continue
        try:
            remove_run(path)
        except OSError as error:
            failures.append(f"{error.filename or path}: cannot be removed: {error.strerror}")
        else:
            removed.append(path)
    if failures:
        raise RecordingError("; ".join(failures))
    return removed


def remove_run(path: Path) -> None:
    """Remove the files of a run, the recording last: by it the others are found again.

    Raises
    ------
    OSError
        If a file cannot be removed.
    """
    for other in (journal_path(path), *(path.with_suffix(suffix) for suffix in OF_A_RUN)):
        other.unlink(missing_ok=True)
    path.unlink()


def _age(path: Path, bench: str) -> datetime | None:
    """Return when a closed recording of a bench was begun; None of any other file."""
    try:
        with Recording.open(path) as recording:
            own = recording.bench is not None and recording.bench.name == bench
            own = own and recording.closed
            return recording.created if own and not is_being_written(path) else None
    except (HuddleError, OSError):  # no recording of ours, or removed meanwhile
        return None
