"""Plausibility of the system's clock, which determines the age of recordings."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

RELEASED = datetime(2026, 11, 1, tzinfo=UTC)
"""Release of this software; a correct clock shows no earlier time."""
JUMP = timedelta(hours=1)
"""Difference between the system's clock and elapsed time that counts as a jump of the clock."""
REMOVAL_DELAY = timedelta(days=1)
"""Time after a jump in which nothing is removed."""


class ClockTrust:
    """Plausibility of the system's clock, from its progress between calls.

    Parameters
    ----------
    now : callable
        The system's clock.
    monotonic : callable
        Time in s of a clock that is never set.
    """

    def __init__(self, now: Callable[[], datetime], monotonic: Callable[[], float]) -> None:
        self._now, self._monotonic = now, monotonic
        self._last = now(), monotonic()
        self._jumped: float | None = None

    def doubt(self) -> str:
        """Return why the clock is not plausible; empty if it is."""
        now, at = self._now(), self._monotonic()
        before, at_before = self._last
        self._last = now, at
        jump = now - before - timedelta(seconds=at - at_before)
        if abs(jump) > JUMP:
            self._jumped = at
        if now < RELEASED:
            return f"the system's clock shows {now:%Y-%m-%d}, before this software was released"
        if self._jumped is not None and at - self._jumped < REMOVAL_DELAY.total_seconds():
            return (
                f"the system's clock was set by more than {JUMP.total_seconds() / 3600:.0f} h"
                f" less than {REMOVAL_DELAY.days} d ago, or the computer was asleep"
            )
        return ""
