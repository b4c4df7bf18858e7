"""World time: seconds since the specification's epoch, passing ``speed`` times as fast as ours."""

from __future__ import annotations

import time
from dataclasses import dataclass

NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class WorldClock:
    """World time from the system's monotonic clock, the same in every process.

    Attributes
    ----------
    epoch_ns : int
        Instant of the system's monotonic clock at which world time is 0.
    speed : float
        World seconds that pass in one second.
    """

    epoch_ns: int
    speed: float = 1.0

    def now(self) -> float:
        """World time in s."""
        return (time.monotonic_ns() - self.epoch_ns) / NS * self.speed

    def monotonic(self, world_time: float) -> float:
        """Instant of the monotonic clock, in s, at which it is ``world_time``."""
        return self.epoch_ns / NS + world_time / self.speed


def utc_of(monotonic_ns: int) -> int:
    """Return the UTC of an instant of the system's monotonic clock, in ns since 1970.

    The best of several looks at both clocks: processes agree to a few microseconds.
    """
    looks = [(time.monotonic_ns(), time.time_ns(), time.monotonic_ns()) for _ in range(20)]
    before, utc, after = min(looks, key=lambda look: look[2] - look[0])
    return monotonic_ns + utc - (before + after) // 2
