"""Read from a driver until a test has enough."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from typing import cast

from daq.bench.model import Sensor
from daq.devices.interface import AnyDriver, Session
from daq.errors import NoAnswerError
from daq.protocols.block import Block, DeviceItem, Event
from tests.devices import host_clock

LEAST_PATIENCE = 5.0
"""Seconds: what is sent may wait in the system while the clock of the devices goes on."""


@contextlib.asynccontextmanager
async def reading(
    driver: AnyDriver, sensors: Sequence[Sensor], *, speed: float = 1.0
) -> AsyncIterator[AsyncIterator[DeviceItem]]:
    """Open a session and its reading; both are closed on exit."""
    async with (
        driver.open(sensors, host_clock(speed)) as session,
        contextlib.aclosing(_patiently(session, speed)) as items,
    ):
        yield items


async def _patiently(session: Session, speed: float) -> AsyncGenerator[DeviceItem]:
    """Yield what the session yields, until nothing has come for as long as it states."""
    patience = max(LEAST_PATIENCE, session.patience / speed)
    loop = asyncio.get_running_loop()
    async with contextlib.aclosing(cast("AsyncGenerator[DeviceItem]", session.read())) as items:
        deadline = loop.time() + patience
        while True:
            try:
                async with asyncio.timeout_at(deadline):
                    item = await anext(items)
            except TimeoutError as error:
                if isinstance(error, NoAnswerError):
                    raise
                sensor = session.information[0].sensor
                raise NoAnswerError(
                    f"{sensor!r}: nothing for {patience:g} s; {session.hint}"
                ) from error
            if isinstance(item, Block):
                deadline = loop.time() + patience
            yield item


async def record(
    driver: AnyDriver, sensor: Sensor, n_samples: int, *, speed: float = 1.0
) -> tuple[list[Block], list[Event]]:
    """Return the blocks of one sensor up to a sample, and the events until then."""
    blocks, events = await record_all(driver, [sensor], n_samples, speed=speed)
    return blocks[sensor.name], events


async def record_all(
    driver: AnyDriver, sensors: Sequence[Sensor], n_samples: int, *, speed: float = 1.0
) -> tuple[dict[str, list[Block]], list[Event]]:
    """Return the blocks of all sensors of a port up to a sample, and the events until then."""
    blocks: dict[str, list[Block]] = {sensor.name: [] for sensor in sensors}
    events: list[Event] = []
    async with reading(driver, sensors, speed=speed) as items:
        async for item in items:
            if isinstance(item, Event):
                events.append(item)
            if not isinstance(item, Block):
                continue
            blocks[item.sensor].append(item)
            if all(each and each[-1].end_sample >= n_samples for each in blocks.values()):
                break
    return blocks, events
