"""Plausibility of the system's clock, which determines the age and the times of recordings."""

from __future__ import annotations

import ctypes
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from daq.host_clock import HostClock
from daq.protocols.block import Event, EventKind

RELEASED = datetime(2026, 11, 1, tzinfo=UTC)
"""Release of this software; a correct clock shows no earlier time."""
JUMP = timedelta(hours=1)
"""Difference between the system's clock and elapsed time that counts as a jump of the clock."""
REMOVAL_DELAY = timedelta(days=1)
"""Time after a jump in which nothing is removed."""

STEP = 0.1
"""Seconds by which the system's clock is set that a recording mentions."""
REPORT_INTERVAL = 3600.0
"""Seconds between two reports of the clock in a recording."""
_TIME_ERROR = 5
"""Reply of ``adjtimex`` if nothing disciplines the clock."""
_NANOSECONDS = 0x2000


class _Timex(ctypes.Structure):
    """The first fields of ``struct timex``; the others are kept as bytes."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("others", ctypes.c_byte * 512),
    )


@dataclass(frozen=True, slots=True)
class KernelClock:
    """The kernel's knowledge of the system's clock.

    Attributes
    ----------
    synchronised : bool
        Whether something disciplines the clock: NTP, PTP, or a receiver.
    offset : float
        Correction in s that is still to be made.
    error : float
        Estimated error in s.
    max_error : float
        Largest possible error in s.
    """

    synchronised: bool
    offset: float
    error: float
    max_error: float

    @property
    def text(self) -> str:
        """The state in words, for the event of a recording."""
        if not self.synchronised:
            return "unverified: not synchronised (adjtimex)"
        return (
            f"synchronised: offset {self.offset * 1e3:+.3f} ms, estimated error"
            f" {self.error * 1e3:.3f} ms, at most {self.max_error * 1e3:.0f} ms (adjtimex)"
        )


def clock_state() -> KernelClock | None:
    """Return the state of the system's clock; None if the system does not tell."""
    if sys.platform != "linux":
        return None
    timex = _Timex()  # modes = 0: only reads
    try:
        reply = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    except (OSError, AttributeError):
        return None
    if reply < 0:
        return None
    unit = 1e-9 if timex.status & _NANOSECONDS else 1e-6
    return KernelClock(
        reply != _TIME_ERROR, timex.offset * unit, timex.esterror * 1e-6, timex.maxerror * 1e-6
    )


class ClockWatch:
    """Reports the system's clock for a recording: at its start, hourly, and when it was set.

    The times of a recording follow the monotonic clock from its start on, so that they do not step.

    Parameters
    ----------
    clock : HostClock
        Clock of the recording.
    state : callable
        Returns the state of the system's clock.
    """

    def __init__(
        self,
        clock: HostClock,
        *,
        state: Callable[[], KernelClock | None] = clock_state,
    ) -> None:
        self._clock, self._state = clock, state
        self._ahead = 0.0
        self._reported = -math.inf

    def look(self) -> Event | None:
        """Return an event if there is something to report; call it every few seconds."""
        now = self._clock.now()
        at = now.monotonic_ns * 1e-9
        ahead = (self._clock.utc_ns() - now.utc_ns) * 1e-9
        step = ahead - self._ahead if self._clock.speed == 1.0 else 0.0
        is_step = abs(step) > STEP
        if not is_step and at < self._reported + REPORT_INTERVAL:
            return None
        self._reported = at
        state = self._state()
        text = "state unknown: the system does not tell" if state is None else state.text
        if is_step:  # at once, in small steps, or by drift
            self._ahead = ahead
            text = f"moved by {step:+.3f} s; the times of this recording do not follow; {text}"
        return Event("", EventKind.CLOCK, text, now)


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
