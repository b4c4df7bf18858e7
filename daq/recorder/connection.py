"""Keeps the device on one port connected until the run ends.

Connects, reads, and forwards the driver's items. Reports late and lost sensors. After a loss it
reconnects, with a delay that grows from attempt to attempt. Items keep the sample indices of their
session; :mod:`daq.recorder.sample_index` converts these to indices of the recording.

Items are validated, since drivers may come from any package, and a block that the file cannot hold
would end the whole recording. An invalid item ends only the session of its port, with an error that
names the fault.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.errors import DeviceError, NoAnswerError, NotConnectedError, WrongDeviceError
from daq.protocols.block import Block, DeviceItem, Event, EventKind, HostTime, Reading
from daq.recorder.device_identity import check_identity
from daq.recorder.stall_detector import OverdueState, StallDetector
from daq.recording.sensor_state import STATE_AFTER, SensorState
from daq.transport.serial_ports import SerialPort, serial_ports
from daq.transport.wire_log import session_ends

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Callable, Sequence
    from contextlib import AbstractAsyncContextManager

    from daq.bench.model import Sensor
    from daq.devices.interface import AnyDriver, DeviceInformation, Session
    from daq.host_clock import HostClock


_MIN_INT64, _MAX_INT64 = -(1 << 63), (1 << 63) - 1
_MAX_FLAGS = (1 << 31) - 1
_MAX_FIRST_SAMPLE = _MAX_INT64 // 4
_TIMES = "expected a HostTime with two integers of 64 bits"


class FaultyDriverError(DeviceError, TypeError):
    """A driver yielded something other than a valid block, event or reading of its sensors."""


class BlockValidator:
    """Validates the items of one session.

    Parameters
    ----------
    driver : AnyDriver
    sensors : sequence of Sensor
        All sensors on the port.
    """

    def __init__(self, driver: AnyDriver, sensors: Sequence[Sensor]) -> None:
        self._driver = driver.name
        self._port = sensors[0].port
        self._n_channels = {sensor.name: len(sensor.channels) for sensor in sensors}
        self._dtypes = {sensor.name: driver.counts_dtype(sensor) for sensor in sensors}
        self._polled: dict[str, bool] = {}

    def validated(self, item: object) -> DeviceItem:
        """Return the item if it is valid.

        Raises
        ------
        FaultyDriverError
            If it is not; the message has the yielded and the expected item.
        """
        if isinstance(item, Block):
            problem = self._block_problem(item)
        elif isinstance(item, Event):
            problem = self._event_problem(item)
        elif isinstance(item, Reading):
            problem = self._reading_problem(item)
        else:
            problem = f"{type(item).__name__}; expected a Block, an Event or a Reading"
        if not problem and isinstance(item, (Block, Event, Reading)):
            return item
        raise FaultyDriverError(f"{self._port}: driver {self._driver!r} yielded {problem}")

    def _block_problem(self, block: Block) -> str:
        if block.sensor not in self._n_channels:
            return f"a block of {block.sensor!r}; expected {self._expected_names()}"
        wanted = self._n_channels[block.sensor]
        shape = _shape(block.counts)
        if shape is None or len(shape) != 2 or shape[1] != wanted:
            return f"counts of shape {shape}; expected an array (n_samples, {wanted})"
        if not shape[0]:
            return "a block without samples"
        return (
            self._counts_problem(block) or _number_problem(block) or self._instants_problem(block)
        )

    def _counts_problem(self, block: Block) -> str:
        counts, expected = block.counts, self._dtypes[block.sensor]
        if np.can_cast(counts.dtype, expected, "safe"):
            return ""
        with np.errstate(invalid="ignore"):
            fits = counts.dtype.kind in "iuf" and np.array_equal(counts.astype(expected), counts)
        return "" if fits else f"counts of type {counts.dtype} that do not fit {expected}"

    def _instants_problem(self, block: Block) -> str:
        instants = block.instants_ns
        polled = self._polled.setdefault(block.sensor, instants is not None)
        if polled != (instants is not None):
            return "blocks with sample times and others without; expected one kind"
        if instants is None:
            return ""
        if _shape(instants) != (block.n_samples,) or instants.dtype != np.int64:
            return f"sample times of shape {_shape(instants)}; expected int64 ({block.n_samples},)"
        return ""

    def _event_problem(self, event: Event) -> str:
        if event.sensor and event.sensor not in self._n_channels:
            return f"an event of {event.sensor!r}; expected {self._expected_names()}"
        if not _are_texts(event.kind, event.text):
            return f"an event {event.kind!r}, {event.text!r}; expected text"
        return _time_problem("an event", event.received)

    def _reading_problem(self, reading: Reading) -> str:
        if reading.sensor not in self._n_channels:
            return f"a reading of {reading.sensor!r}; expected {self._expected_names()}"
        if not _are_texts(reading.quantity) or not _is_finite(reading.value):
            return f"a reading {reading.quantity!r}, {reading.value!r}; expected text and a number"
        return _time_problem("a reading", reading.received)

    def _expected_names(self) -> str:
        return " or ".join(map(repr, self._n_channels))


def _number_problem(block: Block) -> str:
    if not _is_int64(block.first_sample) or not 0 <= block.first_sample <= _MAX_FIRST_SAMPLE:
        return f"a block with first_sample {block.first_sample!r}; expected 0 or more"
    if block.device_counter is not None and not _is_int64(block.device_counter):
        return (
            f"a block with device_counter {block.device_counter!r}; expected an integer of 64 bits"
        )
    if not _is_int64(block.flags) or not 0 <= block.flags <= _MAX_FLAGS:
        return f"a block with flags {block.flags!r}; expected 0 to {_MAX_FLAGS}"
    if not _are_texts(block.reason):
        return f"a block with reason {block.reason!r}; expected text"
    return _time_problem("a block", block.received)


def _shape(array: object) -> tuple[int, ...] | None:
    return array.shape if isinstance(array, np.ndarray) else None


def _are_texts(*values: object) -> bool:
    return all(isinstance(value, str) for value in values)


def _time_problem(what: str, at: HostTime) -> str:
    is_time = all(_is_int64(getattr(at, name, None)) for name in ("monotonic_ns", "utc_ns"))
    return "" if is_time else f"{what} received at {at!r}; {_TIMES}"


def _is_finite(value: object) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and math.isfinite(value)


def _is_int64(value: Any) -> bool:  # noqa: ANN401 -- a driver may yield anything
    return isinstance(value, (int, np.integer)) and _MIN_INT64 <= int(value) <= _MAX_INT64


class PortPlaces:
    """Possible ports of the device on one port of the bench file.

    Parameters
    ----------
    home : str
        The port in the bench file.
    find_ports : callable
        Returns the serial ports that are present.
    """

    def __init__(self, home: str, find_ports: Callable[[], Sequence[SerialPort]]) -> None:
        self.home = home
        self._is_serial = "://" not in home
        self._find_ports = find_ports
        self._identity = ""
        self._present_before: frozenset[str] | None = None
        self._n_tried = 0

    def is_moved(self, port: str) -> bool:
        """Return whether a port differs from that of the bench file, by name and adapter."""
        if port == self.home:
            return False
        return not self._identity or self._identity not in {
            one.identity for one in self._find_ports() if one.path == port
        }

    def connected(self, port: str) -> None:
        """Store the port at which the device was found."""
        if not self._is_serial:
            return
        ports = self._find_ports()
        self._identity = next((one.identity for one in ports if one.path == port), self._identity)
        self._present_before = frozenset(one.path for one in ports)

    def next_place(self) -> str:
        """Return the port to try next."""
        if not self._is_serial or self._present_before is None:
            return self.home
        ports = self._find_ports()
        same = [one.path for one in ports if self._identity and one.identity == self._identity]
        if same:
            return self.home if self.home in same else same[0]
        new = [one.path for one in ports if one.path not in self._present_before]
        places = [self.home, *new]
        self._n_tried += 1
        return places[self._n_tried % len(places)]


FIRST_RETRY_DELAY, MAX_RETRY_DELAY = 0.2, 5.0
"""Delay in s before the next attempt: after the first failure, and at most."""
CLOSE_TIMEOUT = 5.0
"""Seconds that a driver may take to close its session."""
MIN_SUSPENSION = 0.5
"""Shortest detected suspension, s: on a busy computer, readings of two clocks differ by this."""


@dataclass(frozen=True, slots=True)
class Connected:
    """A session began: the blocks that follow have its sample indices."""

    sensors: tuple[str, ...]
    reason: str
    """Why the previous session ended; empty for the first."""
    resumed: bool = False
    """Whether the sample indices of the previous session continue."""


@dataclass(frozen=True, slots=True)
class SensorLate:
    """A sensor is late until its next block."""

    event: Event
    """To be recorded if the sensor is lost afterwards."""


@dataclass(frozen=True, slots=True)
class SensorLost:
    """A sensor is lost until its next block."""

    event: Event
    """To be recorded; its kind determines the sensor's state."""

    @property
    def state(self) -> SensorState:
        """Stalled, disconnected or refused."""
        return STATE_AFTER[self.event.kind]


Item = DeviceItem | Connected | SensorLate | SensorLost


@dataclass(slots=True)
class BackOff:
    """Delay before the next attempt to connect; doubles with each failure."""

    delay: float = FIRST_RETRY_DELAY
    """Seconds before the next attempt."""

    def next_delay(self) -> float:
        """Return the seconds to wait after a failure, and double them for the next one."""
        delay, self.delay = self.delay, min(2 * self.delay, MAX_RETRY_DELAY)
        return delay

    def session_lasted(self, seconds: float) -> None:
        """Reset the delay once a session has yielded blocks for as long as the delay is."""
        if seconds >= self.delay:
            self.delay = FIRST_RETRY_DELAY


class Connection:
    """One port with its driver and sensors.

    Parameters
    ----------
    anyway : bool
        Whether to begin though some sensors of the port do not answer.
    find_ports : callable
        Returns the serial ports that are present.
    """

    def __init__(
        self,
        driver: AnyDriver,
        sensors: Sequence[Sensor],
        clock: HostClock,
        *,
        anyway: bool = False,
        find_ports: Callable[[], Sequence[SerialPort]] = serial_ports,
    ) -> None:
        self.driver = driver
        self.sensors = tuple(sensors)
        self.port = self.sensors[0].port
        """Port of the bench file, until its adapter is found under another name."""
        self._places = PortPlaces(self.port, find_ports)
        self.names = tuple(sensor.name for sensor in self.sensors)
        self.information: tuple[DeviceInformation, ...] = ()
        """Information of the devices when they were first connected."""
        self.connected: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Done when the first session is open or could not be opened."""
        self._anyway = anyway
        self._is_connected = False
        self._back_off = BackOff()
        self._reported: tuple[EventKind | None, object] = None, None
        self._last_session: Session | None = None
        self._detector: StallDetector | None = None
        self._clock = clock
        self._queue: asyncio.Queue[Item]

    async def run(self, queue: asyncio.Queue[Item], start: asyncio.Event) -> None:
        """Connect, wait for ``start``, then read and reconnect until cancelled."""
        self._queue, reason = queue, ""
        while True:
            try:
                async with self._opened() as session:
                    self._check_identity(session)
                    self._places.connected(self.port)
                    if not self.connected.done():
                        self.connected.set_result(None)
                        await start.wait()
                    resumed = self._last_session is not None and session.resumed
                    await queue.put(Connected(self.names, reason, resumed))
                    for name in self.names:
                        await queue.put(self._first_item(session, name))
                    self._is_connected = True
                    self._last_session = session
                    try:
                        await self._forward(session)
                    except Exception as error:
                        # Before the driver closes its session, which can take seconds.
                        reason = await self._report_lost(error)
                        raise
                failure: Exception = NoAnswerError(f"{self.port}: the device ended its session")
            # Third-party drivers may raise anything. An error in one must not end the recording of
            # other devices: it is raised at the start of a run, and recorded later.
            except Exception as error:  # noqa: BLE001
                failure = error
            if not self.connected.done():
                self.connected.set_exception(failure)
                return
            # Failed attempts may continue for weeks: only another wrong device is recorded.
            if self._is_connected:
                reason = await self._report_lost(failure)
            elif isinstance(failure, WrongDeviceError) and _summary(failure) != self._reported:
                await self._report_lost(failure)
            await asyncio.sleep(self._back_off.next_delay())
            if isinstance(failure, (NotConnectedError, WrongDeviceError)):
                self._move_to(self._places.next_place())

    def _move_to(self, port: str) -> None:
        """Try the port under this name next."""
        if port != self.port:
            self.port = port
            self.sensors = tuple(s.model_copy(update={"port": port}) for s in self.sensors)

    @contextlib.asynccontextmanager
    async def _opened(self) -> AsyncIterator[Session]:
        """Open a session, and close it within ``CLOSE_TIMEOUT``."""
        if self._last_session is None:
            context = self.driver.open(self.sensors, self._clock)
        else:
            context = self.driver.resume(self.sensors, self._clock, self._last_session)
        session = await context.__aenter__()
        try:
            yield session
        except BaseException as error:
            await self._close(context, error)
            raise
        await self._close(context, None)

    async def _close(
        self, context: AbstractAsyncContextManager[Session], error: BaseException | None
    ) -> None:
        """Close a session that ended by ``error``; errors of closing must not replace that one."""
        limit = asyncio.timeout(CLOSE_TIMEOUT)
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
            text = f"the driver did not close its session within {CLOSE_TIMEOUT:g} s"
            for name in self.names:
                with contextlib.suppress(asyncio.QueueFull):
                    self._queue.put_nowait(Event(name, EventKind.STATUS, text, self._clock.now()))

    async def _report_lost(self, failure: Exception) -> EventKind:
        """Report all sensors of the port as lost; return the kind of the event."""
        self._is_connected = False
        kind, _ = self._reported = _summary(failure)
        for name in self.names:
            await self._queue.put(SensorLost(Event(name, kind, str(failure), self._clock.now())))
        return kind

    async def _forward(self, session: Session) -> None:
        """Forward the items of the session; raise NoAnswerError if it stalls."""

        def report(name: str, state: OverdueState, seconds: float) -> bool:
            now = self._clock.now()
            item: SensorLate | SensorLost
            if state is SensorState.LATE:
                text = f"no block for {seconds:.2g} s, two of its block periods"
                item = SensorLate(Event(name, EventKind.LATE, text, now))
            else:  # one of several on the port: its driver is responsible for reconnecting it
                text = f"no block for {seconds:.2g} s; other sensors on the port continue"
                item = SensorLost(Event(name, EventKind.STALLED, text, now))
            try:
                self._queue.put_nowait(item)
            except asyncio.QueueFull:
                return False
            return True

        speed, started_ns = self._clock.speed, self._clock.now().monotonic_ns
        detector = StallDetector(
            {s.name: s.sampling_rate * speed for s in self.sensors},
            report,
            patience=session.patience / speed,
            before=self._detector,
            is_recovering=lambda: session.recovers,
        )
        self._detector = detector
        validator = BlockValidator(self.driver, self.sensors)
        suspended = self._clock.suspended
        async with contextlib.aclosing(_generator(session)) as items:
            try:
                async with detector:
                    while True:
                        with detector.waiting():
                            item = await anext(items, None)
                        if item is None:
                            return
                        item = validator.validated(item)
                        if isinstance(item, Block):
                            if self._clock.suspended > suspended + MIN_SUSPENSION:
                                suspended = await self._after_suspension(item, suspended)
                            detector.block_received(item)
                            lasted_ns = item.received.monotonic_ns - started_ns
                            self._back_off.session_lasted(lasted_ns * 1e-9 / speed)
                        await self._queue.put(item)
            except TimeoutError as error:
                if isinstance(error, DeviceError):
                    raise
                hint = session.hint
                raise NoAnswerError(
                    f"{self.port}: stalled: no block for {detector.seconds:.2g} s"
                    f"{'; ' if hint else ''}{hint}"
                ) from error
            finally:
                session_ends()

    async def _after_suspension(self, block: Block, before: float) -> float:
        """Report a suspension of the computer; return the total time of suspension in s.

        Raises
        ------
        NoAnswerError
            If the device has neither counter nor sample times, so that the number of missing
            samples is unknown. A new session estimates it from the host's clock.
        """
        now = self._clock.suspended
        text = f"the computer was suspended for {now - before:.3g} s"
        if block.device_counter is None and block.instants_ns is None:
            raise NoAnswerError(f"{self.port}: {text}")
        await self._queue.put(Event(block.sensor, EventKind.STATUS, text, self._clock.now()))
        return now

    def _check_identity(self, session: Session) -> None:
        """Refuse a device that is not the one in the bench file or the one recorded before."""
        found = tuple(session.information)
        known = {information.sensor: information for information in self.information}
        for sensor in self.sensors:
            now = next((i for i in found if i.sensor == sensor.name), None)
            if now is None:
                continue
            if now.trouble and not known and not self._anyway:
                raise NoAnswerError(
                    f"{now.trouble}; --anyway records the other sensors of the port"
                )
            before = known.get(sensor.name)
            if self._places.is_moved(self.port) and not now.serial_number:
                raise WrongDeviceError(
                    f"sensor {sensor.name!r} on {self.port}: a device without a serial number; it"
                    f" may not be the device that was on {self._places.home}"
                )
            check_identity(sensor, now, serial_number=before.serial_number if before else "")
        self.information = self.information or found

    def _first_item(self, session: Session, name: str) -> Event | SensorLost:
        """Return the event of a connected sensor, or of one that does not reply while others do."""
        now = self._clock.now()
        found = next((i for i in session.information if i.sensor == name), None)
        if found is not None and found.trouble:
            return SensorLost(Event(name, EventKind.STALLED, found.trouble, now))
        parts = (found.model, found.serial_number, found.firmware) if found else ()
        text = " ".join(("on", self.port, *(part for part in parts if part)))
        return Event(name, EventKind.CONNECTED, text, now)


async def _generator(session: Session) -> AsyncGenerator[DeviceItem, None]:
    """Return the items of a session as a generator that can be closed."""
    items = session.read()
    try:
        async for item in items:
            yield item
    finally:
        close = getattr(items, "aclose", None)
        if close is not None:
            await close()


def _summary(failure: Exception) -> tuple[EventKind, object]:
    """Return the kind of event for a failure, and the identity of a wrong device."""
    if isinstance(failure, WrongDeviceError):
        return EventKind.REFUSED, failure.found
    kind = EventKind.STALLED if isinstance(failure, NoAnswerError) else EventKind.DISCONNECTED
    return kind, None
