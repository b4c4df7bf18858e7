"""A serial device that comes back under another name, found by its adapter or its serial number."""

from __future__ import annotations

import asyncio

import pytest

from daq.errors import NotConnectedError
from daq.protocols.block import Event
from daq.recorder.connection import Connected, Connection, Item, SensorLost
from daq.transport.serial_ports import SerialPort
from tests.scripted_driver import ManualClock, PlayedDevice, PlayedDriver, bench, block, run

pytestmark = pytest.mark.virtual_time

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
