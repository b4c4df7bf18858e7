"""One port's device, kept connected for as long as a run lasts.

Connects, reads, and hands on; when the device is lost or stalls, says so, and tries again with
back-off. What it hands on is in its sessions' own indices (:mod:`daq.continuity` places it).
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from daq.errors import DeviceError, NoAnswerError, WrongDeviceError
from daq.protocols.block import Block, Event
from daq.protocols.errors import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterator, Sequence
    from types import TracebackType

    from daq.bench_model import Sensor
    from daq.clock import HostClock
    from daq.drivers.base import DeviceInformation, DriverType, Session

FIRST_PATIENCE = 10.0
"""How long to wait for the first block of a session, in s, if it is short; drivers know better."""
LONGEST_FIRST_BLOCK = 1100
"""Samples a first block may have: one block of GCF holds up to a thousand."""
LEAST_PATIENCE = 0.5
LATENESS = 0.25
"""What a block may come late by, s: one that is lost whole must not look like a stall."""
FIRST_DELAY, LONGEST_DELAY = 0.2, 5.0


@dataclass(frozen=True, slots=True)
class Connected:
    """A session began: blocks that follow are in its index."""

    sensors: tuple[str, ...]
    reason: str
    """Why the one before ended; empty for the first."""


Item = Block | Event | Connected


class _Patience:
    """How long the next block may take: twice as long as blocks took so far."""

    def __init__(self, now: float, first: float) -> None:
        self.last = now
        self._first = first
        self._longest = 0.0
        self._begun = False

    @property
    def seconds(self) -> float:
        """From the last block on."""
        return max(LEAST_PATIENCE, 2 * self._longest + LATENESS) if self._begun else self._first

    def block_came(self, now: float, duration: float) -> None:
        """Learn from a block and the time its samples took; what was long is forgotten slowly."""
        interval = now - self.last if self._begun else 0.0
        self._longest = max(0.98 * self._longest, interval, duration)
        self._begun, self.last = True, now


class _Watch:
    """Interrupts who waits for a block, when that is overdue; ``sampling_rates`` in samples per s.

    One look every ``TICK`` instead of one timer a block; and when the event loop itself was held
    up, nobody's device is to blame.
    """

    TICK = 0.1

    def __init__(self, sampling_rates: dict[str, float]) -> None:
        self._loop = asyncio.get_running_loop()
        self._rates = sampling_rates
        now = self._loop.time()
        first = FIRST_PATIENCE + LONGEST_FIRST_BLOCK / min(sampling_rates.values())
        self._whole = _Patience(now, first)
        self._each = {name: _Patience(now, first) for name in sampling_rates}
        self._stalled: set[str] = set()
        self._timeout = asyncio.timeout(None)
        self._is_waiting = False
        self._last_look = now
        self._timer: asyncio.TimerHandle | None = None

    @property
    def seconds(self) -> float:
        """How long a block may take."""
        return self._whole.seconds

    async def __aenter__(self) -> Self:
        await self._timeout.__aenter__()
        self._timer = self._loop.call_later(self.TICK, self._look)
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._timer is not None:
            self._timer.cancel()
        await self._timeout.__aexit__(kind, error, trace)

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Interrupt only what happens within."""
        self._is_waiting = True
        try:
            yield
        finally:
            self._is_waiting = False

    def block_came(self, block: Block) -> None:
        """Take note of a block."""
        now = self._loop.time()
        duration = block.n_samples / self._rates[block.sensor]
        self._whole.block_came(now, duration)
        self._each[block.sensor].block_came(now, duration)
        self._stalled.discard(block.sensor)

    def newly_stalled(self) -> list[str]:
        """Return the sensors that are overdue while others on the port go on, each once."""
        now = self._loop.time()
        late = [
            name
            for name, patience in self._each.items()
            if name not in self._stalled and now - patience.last > patience.seconds
        ]
        self._stalled.update(late)
        return late

    def _look(self) -> None:
        now = self._loop.time()
        held_up = now - self._last_look > 2 * self.TICK
        self._last_look = now
        if held_up or not self._is_waiting:
            for patience in (self._whole, *self._each.values()):
                patience.last = max(patience.last, now - patience.seconds / 2)
        elif now - self._whole.last > self._whole.seconds:
            self._timeout.reschedule(now)
            return
        self._timer = self._loop.call_later(self.TICK, self._look)


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
        self._delay = FIRST_DELAY
        self._said = ""
        self._clock = clock

    async def run(self, queue: asyncio.Queue[Item], go: asyncio.Event) -> None:
        """Connect once, wait for ``go``, then read until cancelled, reconnecting if need be."""
        reason = ""
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
                    try:
                        await self._forward(session, queue)
                    except Exception as error:
                        # At once: the driver may have a last word to a device that is gone.
                        reason = await self._say(error, queue)
                        raise
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
            # Said once, not at every attempt: a device may be away for weeks.
            if self.alive:
                reason = await self._say(failure, queue)
            elif _kind(failure) == "refused" and str(failure) != self._said:
                await self._say(failure, queue)
            await asyncio.sleep(self._delay)
            self._delay = min(2 * self._delay, LONGEST_DELAY)

    async def _say(self, failure: Exception, queue: asyncio.Queue[Item]) -> str:
        """Record that the device is lost, and why; return the kind of the event."""
        self.alive = False
        kind, self._said = _kind(failure), str(failure)
        for name in self.names:
            await queue.put(Event(name, kind, self._said, self._clock.now()))
        return kind

    async def _forward(self, session: Session, queue: asyncio.Queue[Item]) -> None:
        """Hand on what the session yields; raise if nothing comes for too long."""
        speed = self._clock.speed
        watch = _Watch({s.name: s.sampling_rate * speed for s in self.sensors})
        async with contextlib.aclosing(_generator(session)) as items:
            try:
                async with watch:
                    while True:
                        with watch.waiting():
                            item = await anext(items, None)
                        if item is None:
                            return
                        if isinstance(item, Block):
                            watch.block_came(item)
                            self._delay = FIRST_DELAY
                        await queue.put(item)
                        for name in watch.newly_stalled():
                            # One of several on a port: its driver looks after it; here it is said.
                            text = "others on the port go on"
                            await queue.put(Event(name, "stalled", text, self._clock.now()))
            except TimeoutError as error:
                if isinstance(error, DeviceError):
                    raise
                raise NoAnswerError(
                    f"{self.port}: stalled: no block for {watch.seconds:.2g} s"
                ) from error

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
