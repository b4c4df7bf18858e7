"""The service's clock: the system's, or one that a test hands in."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Protocol

from daq.acquisition.schedule import utc_now

if TYPE_CHECKING:
    from datetime import datetime


class Clock(Protocol):
    """Tells the time, and lets it pass."""

    def now(self) -> datetime:
        """Return the time, in UTC."""
        ...

    async def sleep(self, seconds: float, wake: asyncio.Event) -> None:
        """Let seconds pass, or fewer if the event is set."""
        ...


class SystemTime:
    """The system's clock, which may be set."""

    def now(self) -> datetime:
        """Return the time, in UTC."""
        return utc_now()

    async def sleep(self, seconds: float, wake: asyncio.Event) -> None:
        """Let seconds pass, or fewer if the event is set."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await wake.wait()
