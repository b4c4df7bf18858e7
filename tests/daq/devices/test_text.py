"""Text driver and simulated devices: rows over a pseudo-terminal and TCP, packets over UDP."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.devices.registry import driver_type
from daq.devices.text.driver import TextDriver
from daq.errors import BenchFileError, NoAnswerError
from daq.protocols.block import Block, BlockFlag, Event, EventKind
from daq.transport.address import host_and_port
from sim_devices.server.launch import RunningDevice
from sim_devices.world.world import World
from tests.daq.devices import reading
from tests.devices import serving
from tests.sensors import sensor_at
from tests.sim_devices.simulated_bench import device, scenario, sensors, spec

pytestmark = pytest.mark.devices

SPEED = 4.0
RATE = 100.0
COUNTS = 1e6
DRIVER = driver_type("text")
LILY = {"preset": "lily", "start": "*9900XYC2\r\n", "stop": "*9900XYC-OFF\r\n"}
OWN = {
    "delimiter": ";",
    "prefix": "$",
    "tag": "ACC",
    "columns": [2, 3, 4],
    "counter_column": 1,
    "counter_modulus": 256,
    "nmea_checksum": True,
    "whole": True,
}
SETTINGS: list[dict[str, Any]] = [{"preset": "raspberry-shake"}, OWN, LILY, {"time_column": 3}]
PORTS = ["udp", "pty", "pty", "tcp"]
RATES = [RATE, RATE, 1.0, RATE]


def table(index: int) -> dict[str, Any]:
    name, names = "ABCD"[index], "XY" if index == 2 else ("EHZ", "EHN", "EHE")
    return device(
        name,
        "text",
        axes=names,
        sensitivity=COUNTS,
        port=PORTS[index],
        sampling_rate=RATES[index],
        settings=SETTINGS[index],
    )


TABLES = [table(i) for i in range(4)]


def specification() -> dict[str, Any]:
    """Sensor C is a tiltmeter: it has two channels, and one sample a second."""
    made = spec(*TABLES, speed=SPEED, sampling_rate=RATE)
    two = {"directions": [[1, 0, 0], [0, 1, 0]], "sampling_rate": 1.0}
    made["scenario"]["sensors"]["C"] |= two
    made["scenario"]["motion"]["bandwidth"] = 40.0
    return made


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[RunningDevice, ...]]:
    with serving(specification()) as devices:
        yield devices


def sensor(running: tuple[RunningDevice, ...], index: int, **changes: Any) -> Sensor:  # noqa: ANN401
    settings = {**SETTINGS[index], **changes.pop("settings", {})}
    return sensors(running[index], TABLES[index], settings=settings, **changes)[0]


async def record(one: Sensor, n_samples: int) -> tuple[list[Block], list[Event]]:
    return await reading.record(DRIVER, one, n_samples, speed=SPEED)


async def test_a_stray_byte_does_not_take_the_port() -> None:
    """The first packet comes from another host, and is none of the device's."""
    one, packet = own_port(), b"{'EHZ', 1582315130.292, 7, 8}"
    where = host_and_port(one.port)
    async with reading.reading(DRIVER, [one], speed=SPEED) as items:
        with hosts("127.0.0.2", "127.0.0.3") as (stranger, device):
            stranger.sendto(b"x", where)
            device.sendto(packet, where)
            unreadable, block = await anext(items), await anext(items)
            stranger.sendto(packet.replace(b"7", b"9"), where)
            device.sendto(packet.replace(b"292", b"492"), where)
            found = [await anext(items), await anext(items)]
    assert isinstance(unreadable, Event)
    assert unreadable.kind is EventKind.CHECKSUM
    assert isinstance(block, Block)
    assert block.counts[:, 0].tolist() == [7, 8]
    (said,) = [item.text for item in found if isinstance(item, Event)]
    assert said == "datagrams from 127.0.0.2 are ignored: another device sends to this port"
    (second,) = [item for item in found if isinstance(item, Block)]
    assert second.counts[:, 0].tolist() == [7, 8]


async def test_only_the_stated_host_is_read() -> None:
    one = own_port(**{"from": "127.0.0.3"})
    where = host_and_port(one.port)
    async with reading.reading(DRIVER, [one], speed=SPEED) as items:
        with hosts("127.0.0.2", "127.0.0.3") as (stranger, device):
            stranger.sendto(b"{'EHZ', 1582315130.292, 9, 9}", where)
            device.sendto(b"{'EHZ', 1582315130.292, 7, 8}", where)
            found = [await anext(items), await anext(items)]
    (block,) = [item for item in found if isinstance(item, Block)]
    assert block.counts[:, 0].tolist() == [7, 8]


def test_a_wrong_host_is_a_fault_of_the_file() -> None:
    with pytest.raises(ValueError, match="expected an IP address"):
        DRIVER.settings.model_validate({"from": "shake.local"})
    one = own_port(**{"from": "127.0.0.3"}).model_copy(update={"port": "/dev/ttyUSB0"})
    with pytest.raises(BenchFileError, match="is for ports udp://"):
        TextDriver().check([one])


def own_port(**settings: object) -> Sensor:
    """Return a sensor on a free port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    port, own = f"udp://0.0.0.0:{number}", {"preset": "raspberry-shake", **settings}
    return sensor_at(port, "text", "S", rate=10.0, channels=["EHZ"], settings=own)


@contextlib.contextmanager
def hosts(*addresses: str) -> Iterator[list[socket.socket]]:
    """Return sockets with these addresses of this computer."""
    with contextlib.ExitStack() as opened:
        found = []
        for address in addresses:
            found.append(opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
            try:
                found[-1].bind((address, 0))
            except OSError:
                pytest.skip("this system has one loopback address only")
        yield found


async def test_a_device_is_started_and_stopped_by_its_commands(
    running: tuple[RunningDevice, ...],
) -> None:
    with pytest.raises(NoAnswerError, match="nothing for 5 s; check cable"):
        await record(sensor(running, 2, settings={"start": "", "patience": 0.5}), 2)
    assert (await record(sensor(running, 2), 2))[0]


FAULTS = [
    {"kind": "duplicate", "at": 6.0, "every": 0.7, "count": 2},
    {"kind": "drop", "at": 6.3, "every": 1.1, "count": 3},
    {"kind": "late", "at": 7.5, "every": 2.5, "duration": 0.6},
]


async def test_repeated_lost_and_late_rows_leave_every_sample_at_its_index() -> None:
    """Packets, counted rows, rows with a time: the motion says which sample is which."""
    chosen = (0, 1, 3)
    world = spec(*(TABLES[i] for i in chosen), speed=SPEED, sampling_rate=RATE)
    with serving(world | {"faults": FAULTS}) as running:
        ones = [
            sensors(device, TABLES[i], settings=SETTINGS[i])[0]
            for i, device in zip(chosen, running, strict=True)
        ]
        found = await asyncio.gather(*(record(one, 600) for one in ones))
    same_world = World(scenario([one.name for one in ones], sampling_rate=RATE))
    for one, (blocks, events) in zip(ones, found, strict=True):
        truth = same_world.samples(one.name, 0, 6000) * COUNTS
        start = int(np.abs(truth - blocks[0].counts[0]).max(axis=1).argmin())
        for block in blocks:
            expected = truth[start + block.first_sample :][: block.n_samples]
            assert np.abs(expected - block.counts).max() <= 0.5, (one.name, block.first_sample)
        estimated = [each for each in blocks if each.flags & BlockFlag.MISSING_ESTIMATED]
        # Three rows are less than what arrivals differ by, until such steps are frequent.
        assert len(estimated) <= (2 if one.name == "D" else 0)
        reasons = {block.reason for block in blocks}
        assert reasons == {"", "counter" if one.name == "B" else "time step"}
        assert {event.kind for event in events} == {"status"}
        assert "repeated" in events[-1].text
