"""The host's clock, injected wherever time is read.

Simulated benches may run faster than life (``huddle devices --speed 8``): then host time runs
faster by the same factor, so that everything downstream sees the times of a bench at speed 1.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Protocol

from daq.protocols.block import HostTime

if TYPE_CHECKING:
    from collections.abc import Callable

_awake: Callable[[], int] = time.monotonic_ns
# Of the same rate, but it counts on while the computer is suspended.
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


@dataclass(frozen=True, slots=True)
class SystemClock:
    """The system's monotonic clock and UTC, both ``speed`` times as fast from construction on.

    UTC is read once: it then follows the monotonic clock, so that a step of the system's UTC in
    the middle of a run neither tears the recording nor moves its times. While the computer is
    suspended its monotonic clock stands still (Linux, ``CLOCK_MONOTONIC``); sensors do not, and
    where the system tells for how long, this one does not either.
    """

    speed: float = 1.0
    always_ns: Callable[[], int] = _always
    """Counts on while the computer is suspended."""
    _monotonic_ns: int = field(default_factory=_awake)
    _began_ns: int = field(default_factory=_always)
    _utc_ns: int = field(default_factory=time.time_ns)

    @property
    def suspended(self) -> float:
        """Seconds for which the computer has been suspended since construction."""
        return (self.always_ns() - self._began_ns - _awake() + self._monotonic_ns) * 1e-9

    def now(self) -> HostTime:
        """Return the present instant."""
        elapsed = self.always_ns() - self._began_ns
        if self.speed != 1.0:
            elapsed = round(elapsed * self.speed)
        return HostTime(self._monotonic_ns + elapsed, self._utc_ns + elapsed)
