"""Read from a driver until a test has enough."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, cast

from daq.protocols.block import Block, Event
from tests.devices import host_clock

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Sequence

    from daq.bench.model import Sensor
    from daq.drivers.interface import DriverType


@contextlib.asynccontextmanager
async def reading(
    driver: DriverType, sensors: Sequence[Sensor], *, speed: float = 1.0
) -> AsyncIterator[AsyncIterator[Block | Event]]:
    """Open a session and its reading; both are closed on exit."""
    async with (
        driver.open(sensors, host_clock(speed)) as session,
        contextlib.aclosing(cast("AsyncGenerator[Block | Event]", session.read())) as items,
    ):
        yield items


async def record(
    driver: DriverType, sensor: Sensor, n_samples: int, *, speed: float = 1.0
) -> tuple[list[Block], list[Event]]:
    """Return the blocks of one sensor up to a sample, and the events until then."""
    blocks: list[Block] = []
    events: list[Event] = []
    async with reading(driver, [sensor], speed=speed) as items:
        async for item in items:
            if isinstance(item, Event):
                events.append(item)
                continue
            blocks.append(item)
            if item.end_sample >= n_samples:
                break
    return blocks, events
