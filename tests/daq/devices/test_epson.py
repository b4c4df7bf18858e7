"""The Epson driver against a device that is as strict about timing as the manual."""

from __future__ import annotations

import asyncio
from typing import cast

import numpy as np
import pytest

from daq.devices.epson import commands
from daq.devices.epson.commands import CommandDecoder, Read, Write
from daq.devices.epson.driver import Configuration, Device, EpsonSession, EpsonSettings
from daq.devices.interface import DeviceInformation
from daq.errors import NoAnswerError
from daq.protocols.block import Block, HostTime
from daq.transport.byte_stream import ByteStream
from tests.devices import host_clock
from tests.sensors import sensor_at

pytestmark = pytest.mark.virtual_time

COMMAND_INTERVAL = 350e-6
"""M-A352AD10 data sheet, TWRITECYC and TREADCYC: from one command to the next, s."""
SENSOR = sensor_at("strict", "epson", rate=200.0, channels="x")


class StrictDevice:
    """Ignores every command that begins less than 350 µs after the one before."""

    label = "strict"

    def __init__(self) -> None:
        self.n_ignored = 0
        self._registers: dict[tuple[int, int], int] = {(0, commands.ID.address): commands.DEVICE_ID}
        self._window = 0
        self._last = -1.0
        self._decoder = CommandDecoder()
        self._replies: asyncio.Queue[bytes] = asyncio.Queue()

    async def write(self, payload: bytes) -> None:
        """Take what the driver sends at once; bytes of one write follow each other on the line."""
        now = asyncio.get_running_loop().time()
        for command in self._decoder.receive(payload):
            if now - self._last < COMMAND_INTERVAL:
                self.n_ignored += 1
                continue
            self._last = now
            self._do(command)

    def _do(self, command: Read | Write) -> None:
        if isinstance(command, Read):
            value = self._registers.get((self._window, command.address), 0)
            self._replies.put_nowait(commands.encode_reply(command.address, value))
        elif command.address == commands.WINDOW:
            self._window = command.value
        else:
            address = command.address & 0x7E
            old = self._registers.get((self._window, address), 0)
            high, low = command.value << 8 | old & 0xFF, old & 0xFF00 | command.value
            self._registers[self._window, address] = high if command.address & 1 else low

    async def read(self) -> tuple[bytes, HostTime]:
        """Return the next reply."""
        return await self._replies.get(), HostTime(0, 0)

    def discard(self) -> int:
        """Forget replies."""
        while not self._replies.empty():
            self._replies.get_nowait()
        return 0


async def test_window_and_command_are_separate_writes_with_the_required_interval() -> None:
    strict = StrictDevice()
    device = Device(SENSOR, cast("ByteStream", strict))
    assert await device.read(commands.ID) == commands.DEVICE_ID
    await device.configure(Configuration.of(SENSOR, EpsonSettings(**SENSOR.settings)))
    assert await device.sampling_rate() == 200.0
    assert strict.n_ignored == 0


class WarmingDevice(StrictDevice):
    """Warms through 34.987 °C, where the count passes 0: one count for each read of a half."""

    def __init__(self, first: int) -> None:
        super().__init__()
        self._count = first
        self._registers[1, commands.PROD_ID[0].address] = 0x3341

    def _do(self, command: Read | Write) -> None:
        high = commands.TEMP_HIGH.address
        if isinstance(command, Read) and self._window == 0 and command.address in {high, high + 2}:
            self._count += 1
            self._registers[0, high] = self._count >> 16 & 0xFFFF
            self._registers[0, high + 2] = self._count & 0xFFFF
        super()._do(command)


@pytest.mark.parametrize("first", [*range(-8, 3), 65535 - 2, 65535 - 1, 65535])
async def test_both_halves_of_the_temperature_are_of_one_moment(first: int) -> None:
    device = Device(SENSOR, cast("ByteStream", WarmingDevice(first)))
    temperature = (await device.information()).temperature
    if temperature is not None:  # None at 0, which is no measured value
        assert temperature == pytest.approx(commands.temperature(first), abs=0.05)


class Restarted:
    """A device that sends 57 frames, is restarted, and then answers questions only."""

    label = "restarted"

    def __init__(self, frames: bytes, size: int, n_lost: int) -> None:
        self._pieces = [frames[: 50 * size], frames[50 * size :]]
        self._n_lost = n_lost
        self._wanted = 0
        self._answer = asyncio.Event()

    def expect(self, n_frames: int, size: int = 1, *, n_pending: int = 0) -> None:
        """Note how many bytes are waited for; the kernel keeps fewer to itself."""
        self._wanted = n_frames * size - n_pending

    async def write(self, payload: bytes) -> None:
        """Hear a question; the line loses the first answers."""
        if payload == Read(commands.ID.address).encode():
            self._n_lost -= 1
            if self._n_lost < 0:
                self._answer.set()

    async def read(self) -> tuple[bytes, HostTime]:
        """Return frames if enough are there, then the answer."""
        await asyncio.sleep(0.1 if len(self._pieces) == 2 else 0.0)
        if self._pieces and len(self._pieces[0]) >= self._wanted:
            return self._pieces.pop(0), host_clock().now()
        await self._answer.wait()
        reply = commands.encode_reply(commands.ID.address, commands.DEVICE_ID)
        return reply, host_clock().now()

    def discard(self) -> int:
        """Forget nothing."""
        return 0


@pytest.mark.parametrize("n_lost", [0, 2])
async def test_frames_before_a_restart_have_their_arrival_time(
    n_lost: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seven of fifty wait in the kernel until the device is found to be silent."""
    monkeypatch.setattr("daq.devices.epson.driver.ASK_AFTER", 0.3)
    configuration = Configuration.of(SENSOR, EpsonSettings(**SENSOR.settings))
    zeros = np.zeros(57, np.int32)
    frames = commands.encode_bursts(configuration.burst, x=zeros, count=np.arange(57))
    stream = cast("ByteStream", Restarted(frames, configuration.burst.size, n_lost))
    decoder = configuration.decoder("A")
    device = Device(SENSOR, stream)
    session = EpsonSession(device, configuration, (DeviceInformation("A"),), decoder, host_clock())
    blocks: list[Block] = []

    async def read() -> None:
        async for item in session.read():
            assert isinstance(item, Block)
            blocks.append(item)

    with pytest.raises(NoAnswerError, match="was restarted"):
        await read()
    assert [block.n_samples for block in blocks] == [50, 7]
    passed = blocks[1].received.monotonic_ns - blocks[0].received.monotonic_ns
    assert passed == pytest.approx(7 / 200 * 1e9)
