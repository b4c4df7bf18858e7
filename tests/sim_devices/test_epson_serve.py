"""Driver and simulated accelerometer over a real wire."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.devices.registry import driver_type
from daq.errors import BenchFileError, NoAnswerError, WrongDeviceError
from daq.protocols.block import Block, Reading
from daq.transport.ports import open_port
from sim_devices.errors import ServeError
from sim_devices.server.launch import RunningDevice
from sim_devices.world.scenario import Scenario
from tests.devices import device_at, host_clock, serving
from tests.sim_devices.simulated_bench import AXES, device, sensors, spec
from tests.tcp import served

pytestmark = pytest.mark.devices

SPEED = 8.0
DRIVER = driver_type("epson")
TABLES = [device(name) for name in ("A", "B")]
TABLES.append(device("C", port="tcp", settings={"first_count": 65000}, serial_number="C0000007"))


SPEC = spec(*TABLES, speed=SPEED)


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[RunningDevice, ...]]:
    with serving(SPEC) as devices:
        yield devices


async def blocks(sensor: Sensor, n_samples: int) -> list[Block]:
    found: list[Block] = []
    async with DRIVER.open([sensor], host_clock(SPEED)) as session:
        async for item in session.read():
            if isinstance(item, Reading):  # of the temperature
                continue
            assert isinstance(item, Block), item
            found.append(item)
            if item.end_sample >= n_samples:
                break
    return found


async def test_a_device_is_left_idle_and_found_if_streaming(
    running: tuple[RunningDevice, ...],
) -> None:
    (sensor,) = sensors(running[0], TABLES[0])
    assert await blocks(sensor, 50)
    async with open_port(sensor.port, host_clock()) as stream:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0.05):  # what was on its way may still come
                await stream.read()
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.1):
                await stream.read()
        await stream.write(bytes.fromhex("FE000D 83010D"))  # streams when found
        await stream.read()
    assert await blocks(sensor, 50)


async def test_another_serial_number_is_refused(running: tuple[RunningDevice, ...]) -> None:
    (sensor,) = sensors(running[2], TABLES[2], serial_number="C0000008")
    with pytest.raises(WrongDeviceError, match=r"'C' on socket.*'C0000008', got 'C0000007'"):
        await blocks(sensor, 1)
    (sensor,) = sensors(running[2], TABLES[2], model="M-A370AD10")
    with pytest.raises(WrongDeviceError, match="expected model 'M-A370AD10', got 'A352AD10'"):
        await blocks(sensor, 1)


async def test_a_corrupted_serial_number_is_not_accepted(
    running: tuple[RunningDevice, ...],
) -> None:
    host, _, number = running[2].port.removeprefix("socket://").partition(":")
    changed = 0

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal changed
        from_device, to_device = await asyncio.open_connection(host, int(number))

        async def back() -> None:
            nonlocal changed
            while received := bytearray(await from_device.read(4096)):
                at = received.find(b"\x78\x30")  # the register that ends in a character 0
                if at >= 0 and not changed:
                    received[at + 1] ^= 0x04
                    changed += 1
                writer.write(received)

        returning = asyncio.create_task(back())
        with contextlib.suppress(ConnectionError):
            while received := await reader.read(4096):
                to_device.write(received)
        to_device.close()
        await returning

    async with served(relay) as own:
        (sensor,) = sensors(running[2], TABLES[2], port=f"socket://127.0.0.1:{own}")
        async with DRIVER.open([sensor], host_clock(SPEED)) as session:
            (information,) = session.information
    assert changed
    assert information.serial_number == "C0000007"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"sampling_rate": 128.0},
            "sampling_rate = 128.0: expected .* rates: 1000, 500, 200, 100, 50",
        ),
        (
            {"sampling_rate": 1000.0, "settings": {"baud_rate": 115200}},
            "at least 240000 for 1000 Hz",
        ),
        (
            {"settings": {"fields": ["x"]}},
            r'settings.fields = \["x"\]: .* each of the sensor.s 4 channels',
        ),
    ],
)
async def test_impossible_settings_are_refused(
    running: tuple[RunningDevice, ...], changes: dict[str, object], message: str
) -> None:
    (sensor,) = sensors(running[0], TABLES[0], **changes)
    with pytest.raises(BenchFileError, match=message):
        await blocks(sensor, 1)


async def test_other_rates_and_fields_are_recorded(running: tuple[RunningDevice, ...]) -> None:
    channels = TABLES[0]["channels"]["A"][:2]
    settings = {"fields": ["z", "x"], "filter": "K128_FC36", "flags": False}
    (sensor,) = sensors(
        running[0], TABLES[0], sampling_rate=500.0, settings=settings, channels=channels
    )
    found = await blocks(sensor, 200)
    assert all(block.counts.shape[1] == 2 for block in found)


async def test_silence_and_other_devices_are_distinguished() -> None:
    async def stranger(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while await reader.read(64):
            if talks:
                writer.write(b"login: ")

    talks = False
    async with served(stranger) as number:
        port = f"socket://127.0.0.1:{number}"
        table = device("A")
        quiet = device_at(port, "A", "epson")
        (sensor,) = sensors(quiet, table)
        with pytest.raises(NoAnswerError, match=r"'A' on socket://.* got nothing; check cable"):
            await blocks(sensor, 1)
        talks = True
        with pytest.raises(WrongDeviceError, match=r"not an Epson .* got 6c 6f 67 69 6e 3a 20"):
            await blocks(sensor, 1)


def test_a_spec_that_cannot_be_served_is_refused_with_its_cause() -> None:
    table = device("A")
    wrong = spec(table)
    wrong["scenario"]["motion"]["spectra"] = []
    with (
        pytest.raises(ServeError, match=r"did not start: .*spectra"),
        serving(wrong),
    ):
        pass


async def test_a_device_may_record_two_of_its_axes() -> None:
    table = device("A", channels={"A": list(AXES[:2])})
    described = spec(table, speed=SPEED)
    motion = {"spectra": [{"shape": "white", "level": 1e-6}] * 2}
    plane = {"motion": motion, "sensors": {"A": {}}, "longest_block": 4096}
    described["scenario"] = Scenario.from_dict(plane, sampling_rate=200.0).to_dict()
    with serving(described) as (one,):
        found = await blocks(sensors(one, table)[0], 200)
    counts = np.concatenate([block.counts for block in found])
    assert counts.shape[1] == 2
    assert (counts.std(axis=0) > 1000).all()
