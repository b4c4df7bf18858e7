"""Limits the share of time that repeated work takes, so that the machine stays free to record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Self


class Throttle:
    """Measures repeated work, and decides when it may be done again.

    Enter the throttle as a context manager around the work. Its cost is the time that it takes, or
    the processor time of all threads where that is longer.

    Parameters
    ----------
    share : float
        Of the time, at most, that the work may cost.
    longest : float
        Seconds after which the work is due, whatever it cost.
    now : callable
        Seconds of a clock that never goes back.
    """

    def __init__(
        self,
        share: float,
        *,
        longest: float = math.inf,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._share, self._longest, self._now = share, longest, now
        self._began = self._next = now()
        self._used_before = self._elsewhere = 0.0
        self.cost = 0.0
        """Seconds that the work cost the last time."""

    @property
    def remaining(self) -> float:
        """Seconds until the work may be done again; 0 where it may be done now."""
        return max(0.0, self._next - self._now())

    @property
    def is_due(self) -> bool:
        """Whether the work may be done now."""
        return self._now() >= self._next

    def deduct(self, seconds: float) -> None:
        """Deduct what another throttle limits from the cost of the present work."""
        self._elsewhere += seconds

    def __enter__(self) -> Self:
        self._began, self._used_before = self._now(), time.process_time()
        self._elsewhere = 0.0
        return self

    def __exit__(self, *_: object) -> None:
        cost = max(self._now() - self._began, time.process_time() - self._used_before)
        self.cost = max(0.0, cost - self._elsewhere)
        self._next = min(self._began + self.cost / self._share, self._now() + self._longest)
