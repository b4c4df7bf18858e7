"""A driver whose devices the test plays: what it puts into a queue is what a session yields."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from daq.bench.channel import Channel
from daq.bench.model import Bench, Sensor
from daq.devices.interface import (
    DEFAULT_PATIENCE,
    DeviceInformation,
    Driver,
    DriverSettings,
    Session,
)
from daq.host_clock import HostClock
from daq.protocols.block import Block, DeviceItem, HostTime
from daq.recorder.connection import Connection, Item

RATE = 100.0


@dataclass
class ManualClock:
    """A clock that the test moves."""

    ns: int = 10**12
    speed: float = 1.0
    suspended: float = 0.0

    def now(self) -> HostTime:
        """Return the present instant."""
        return HostTime(self.ns, self.ns + 10**18)

    def utc_ns(self) -> int:
        """Return UTC of the present instant."""
        return self.now().utc_ns

    def advance(self, seconds: float) -> None:
        """Move it."""
        self.ns += round(seconds * 1e9)


@dataclass
class PlayedDevice:
    """What is on one port."""

    serial_number: str = "1"
    failure: Exception | None = None
    n_sessions: int = 0
    items: asyncio.Queue[DeviceItem | Exception] = field(default_factory=asyncio.Queue)
    opened: asyncio.Event = field(default_factory=asyncio.Event)
    left_quiet: bool = True
    hangs: bool = False
    """When it is to be left."""
    may_end: asyncio.Event | None = None
    """Until then it does not end, whoever cancels it."""
    sampling_rate: float | None = None
    troubles: dict[str, str] = field(default_factory=dict)
    """Of its sensors that do not answer."""


@dataclass
class PlayedSession(Session):
    """A session on a played device."""

    device: PlayedDevice
    information: tuple[DeviceInformation, ...]
    patience: float = DEFAULT_PATIENCE

    async def read(self) -> AsyncIterator[DeviceItem]:
        """Yield what the test put there; raise where it put an exception."""
        while True:
            item = await self.device.items.get()
            if isinstance(item, Exception):
                raise item
            yield item


@dataclass
class PlayedDriver(Driver[DriverSettings]):
    """A driver for played devices, by port."""

    devices: dict[str, PlayedDevice] = field(default_factory=dict)
    name: str = "played"
    summary: str = ""
    settings: type[DriverSettings] = DriverSettings

    def find(self, name: str) -> PlayedDriver:
        """Return itself, as the registry would."""
        assert name == self.name
        return self

    @contextlib.asynccontextmanager
    async def open(
        self,
        sensors: Sequence[Sensor],
        clock: HostClock,  # noqa: ARG002  (of the seam)
    ) -> AsyncIterator[PlayedSession]:
        """Open a session, or fail as the test says."""
        device = self.devices[sensors[0].port]
        if device.failure is not None:
            raise device.failure
        device.n_sessions += 1
        device.left_quiet = False
        device.opened.set()
        information = tuple(
            DeviceInformation(
                sensor.name,
                serial_number=device.serial_number,
                sampling_rate=device.sampling_rate,
                trouble=device.troubles.get(sensor.name, ""),
            )
            for sensor in sensors
        )
        try:
            yield PlayedSession(device, information)
        finally:
            if device.hangs:
                await asyncio.Event().wait()
            while device.may_end is not None and not device.may_end.is_set():
                with contextlib.suppress(asyncio.CancelledError):
                    await device.may_end.wait()
            device.left_quiet = True


def bench(*names: str, **ports: str) -> Bench:
    """Return a bench of played sensors; a sensor's port is its name unless told."""
    channels = (Channel(name="x", sensitivity=1.0), Channel(name="y", sensitivity=1.0))
    return Bench(
        name="played bench",
        sampling_rate=RATE,
        sensors=tuple(
            Sensor(
                name=name,
                driver="played",
                port=ports.get(name, name),
                sampling_rate=RATE,
                channels=channels,
            )
            for name in names
        ),
    )


def counts(first: int, n: int) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
    """Return counts that tell their place."""
    return (np.arange(first, first + n)[:, None] * 10 + np.arange(2)).astype(np.int32)


def block(sensor: str, first: int, n: int, at: HostTime, **rest: Any) -> Block:  # noqa: ANN401
    """Return a block of such counts."""
    return Block(sensor, first, counts(first, n), at, **rest)


@contextlib.asynccontextmanager
async def run(connection: Connection) -> AsyncIterator[asyncio.Queue[Item]]:
    """Keep a connection while the context lasts; yields what it says."""
    queue: asyncio.Queue[Item] = asyncio.Queue()
    go = asyncio.Event()
    go.set()
    running = asyncio.create_task(connection.run(queue, go))
    try:
        yield queue
    finally:
        running.cancel()
        await asyncio.wait([running])
