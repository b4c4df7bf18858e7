"""World time: seconds since the specification's epoch, at ``speed`` times real time."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class WorldClock:
    """World time from a monotonic clock that all processes of the bench share.

    Attributes
    ----------
    epoch_ns : int
        Instant of the monotonic clock at which world time is 0.
    speed : float
        World seconds that pass in one second.
    monotonic_ns : callable
        The monotonic clock: the system's, or :meth:`PacedClock.now_ns
        <sim_devices.server.paced_clock.PacedClock.now_ns>`.
    """

    epoch_ns: int
    speed: float = 1.0
    monotonic_ns: Callable[[], int] = time.monotonic_ns

    def now(self) -> float:
        """Return the world time in s."""
        return (self.monotonic_ns() - self.epoch_ns) / NS * self.speed

    def monotonic(self, world_time: float) -> float:
        """Return the instant of the monotonic clock, in s, of a world time."""
        return self.epoch_ns / NS + world_time / self.speed
