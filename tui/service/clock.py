"""The service's clock: the system's, or one that a test hands in."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Protocol

from daq.recorder.schedule import utc_now

if TYPE_CHECKING:
    from datetime import datetime


class Clock(Protocol):
    """Tells the time, and lets it pass."""

    def now(self) -> datetime:
        """Return the time, in UTC."""
        ...

    def elapsed(self) -> float:
        """Return seconds of a clock that is never set, and goes on while the computer sleeps."""
        ...

    async def sleep(self, seconds: float, wake: asyncio.Event) -> None:
        """Let seconds pass, or fewer if the event is set."""
        ...


class SystemTime:
    """The system's clock, which may be set."""

    def now(self) -> datetime:
        """Return the time, in UTC."""
        return utc_now()

    def elapsed(self) -> float:
        """Return seconds of a clock that is never set, and goes on while the computer sleeps."""
        boot = getattr(time, "CLOCK_BOOTTIME", None)  # Linux
        return time.monotonic() if boot is None else time.clock_gettime(boot)

    async def sleep(self, seconds: float, wake: asyncio.Event) -> None:
        """Let seconds pass, or fewer if the event is set."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await wake.wait()
