"""Tells systemd that the service lives, as long as what it supervises makes progress."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tui.service.notify import Notifier, watchdog_interval
from tui.service.window import STALL

if TYPE_CHECKING:
    from tui.service.service import Service

INTERVAL = 10.0
"""Seconds between two signs of life, at most."""


def is_alive(service: Service, at: float) -> bool:
    """Whether a recorder, where one runs, has lately put samples on the disk.

    Parameters
    ----------
    service : Service
    at : float
        Time of the event loop.
    """
    window = service.window
    if window is None or window.progressed_at is None:
        return True  # a recorder that starts is given up by its window
    return at - window.progressed_at < 2 * STALL.total_seconds()


def status_line(service: Service) -> str:
    """Return what the service does, in a line."""
    if service.recording is not None:
        return f"recording run {service.recording.name}"
    run = service.next_run
    return "no run is planned" if run is None else f"next run: {run.name}"


async def signs_of_life(service: Service, notifier: Notifier) -> None:
    """Send ``READY`` and then ``WATCHDOG`` until cancelled."""
    notifier.send("READY=1")
    interval = min(INTERVAL, watchdog_interval() or INTERVAL)
    loop = asyncio.get_running_loop()
    while True:
        lines = [f"STATUS={status_line(service)}"]
        if is_alive(service, loop.time()):
            lines.append("WATCHDOG=1")
        notifier.send(*lines)
        await asyncio.sleep(interval)
