"""One port's device, kept connected for as long as a run lasts.

Connects, reads, and hands on; when the device is lost or stalls, says so, and tries again with
back-off. What it hands on is in its sessions' own indices (:mod:`daq.continuity` places it).
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daq.errors import DeviceError, NoAnswerError, WrongDeviceError
from daq.protocols.block import Block, Event
from daq.protocols.errors import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Sequence

    from daq.bench_model import Sensor
    from daq.clock import HostClock
    from daq.drivers.base import DeviceInformation, DriverType, Session

FIRST_PATIENCE = 10.0
"""How long to wait for the first block of a session, in s; drivers know better and say so."""
LEAST_PATIENCE = 0.5
FIRST_DELAY, LONGEST_DELAY = 0.2, 5.0


@dataclass(frozen=True, slots=True)
class Connected:
    """A session began: blocks that follow are in its index."""

    sensors: tuple[str, ...]
    reason: str
    """Why the one before ended; empty for the first."""


Item = Block | Event | Connected


class Patience:
    """How long the next block may take: twice what a block took so far."""

    def __init__(self) -> None:
        self._longest = 0.0
        self._last: float | None = None

    @property
    def seconds(self) -> float:
        """From the last block on."""
        if self._longest == 0.0:
            return FIRST_PATIENCE
        return max(LEAST_PATIENCE, 2 * self._longest)

    def block_came(self, now: float) -> None:
        """Learn from a block; an old long interval is forgotten slowly."""
        if self._last is not None:
            self._longest = max(0.98 * self._longest, now - self._last, 1e-6)
        self._last = now

    def is_over(self, now: float) -> bool:
        """Return whether a block is overdue."""
        return self._last is not None and now - self._last > self.seconds


class Connection:
    """A port with its driver and sensors."""

    def __init__(self, driver: DriverType, sensors: Sequence[Sensor], clock: HostClock) -> None:
        self.driver = driver
        self.sensors = tuple(sensors)
        self.port = self.sensors[0].port
        self.names = tuple(sensor.name for sensor in self.sensors)
        self.information: tuple[DeviceInformation, ...] = ()
        """What the devices said when they were first connected."""
        self.connected: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Done when the first session is open, or could not be opened."""
        self.alive = False
        self._clock = clock

    async def run(self, queue: asyncio.Queue[Item], go: asyncio.Event) -> None:
        """Connect once, wait for ``go``, then read until cancelled, reconnecting if need be."""
        reason, said, delay = "", "", FIRST_DELAY
        while True:
            try:
                async with self.driver.open(self.sensors, self._clock) as session:
                    self._check_identity(session)
                    if not self.connected.done():
                        self.connected.set_result(None)
                        await go.wait()
                    await queue.put(Connected(self.names, reason))
                    for name in self.names:
                        text = self._describe(session, name)
                        await queue.put(Event(name, "connected", text, self._clock.now()))
                    self.alive = True
                    async for item in self._items(session):
                        delay = FIRST_DELAY
                        await queue.put(item)
                failure: Exception = NoAnswerError(f"{self.port}: the device ended its session")
            except (DeviceError, RemoteProtocolError) as error:
                failure = error
            except Exception as error:
                # Whatever a driver raises concerns its device only: a fault of one must not end
                # the recording of the others. At the start it is reported, later recorded.
                if not self.connected.done():
                    raise
                failure = error
            if not self.connected.done():
                self.connected.set_exception(failure)
                return
            kind = _kind(failure)
            reason = kind if self.alive else reason
            # Said once, not at every attempt: a device may be away for weeks.
            if self.alive or (kind == "refused" and str(failure) != said):
                said = str(failure)
                for name in self.names:
                    await queue.put(Event(name, kind, said, self._clock.now()))
            self.alive = False
            await asyncio.sleep(delay)
            delay = min(2 * delay, LONGEST_DELAY)

    async def _items(self, session: Session) -> AsyncIterator[Block | Event]:
        """Yield what the session does, and raise if nothing comes for too long."""
        loop = asyncio.get_running_loop()
        patience = {name: Patience() for name in self.names}
        stalled: set[str] = set()
        whole = Patience()
        async with contextlib.aclosing(_generator(session)) as items:
            while True:
                deadline = whole.seconds
                try:
                    async with asyncio.timeout(deadline):
                        item = await anext(items)
                except StopAsyncIteration:
                    return
                except TimeoutError as error:
                    if isinstance(error, DeviceError):
                        raise
                    raise NoAnswerError(
                        f"{self.port}: stalled: nothing came for {deadline:.2g} s"
                    ) from error
                now = loop.time()
                if isinstance(item, Block):
                    whole.block_came(now)
                    patience[item.sensor].block_came(now)
                    stalled.discard(item.sensor)
                yield item
                # One of several devices on a port: its driver looks after it; here it is said.
                for name in self.names:
                    if name not in stalled and patience[name].is_over(now):
                        stalled.add(name)
                        yield Event(name, "stalled", "others on the port go on", self._clock.now())

    def _check_identity(self, session: Session) -> None:
        """Refuse another device than the bench file names, or than was there before."""
        found = tuple(session.information)
        known = {information.sensor: information for information in self.information}
        for sensor in self.sensors:
            now = next((i for i in found if i.sensor == sensor.name), None)
            if now is None:
                continue
            before = known.get(sensor.name)
            wanted = sensor.serial_number or (before.serial_number if before else "")
            if wanted and now.serial_number and now.serial_number != wanted:
                raise WrongDeviceError(
                    f"sensor {sensor.name!r} on {self.port}: expected serial number {wanted!r},"
                    f" got {now.serial_number!r}"
                )
            rate = now.sampling_rate
            if rate is not None and abs(rate / sensor.sampling_rate - 1) > 0.02:
                raise WrongDeviceError(
                    f"sensor {sensor.name!r} on {self.port}: expected {sensor.sampling_rate:g} Hz,"
                    f" the device samples at {rate:g} Hz"
                )
        self.information = self.information or found

    def _describe(self, session: Session, name: str) -> str:
        found = next((i for i in session.information if i.sensor == name), None)
        parts = (found.model, found.serial_number, found.firmware) if found else ()
        return " ".join(("on", self.port, *(part for part in parts if part)))


async def _generator(session: Session) -> AsyncGenerator[Block | Event, None]:
    """Make of any asynchronous iterator a generator, which can be closed."""
    items = session.read()
    try:
        async for item in items:
            yield item
    finally:
        close = getattr(items, "aclose", None)
        if close is not None:
            await close()


def _kind(failure: Exception) -> str:
    if isinstance(failure, WrongDeviceError):
        return "refused"
    return "stalled" if isinstance(failure, NoAnswerError) else "disconnected"
