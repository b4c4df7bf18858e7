"""The host's clock, injected wherever time is read.

Simulated benches may run faster than life (``huddle devices --speed 8``): then host time runs
faster by the same factor, so that everything downstream sees the times of a bench at speed 1.
"""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING, Protocol

from daq.protocols.block import HostTime

if TYPE_CHECKING:
    from collections.abc import Callable

# Counts on while the computer is suspended, unlike time.monotonic_ns.
_always: Callable[[], int] = (
    partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)
    if hasattr(time, "CLOCK_BOOTTIME")
    else time.monotonic_ns
)


class HostClock(Protocol):
    """Where host times come from."""

    @property
    def speed(self) -> float:
        """Host seconds that pass in one second of the system's monotonic clock."""
        ...

    @property
    def suspended(self) -> float:
        """Seconds for which the computer has been suspended so far; they have passed as well."""
        ...

    def now(self) -> HostTime:
        """Return the present instant."""
        ...


class SystemClock:
    """The system's monotonic clock and UTC, both ``speed`` times as fast from construction on.

    UTC is read once: it then follows the monotonic clock, so that a step of the system's UTC in
    the middle of a run neither tears the recording nor moves its times. While the computer is
    suspended its monotonic clock stands still (Linux, ``CLOCK_MONOTONIC``); sensors do not, and
    where the system tells for how long, this one does not either.

    Parameters
    ----------
    speed : float
        Host seconds that pass in one second of the monotonic clock.
    monotonic_ns : callable
        The monotonic clock, which stands still while the computer is suspended.
    always_ns : callable
        A clock of the same rate that counts on while the computer is suspended.
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
        self._monotonic_ns, self._began_ns, self._utc_ns = monotonic_ns(), always_ns(), utc_ns()

    @property
    def suspended(self) -> float:
        """Seconds for which the computer has been suspended since construction."""
        awake = self._now_ns() - self._monotonic_ns
        return (self._always_ns() - self._began_ns - awake) * 1e-9

    def now(self) -> HostTime:
        """Return the present instant."""
        elapsed = self._always_ns() - self._began_ns
        if self.speed != 1.0:
            elapsed = round(elapsed * self.speed)
        return HostTime(self._monotonic_ns + elapsed, self._utc_ns + elapsed)
