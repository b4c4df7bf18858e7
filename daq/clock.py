"""The host's clock, injected wherever time is read.

Simulated benches may run faster than life (``huddle devices --speed 8``): then host time runs
faster by the same factor, so that everything downstream sees the times of a bench at speed 1.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Protocol

from daq.protocols.block import HostTime


class HostClock(Protocol):
    """Where host times come from."""

    @property
    def speed(self) -> float:
        """Host seconds that pass in one second of the system's monotonic clock."""
        ...

    def now(self) -> HostTime:
        """Return the present instant."""
        ...


@dataclass(frozen=True, slots=True)
class SystemClock:
    """The system's monotonic clock and UTC, both ``speed`` times as fast from construction on.

    UTC is read once: it then follows the monotonic clock, so that a step of the system's UTC in
    the middle of a run neither tears the recording nor moves its times.
    """

    speed: float = 1.0
    _monotonic_ns: int = field(default_factory=time.monotonic_ns)
    _utc_ns: int = field(default_factory=time.time_ns)

    def now(self) -> HostTime:
        """Return the present instant."""
        elapsed = time.monotonic_ns() - self._monotonic_ns
        if self.speed != 1.0:
            elapsed = round(elapsed * self.speed)
        return HostTime(self._monotonic_ns + elapsed, self._utc_ns + elapsed)
