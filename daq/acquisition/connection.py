"""One port's device, kept connected for as long as a run lasts.

Connects, reads, and hands on; when a block is late says so (:mod:`daq.acquisition.stall_detector`),
when the device is lost or stalls says that, and tries again with back-off. What it hands on is
checked (:mod:`daq.acquisition.block_checks`), and in its sessions' own indices
(:mod:`daq.acquisition.sample_index` places it).
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from daq.acquisition.block_checks import BlockValidator
from daq.acquisition.device_identity import require
from daq.acquisition.stall_detector import StallDetector
from daq.drivers.interface import Resuming
from daq.errors import DeviceError, NoAnswerError, WrongDeviceError
from daq.protocols.block import Block, Event, EventKind

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Sequence
    from contextlib import AbstractAsyncContextManager

    from daq.acquisition.stall_detector import Stage
    from daq.bench.model import Sensor
    from daq.drivers.interface import DeviceInformation, DriverType, Session
    from daq.host_clock import HostClock

FIRST_DELAY, LONGEST_DELAY = 0.2, 5.0
LEAVE_TIMEOUT = 5.0
"""How long a driver may take to leave its device, s."""
LEAST_SUSPENDED = 0.5
"""How long a computer is suspended at least, s; a busy one may read its two clocks so far apart."""


@dataclass(frozen=True, slots=True)
class Connected:
    """A session began: blocks that follow are in its index."""

    sensors: tuple[str, ...]
    reason: str
    """Why the one before ended; empty for the first."""
    resumed: bool = False
    """The index of the session before goes on."""


@dataclass(frozen=True, slots=True)
class SensorLost:
    """A sensor is late or lost until its next block."""

    state: Literal["late", "lost"]
    event: Event
    """What there is to be recorded of it."""


Item = Block | Event | Connected | SensorLost


@dataclass(slots=True)
class BackOff:
    """How long to wait before a device is tried again: twice as long after each failure."""

    delay: float = FIRST_DELAY
    """Before the next attempt, s."""

    def failed(self) -> float:
        """Return how long to wait now, s."""
        delay, self.delay = self.delay, min(2 * self.delay, LONGEST_DELAY)
        return delay

    def lived(self, seconds: float) -> None:
        """Note how long a session has yielded blocks: one that comes and goes is no success."""
        if seconds >= self.delay:
            self.delay = FIRST_DELAY


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
        self._back_off = BackOff()
        self._said = ""
        self._before: Session | None = None
        self._clock = clock

    async def run(self, queue: asyncio.Queue[Item], go: asyncio.Event) -> None:
        """Connect once, wait for ``go``, then read until cancelled, reconnecting if need be."""
        reason = ""
        while True:
            try:
                async with self._in_time(self._open(), queue) as session:
                    self._check_identity(session)
                    if not self.connected.done():
                        self.connected.set_result(None)
                        await go.wait()
                    resumed = self._before is not None and getattr(session, "resumed", False)
                    await queue.put(Connected(self.names, reason, resumed))
                    for name in self.names:
                        await queue.put(self._introduced(session, name))
                    self.alive = True
                    self._before = session
                    try:
                        await self._forward(session, queue)
                    except Exception as error:
                        # At once: the driver may have a last word to a device that is gone.
                        reason = await self._say(error, queue)
                        raise
                failure: Exception = NoAnswerError(f"{self.port}: the device ended its session")
            # Whatever a driver raises concerns its device only: a fault of one must not end the
            # recording of the others. At the start it is reported, later recorded.
            except Exception as error:  # noqa: BLE001 -- a driver may be anybody's
                failure = error
            if not self.connected.done():
                self.connected.set_exception(failure)
                return
            # Said once, not at every attempt: a device may be away for weeks.
            if self.alive:
                reason = await self._say(failure, queue)
            elif _kind(failure) == "refused" and str(failure) != self._said:
                await self._say(failure, queue)
            await asyncio.sleep(self._back_off.failed())

    def _open(self) -> AbstractAsyncContextManager[Session]:
        if self._before is not None and isinstance(self.driver, Resuming):
            return self.driver.resume(self.sensors, self._clock, self._before)
        return self.driver.open(self.sensors, self._clock)

    @contextlib.asynccontextmanager
    async def _in_time(
        self, context: AbstractAsyncContextManager[Session], queue: asyncio.Queue[Item]
    ) -> AsyncIterator[Session]:
        """Open a session; leave it within ``LEAVE_TIMEOUT``, and say where that is not enough."""
        session = await context.__aenter__()
        try:
            yield session
        except BaseException as error:
            await self._leave(context, error, queue)
            raise
        await self._leave(context, None, queue)

    async def _leave(
        self,
        context: AbstractAsyncContextManager[Session],
        error: BaseException | None,
        queue: asyncio.Queue[Item],
    ) -> None:
        """Let the driver leave its device; why the session ended matters more than how."""
        limit = asyncio.timeout(LEAVE_TIMEOUT)
        try:
            async with limit:
                await context.__aexit__(
                    type(error) if error else None, error, error.__traceback__ if error else None
                )
        except asyncio.CancelledError:
            if not isinstance(error, asyncio.CancelledError):
                raise
        except Exception:
            if error is None and not limit.expired():
                raise
        if limit.expired():
            text = f"the driver did not leave the device within {LEAVE_TIMEOUT:g} s"
            for name in self.names:
                with contextlib.suppress(asyncio.QueueFull):
                    queue.put_nowait(Event(name, EventKind.STATUS, text, self._clock.now()))

    async def _say(self, failure: Exception, queue: asyncio.Queue[Item]) -> str:
        """Record that the device is lost, and why; return the kind of the event."""
        self.alive = False
        kind, self._said = _kind(failure), str(failure)
        for name in self.names:
            await queue.put(SensorLost("lost", Event(name, kind, self._said, self._clock.now())))
        return kind

    async def _forward(self, session: Session, queue: asyncio.Queue[Item]) -> None:
        """Hand on what the session yields; raise if nothing comes for too long."""

        def say(name: str, stage: Stage, seconds: float) -> bool:
            now = self._clock.now()
            text = f"no block for {seconds:.2g} s"
            event = Event(name, EventKind.LATE, f"{text}, two of its block periods", now)
            if stage == "lost":
                # One of several on a port: its driver looks after it; here it is said.
                event = Event(name, EventKind.STALLED, f"{text}; others on the port go on", now)
            try:
                queue.put_nowait(SensorLost(stage, event))
            except asyncio.QueueFull:
                return False
            return True

        speed, begun_ns = self._clock.speed, self._clock.now().monotonic_ns
        watch = StallDetector(
            {s.name: s.sampling_rate * speed for s in self.sensors},
            say,
            recovers=lambda: getattr(session, "recovers", False),
        )
        checked = BlockValidator(self.driver, self.sensors)
        suspended = self._clock.suspended
        async with contextlib.aclosing(_generator(session)) as items:
            try:
                async with watch:
                    while True:
                        with watch.waiting():
                            item = await anext(items, None)
                        if item is None:
                            return
                        item = checked.check(item)
                        if isinstance(item, Block):
                            if self._clock.suspended > suspended + LEAST_SUSPENDED:
                                suspended = await self._resume(item, suspended, queue)
                            watch.block_came(item)
                            lived_ns = item.received.monotonic_ns - begun_ns
                            self._back_off.lived(lived_ns * 1e-9 / speed)
                        await queue.put(item)
            except TimeoutError as error:
                if isinstance(error, DeviceError):
                    raise
                raise NoAnswerError(
                    f"{self.port}: stalled: no block for {watch.seconds:.2g} s"
                ) from error

    async def _resume(self, block: Block, before: float, queue: asyncio.Queue[Item]) -> float:
        """Say for how long the computer was suspended; raise if nobody counted what was missed."""
        now = self._clock.suspended
        text = f"the computer was suspended for {now - before:.3g} s"
        if block.device_counter is None and block.instants_ns is None:
            raise NoAnswerError(f"{self.port}: {text}")
        await queue.put(Event(block.sensor, EventKind.STATUS, text, self._clock.now()))
        return now

    def _check_identity(self, session: Session) -> None:
        """Refuse another device than the bench file names, or than was there before."""
        found = tuple(session.information)
        known = {information.sensor: information for information in self.information}
        for sensor in self.sensors:
            now = next((i for i in found if i.sensor == sensor.name), None)
            if now is None:
                continue
            if now.trouble and not known:
                raise NoAnswerError(now.trouble)
            before = known.get(sensor.name)
            require(sensor, now, serial_number=before.serial_number if before else "")
        self.information = self.information or found

    def _introduced(self, session: Session, name: str) -> Event | SensorLost:
        """Return who is there; one of several on a port may not be, and the others go on."""
        now = self._clock.now()
        found = next((i for i in session.information if i.sensor == name), None)
        if found is not None and found.trouble:
            return SensorLost("lost", Event(name, EventKind.STALLED, found.trouble, now))
        parts = (found.model, found.serial_number, found.firmware) if found else ()
        text = " ".join(("on", self.port, *(part for part in parts if part)))
        return Event(name, EventKind.CONNECTED, text, now)


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
