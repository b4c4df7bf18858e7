"""The host's clock, passed to all code that reads time.

Simulated benches may run faster than real time (``huddle devices --speed 8``). Host time then runs
faster by the same factor, so that all later processing sees the times of a bench at speed 1.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Protocol

from daq.protocols.block import HostTime

# Continues while the computer is suspended, unlike time.monotonic_ns.
_always: Callable[[], int] = (
    partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)
    if hasattr(time, "CLOCK_BOOTTIME")
    else time.monotonic_ns
)


class HostClock(Protocol):
    """Source of host times."""

    @property
    def speed(self) -> float:
        """Host seconds that pass in one second of the system's monotonic clock."""

    @property
    def suspended(self) -> float:
        """Return the total time for which the computer was suspended, in s; part of host time."""

    def now(self) -> HostTime:
        """Return the present instant."""

    def utc_ns(self) -> int:
        """Return UTC in ns since 1970 as its source has it, which may be set during a run."""


class SystemClock:
    """The system's monotonic clock and UTC, both ``speed`` times as fast from construction on.

    UTC is read once and then follows the monotonic clock, so that a step of the system's UTC during
    a run has no effect on the recording. The monotonic clock stops while the computer is suspended
    (Linux, ``CLOCK_MONOTONIC``), but sensors continue. This clock adds the time of suspension if
    the system has a clock that includes it.

    Parameters
    ----------
    speed : float
        Host seconds that pass in one second of the monotonic clock.
    monotonic_ns : callable
        The monotonic clock, which stops while the computer is suspended.
    always_ns : callable
        A clock of the same rate that continues while the computer is suspended.
    utc_ns : callable
        UTC in ns since 1970.
    """

    def __init__(
        self,
        speed: float = 1.0,
        *,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        always_ns: Callable[[], int] = _always,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.speed = speed
        self._now_ns, self._always_ns = monotonic_ns, always_ns
        self._read_utc_ns = utc_ns
        self._monotonic_ns, self._began_ns, self._utc_ns = monotonic_ns(), always_ns(), utc_ns()

    @property
    def suspended(self) -> float:
        """Return the time for which the computer was suspended since construction, in s."""
        awake = self._now_ns() - self._monotonic_ns
        return (self._always_ns() - self._began_ns - awake) * 1e-9

    def now(self) -> HostTime:
        """Return the present instant."""
        elapsed = self._always_ns() - self._began_ns
        if self.speed != 1.0:
            elapsed = round(elapsed * self.speed)
        return HostTime(self._monotonic_ns + elapsed, self._utc_ns + elapsed)

    def utc_ns(self) -> int:
        """Return UTC in ns since 1970 as its source has it, which may be set during a run."""
        return self._read_utc_ns()
