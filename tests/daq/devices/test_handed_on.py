"""What has arrived is handed on, whatever fails after its arrival."""

from __future__ import annotations

import asyncio
import contextlib
import os
import tty
from collections.abc import Iterator

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.conformance.suite import CuttingClock
from daq.devices.guralp.brp import encode_frame
from daq.devices.labjack.registers import Adu, AduFinder, encode_adu
from daq.devices.modbus.rtu import RequestFinder, encode_registers
from daq.devices.registry import driver_type
from daq.devices.seedlink.packets import Packet, PacketFinder, encode_packet
from daq.errors import NotConnectedError
from daq.host_clock import HostClock, SystemClock
from daq.protocols.block import Block
from daq.protocols.errors import RemoteProtocolError
from tests.daq.devices.guralp.sample_blocks import RATE, expected, raw_blocks
from tests.sensors import sensor_at
from tests.waiting import limit


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)  # while the slave is open, the master is no hang-up
    os.close(slave)
    with contextlib.suppress(OSError):
        os.close(master)


async def test_a_line_that_hangs_up_before_the_reply_loses_no_block(
    terminal: tuple[int, str],
) -> None:
    """Güralp on a serial line: the acknowledgement cannot be sent, the block was received."""
    master, port = terminal
    settings = {"streams": ["DEMOZ2", "DEMON2", "DEMOE2"]}
    sensor = sensor_at(port, "guralp", rate=RATE, channels="ZNE", settings=settings)
    frames = [encode_frame(n, block) for n, block in enumerate(raw_blocks(3))]
    clock = CuttingClock(SystemClock(), lambda: os.close(master))
    found, loop = list[Block](), asyncio.get_running_loop()
    async with asyncio.timeout(limit(20)):
        task = asyncio.create_task(_opened(sensor, clock, found))
        await asyncio.sleep(0)  # opening the port flushes it
        for frame in frames[:6]:
            os.write(master, frame)
            acknowledged = asyncio.Event()
            loop.add_reader(master, acknowledged.set)
            await acknowledged.wait()
            os.read(master, 4096)
        loop.remove_reader(master)
        clock.arm()
        os.write(master, b"".join(frames[6:]))
        with pytest.raises(NotConnectedError):
            await task
    assert np.array_equal(np.concatenate([b.counts for b in found]), expected(0, 3 * RATE))


async def _opened(sensor: Sensor, clock: HostClock, found: list[Block]) -> None:
    async with driver_type(sensor.driver).open([sensor], clock) as session:
        async for item in session.read():
            found.extend([item] if isinstance(item, Block) else [])


class _Slave:
    """Answers reads on a terminal with rows of a counter, and hangs up after some."""

    def __init__(self, master: int, n_replies: int, *, header: bool) -> None:
        self._master, self._left, self._header = master, n_replies, header
        self._finder = RequestFinder(1)
        self.sent: list[int] = []

    def readable(self) -> None:
        for request in self._finder.receive(os.read(self._master, 4096)):
            if not self._left:
                asyncio.get_running_loop().remove_reader(self._master)
                os.close(self._master)
                return
            self._left -= 1
            n_words = request.value - self._header
            words = np.arange(len(self.sent), len(self.sent) + n_words)
            self.sent += words.tolist()
            level = 600 if self._left < 6 else 0  # emptied once, then never again
            head = [level] if self._header else []
            registers = np.concatenate([head, words]).astype(np.uint16)
            os.write(self._master, encode_registers(1, request.function, registers))


@pytest.mark.parametrize("driver", ["registers", "fifo"])
async def test_readings_collected_when_the_line_hangs_up_are_handed_on(
    terminal: tuple[int, str], driver: str
) -> None:
    """Rows are collected to blocks; those of an incomplete block were read nevertheless."""
    master, port = terminal
    settings: dict[str, object] = {"address": 0} if driver == "registers" else {"set_rate": False}
    sensor = sensor_at(port, driver, rate=20.0, settings=settings | {"baud_rate": 115200})
    slave = _Slave(master, 8, header=driver == "fifo")
    asyncio.get_running_loop().add_reader(master, slave.readable)
    found = list[Block]()
    async with asyncio.timeout(limit(20)):
        with pytest.raises(NotConnectedError):
            await _opened(sensor, SystemClock(), found)
    rows = np.concatenate([b.counts for b in found])
    last = np.array(slave.sent[-3:])
    assert np.array_equal(rows[-1], last)
    assert len(found) > 1 or driver == "fifo"


def test_packets_before_garbage_are_returned_first() -> None:
    """Of SeedLink, and of the LabJack's registers."""
    packet = encode_packet(Packet(1, b"x" * 512), 3)
    finder = PacketFinder(3)
    assert len(finder.receive(packet + b"no packet")) == 1
    with pytest.raises(RemoteProtocolError):
        finder.receive(b"")
    adus = AduFinder()
    message = encode_adu(Adu(1, 1, b"\x04\x00"))
    assert len(adus.receive(message + b"no message of Modbus")) == 1
    with pytest.raises(RemoteProtocolError):
        adus.receive(b"")
