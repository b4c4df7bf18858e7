"""One port kept connected: what is said, and when, also if it comes back under another name."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.devices.interface import DEFAULT_PATIENCE
from daq.errors import NoAnswerError, NotConnectedError
from daq.host_clock import HostClock, SystemClock
from daq.protocols.block import Block, Event
from daq.recorder.connection import (
    MAX_RETRY_DELAY,
    BackOff,
    Connected,
    Connection,
    Item,
    SensorLate,
    SensorLost,
)
from daq.transport.serial_ports import SerialPort
from tests.scripted_driver import (
    ManualClock,
    PlayedDevice,
    PlayedDriver,
    PlayedSession,
    bench,
    block,
    run,
)

pytestmark = pytest.mark.virtual_time


class SlowToLeave(PlayedDriver):
    """Leaves a device only when the test lets it."""

    def __init__(self, devices: dict[str, PlayedDevice]) -> None:
        super().__init__(devices)
        self.may_leave = asyncio.Event()

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[PlayedSession]:
        """Open a session; wait at its end."""
        async with super().open(sensors, clock) as session:
            try:
                yield session
            finally:
                await self.may_leave.wait()


def _kind(item: Item) -> list[str]:
    event = item.event if isinstance(item, SensorLate | SensorLost) else item
    return [event.kind] if isinstance(event, Event) else []


async def test_a_stall_is_reported_before_the_driver_closes_its_session() -> None:
    """A LabJack is told to stop its stream, and one that is gone takes 2 s not to answer."""
    device = PlayedDevice()
    driver = SlowToLeave({"A": device})
    connection = Connection(driver, bench("A").sensors, ManualClock())
    device.items.put_nowait(NoAnswerError("no samples"))
    kinds: list[str] = []
    async with run(connection) as queue, asyncio.timeout(60):
        while "stalled" not in kinds:
            item = await queue.get()
            kinds += _kind(item)
        driver.may_leave.set()
        device.opened.clear()
        await device.opened.wait()
        while kinds.count("connected") < 2:
            item = await queue.get()
            kinds += _kind(item)
    assert kinds == ["connected", "stalled", "connected"]


def test_only_a_session_as_long_as_the_delay_resets_the_delay() -> None:
    back_off = BackOff()
    assert [back_off.next_delay() for _ in range(6)] == [0.2, 0.4, 0.8, 1.6, 3.2, MAX_RETRY_DELAY]
    back_off.session_lasted(MAX_RETRY_DELAY - 0.1)
    assert back_off.next_delay() == MAX_RETRY_DELAY
    back_off.session_lasted(MAX_RETRY_DELAY)
    assert back_off.next_delay() == 0.2


async def test_delays_grow_for_a_device_that_connects_only_briefly() -> None:
    """One block is no success: it would be set up anew five times a second, for weeks."""
    device, clock = PlayedDevice(), ManualClock()
    driver = PlayedDriver({"A": device})
    connection = Connection(driver, bench("A").sensors, clock)
    loop, opened = asyncio.get_running_loop(), []
    async with run(connection), asyncio.timeout(20):
        for _ in range(4):
            await device.opened.wait()
            device.opened.clear()
            opened.append(loop.time())
            device.items.put_nowait(block("A", 0, 10, clock.now()))
            device.items.put_nowait(NoAnswerError("gone again"))
    assert np.diff(opened) == pytest.approx([0.2, 0.4, 0.8])


class Patient(PlayedDriver):
    """Its sessions state how long their device may be silent."""

    patience = 3.0

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[PlayedSession]:
        """Open a session."""
        async with super().open(sensors, clock) as session:
            session.patience = self.patience
            yield session


def driver_with(device: PlayedDevice, patience: float | None) -> PlayedDriver:
    if patience is None:
        return PlayedDriver({"A": device})
    driver = Patient({"A": device})
    driver.patience = patience
    return driver


async def kinds_of(
    driver: PlayedDriver, device: PlayedDevice, clock: ManualClock, pauses: Sequence[float]
) -> list[str]:
    """Return what is said of a device that sends a block after each pause, connected or not."""
    connection = Connection(driver, bench("A").sensors, clock)
    async with run(connection) as queue:
        await device.opened.wait()
        for n, pause in enumerate(pauses):
            await asyncio.sleep(pause)
            clock.advance(pause)
            device.items.put_nowait(block("A", 10 * n, 10, clock.now()))
        await asyncio.sleep(0.01)
    return [kind for item in iter_queue(queue) for kind in _kind(item)]


def iter_queue(queue: asyncio.Queue[Item]) -> list[Item]:
    return [queue.get_nowait() for _ in range(queue.qsize())]


@pytest.mark.parametrize("pause", [0.4, 1.0, 2.0, 2.9])
async def test_a_pause_within_the_patience_of_the_session_ends_nothing(pause: float) -> None:
    """A buffer of 3 s in the device: it pauses and loses nothing."""
    device = PlayedDevice()
    kinds = await kinds_of(driver_with(device, 3.0), device, ManualClock(), [0.1, pause, 0.1])
    assert kinds == ["connected", "late"]
    assert device.n_sessions == 1


async def test_a_loss_is_reported_after_the_patience_of_the_session() -> None:
    device = PlayedDevice()
    kinds = await kinds_of(driver_with(device, 3.0), device, ManualClock(), [0.1, 3.5])
    assert kinds == ["connected", "late", "stalled", "connected"]


async def test_a_session_without_patience_has_the_default() -> None:
    device = PlayedDevice()
    driver = driver_with(device, None)
    kinds = await kinds_of(driver, device, ManualClock(), [0.1, 0.9 * DEFAULT_PATIENCE, 0.1])
    assert kinds == ["connected", "late"]


@pytest.mark.parametrize("interval", [3.0, 4.0, 25.0])
async def test_an_infrequent_logger_is_not_reconnected_repeatedly(
    interval: float,
) -> None:
    """A tenth of a second comes at once, the next much later: its interval is learned."""
    device = PlayedDevice()
    pauses = [0.1, *[interval] * 40]
    kinds = await kinds_of(driver_with(device, 1.0), device, ManualClock(), pauses)
    assert kinds.count("stalled") <= 5
    n_first = len(kinds) - kinds[::-1].index("stalled")
    assert "stalled" not in kinds[n_first:]
    assert device.n_sessions == 1 + kinds.count("stalled")
    assert len(kinds[n_first:]) > 10  # late, and on time again: it goes on


async def test_learned_intervals_are_passed_to_the_next_session() -> None:
    device = PlayedDevice()
    driver = driver_with(device, 1.0)
    clock = ManualClock()
    connection = Connection(driver, bench("A").sensors, clock)
    async with run(connection):
        n_blocks = 0
        for pause in (0.1, 0.9, 0.9, 0.9):
            await asyncio.sleep(pause)
            device.items.put_nowait(block("A", 10 * n_blocks, 10, clock.now()))
            n_blocks += 1
        await asyncio.sleep(0.01)
        device.items.put_nowait(NotConnectedError("cable"))
        await asyncio.sleep(1.0)
        for pause in (0.1, 1.7, 0.1):  # twice the interval before, beyond what the session states
            await asyncio.sleep(pause)
            device.items.put_nowait(block("A", 10 * n_blocks, 10, clock.now()))
            n_blocks += 1
        await asyncio.sleep(0.01)
    assert device.n_sessions == 2


@pytest.mark.parametrize("counter", [None, 20])
async def test_a_suspended_computer_ends_the_session_of_a_device_that_does_not_count(
    counter: int | None,
) -> None:
    device = PlayedDevice()
    clock = ManualClock()
    driver = PlayedDriver({"A": device})
    connection = Connection(driver, bench("A").sensors, clock)
    clock.suspended = -0.2  # a busy computer was held up between its two clocks
    said: list[Event] = []
    n_blocks = 0
    async with run(connection) as queue, asyncio.timeout(60):
        device.items.put_nowait(block("A", 0, 5, clock.now()))
        while n_blocks < 1:
            n_blocks += isinstance(await queue.get(), Block)
        clock.suspended = 0.0
        device.items.put_nowait(block("A", 5, 5, clock.now(), device_counter=counter))
        while n_blocks < 2:
            n_blocks += isinstance(await queue.get(), Block)
        clock.advance(37.0)
        clock.suspended += 37.0
        for first in (10, 20):
            device.items.put_nowait(block("A", first, 10, clock.now(), device_counter=counter))
        while n_blocks < (3 if counter is None else 4):
            item = await queue.get()
            n_blocks += isinstance(item, Block)
            event = item.event if isinstance(item, SensorLate | SensorLost) else item
            if isinstance(event, Event) and event.kind != "connected":
                said.append(event)
    assert device.n_sessions == (2 if counter is None else 1)
    assert [event.kind for event in said] == ["stalled" if counter is None else "status"]
    assert "the computer was suspended for 37" in said[0].text


def test_host_time_continues_while_the_computer_is_suspended() -> None:
    awake_ns = asleep_ns = 0
    clock = SystemClock(2.0, monotonic_ns=lambda: awake_ns, always_ns=lambda: awake_ns + asleep_ns)
    before = clock.now()
    assert clock.suspended == 0
    awake_ns, asleep_ns = 10**9, 3_600_000_000_000
    after = clock.now()
    assert clock.suspended == pytest.approx(3600.0)
    assert after.monotonic_ns - before.monotonic_ns == 2 * (awake_ns + asleep_ns)
    assert after.utc_ns - before.utc_ns == after.monotonic_ns - before.monotonic_ns


# --- a serial device under another name ------------------------------------------------------


FTDI_1 = "0403:6001 FT1"
FTDI_2 = "0403:6001 FT2"


class Usb:
    """The ports of a computer, and what is behind them."""

    def __init__(self, **adapters: str) -> None:
        self.ports = {f"/dev/{name}": identity for name, identity in adapters.items()}
        self.driver = PlayedDriver()

    def find(self) -> list[SerialPort]:
        """Return the ports that are present."""
        return [SerialPort(path, identity) for path, identity in self.ports.items()]

    def plug(self, port: str, identity: str, device: PlayedDevice) -> None:
        """Plug an adapter with a device in."""
        self.ports[port] = identity
        self.driver.devices[port] = device

    def pull(self, port: str) -> PlayedDevice:
        """Pull an adapter out; return its device."""
        device = self.driver.devices[port]
        gone = PlayedDevice(failure=NotConnectedError("there is no such port"))
        self.driver.devices[port] = gone
        del self.ports[port]
        device.items.put_nowait(NotConnectedError("hang-up"))
        return device


async def until_connected(queue: asyncio.Queue[Item]) -> list[Item]:
    """Return what is said up to the next session and its first event."""
    items: list[Item] = []
    while not any(isinstance(item, Connected) for item in items):
        items.append(await queue.get())
    items.append(await queue.get())
    return items


def connection_of(usb: Usb, serial_number: str = "1") -> Connection:
    device = PlayedDevice(serial_number=serial_number)
    usb.plug("/dev/ttyUSB0", usb.ports.get("/dev/ttyUSB0", FTDI_1), device)
    sensors = bench("A", A="/dev/ttyUSB0").sensors
    return Connection(usb.driver, sensors, ManualClock(), find_ports=usb.find)


async def moved_to(usb: Usb, connection: Connection) -> list[Item]:
    async with run(connection) as queue:
        await until_connected(queue)
        device = usb.pull("/dev/ttyUSB0")
        device.items = asyncio.Queue()
        await asyncio.sleep(3.0)
        usb.plug("/dev/ttyUSB1", FTDI_1 if usb.ports.pop("same", "") else FTDI_2, device)
        async with asyncio.timeout(60):
            items = await until_connected(queue)
            device.items.put_nowait(block("A", 0, 10, ManualClock().now()))
            items.append(await queue.get())
    return items


def texts(items: list[Item]) -> list[str]:
    return [item.text for item in items if isinstance(item, Event)]


async def test_the_same_adapter_is_found_under_another_name() -> None:
    """Its sensor has no serial number: the adapter's identity is enough."""
    usb = Usb(ttyUSB0=FTDI_1)
    usb.ports["same"] = "yes"
    items = await moved_to(usb, connection_of(usb, serial_number=""))
    assert texts(items) == ["on /dev/ttyUSB1"]


async def test_another_adapter_is_accepted_if_the_serial_number_matches() -> None:
    usb = Usb(ttyUSB0=FTDI_1)
    items = await moved_to(usb, connection_of(usb))
    assert texts(items) == ["on /dev/ttyUSB1 1"]


@pytest.mark.parametrize("serial_number", ["2", ""])
async def test_another_device_on_a_new_port_is_refused(serial_number: str) -> None:
    usb = Usb(ttyUSB0=FTDI_1, ttyUSB5="0403:6001 FT5")
    stranger, other = PlayedDevice(serial_number=serial_number), PlayedDevice(serial_number="1")
    usb.driver.devices["/dev/ttyUSB5"] = other  # there before: another sensor may have it
    connection = connection_of(usb)
    async with run(connection) as queue:
        await until_connected(queue)
        device = usb.pull("/dev/ttyUSB0")
        usb.plug("/dev/ttyUSB3", FTDI_2, stranger)
        await asyncio.sleep(30.0)
        assert stranger.n_sessions > 0
        assert other.n_sessions == 0
        assert connection.information[0].serial_number == "1"
        said = [queue.get_nowait() for _ in range(queue.qsize())]
        assert not any(isinstance(item, Connected) for item in said)
        lost = [item.event.text for item in said if isinstance(item, SensorLost)]
        assert len(lost) == 2
        device.items = asyncio.Queue()
        usb.plug("/dev/ttyUSB0", FTDI_1, device)
        async with asyncio.timeout(60):
            items = await until_connected(queue)
        assert texts(items) == ["on /dev/ttyUSB0 1"]
