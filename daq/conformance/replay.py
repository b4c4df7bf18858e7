"""Replays a log of ``huddle record --wire-log`` through a driver: a session as a golden test."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, cast

from daq.errors import NoAnswerError, NotConnectedError, ReplayError
from daq.transport.wire_log import Replay, using

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Sequence
    from pathlib import Path

    from daq.bench.model import Sensor
    from daq.devices.interface import AnyDriver
    from daq.protocols.block import DeviceItem

LIMIT = 60.0
"""Seconds for which a driver may wait for what it does not ask for."""


async def replay(
    path: str | Path, driver: AnyDriver, sensors: Sequence[Sensor], *, limit: float = LIMIT
) -> list[DeviceItem]:
    """Return the blocks and events of the first session on the port of some sensors.

    Parameters
    ----------
    path
        The log. The port of the sensors is that of the bench file of the recording.
    driver, sensors
        As in the bench file.
    limit
        Seconds after which a driver that waits has not sent what the log has.

    Raises
    ------
    ReplayError
        If the driver sends other bytes than the log has, or waits for others.
    """
    log = Replay(path)
    found: list[DeviceItem] = []
    try:
        async with asyncio.timeout(limit):
            with using(log):
                async with driver.open(sensors, log.clock) as session:
                    items = cast("AsyncGenerator[DeviceItem]", session.read())
                    async with contextlib.aclosing(items):
                        async for item in items:
                            found.append(item)  # noqa: PERF401 -- kept if the driver raises
    except (NotConnectedError, NoAnswerError):
        if not found:
            raise
    except TimeoutError as error:
        raise ReplayError(
            f"{path}: the driver waits, and does not send what the log has"
        ) from error
    return found
