"""Güralp driver and simulated digitizer over serial lines, UDP and TCP."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator, Sequence
from fractions import Fraction
from typing import Any, cast

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.devices.guralp import scream
from daq.devices.guralp.gcf import SampleBlock, SystemId
from daq.devices.registry import driver_type
from daq.errors import BenchFileError, NoAnswerError, NotConnectedError, WrongDeviceError
from daq.protocols.block import Block, Event
from sim_devices.devices import guralp
from sim_devices.devices.interface import DeviceSpec, Source
from sim_devices.errors import ScenarioError
from sim_devices.server.launch import RunningDevice
from tests.daq.devices import reading
from tests.devices import device_at, host_clock, serving
from tests.sim_devices.simulated_bench import device, sensors, spec
from tests.tcp import served

pytestmark = pytest.mark.devices

SPEED = 8.0
RATE = 200.0
COUNTS = 1e7
DRIVER = driver_type("guralp")


def table(name: str, **changes: Any) -> dict[str, Any]:  # noqa: ANN401 -- whatever a table holds
    return device(name, "guralp", axes="ZNE", sensitivity=COUNTS, **changes)


TABLES = [
    table("A", settings={"system_id": "GURA", "width": 24}, serial_number="DEMO"),
    table("B", port="tcp", settings={"streams": ["B2Z", "B2N", "B2E"]}),
    table("C", port="tcp", settings={"link": "scream"}),
    table("D", port="udp", settings={"version": 31}),
]
SETTINGS: list[dict[str, Any]] = [{}, {"streams": ["B2Z", "B2N", "B2E"]}, {"link": "scream"}, {}]
SPEC = spec(*TABLES, speed=SPEED)


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[RunningDevice, ...]]:
    with serving(SPEC) as devices:
        yield devices


def sensor(running: tuple[RunningDevice, ...], index: int, **changes: Any) -> Sensor:  # noqa: ANN401
    settings = {**SETTINGS[index], **running[index].settings, **changes.pop("settings", {})}
    return sensors(running[index], TABLES[index], settings=settings, **changes)[0]


async def record(one: Sensor, n_samples: int) -> tuple[list[Block], list[Event]]:
    return await reading.record(DRIVER, one, n_samples, speed=SPEED)


async def test_streams_have_the_same_motion_at_their_stated_utc(
    running: tuple[RunningDevice, ...],
) -> None:
    """Two digitizers at once: the same instants of UTC hold the same motion."""
    found = await asyncio.gather(record(sensor(running, 0), 3000), record(sensor(running, 3), 3000))
    start = [blocks[0].device_counter or 0 for blocks, _ in found]
    counts = [np.concatenate([b.counts for b in blocks]) for blocks, _ in found]
    late = (start[1] - start[0]) // 5_000_000
    first, second = (counts[0], counts[1]) if late >= 0 else (counts[1], counts[0])
    n = min(len(first) - abs(late), len(second))
    assert n > 1000
    # a sample of either is the motion, its own noise (1e-5 m/s²) and rounding
    apart = (first[abs(late) :][:n] - second[:n]) / COUNTS
    assert apart.std() < 5e-5 < first.std() / COUNTS / 50


async def test_the_digitizers_information_is_reported(running: tuple[RunningDevice, ...]) -> None:
    one = sensor(running, 0, settings={"system_id": "GURA"}, serial_number="DEMO")
    async with DRIVER.open([one], host_clock(SPEED)) as session:
        (information,) = session.information
    assert information.serial_number == "DEMO"
    assert information.sampling_rate == RATE
    assert information.details == {"system ID": "GURA", "streams": "DEMOZ2, DEMON2, DEMOE2"}


@pytest.mark.parametrize(
    ("changes", "error", "said"),
    [
        ({"serial_number": "OTHR"}, WrongDeviceError, "expected serial number 'OTHR', got 'DEMO'"),
        ({"settings": {"system_id": "X"}}, WrongDeviceError, "expected system ID 'X', got 'GURA'"),
        ({"sampling_rate": 100.0}, WrongDeviceError, "expected 100 Hz, got 200 Hz"),
        (
            {"settings": {"streams": ["DEMOZ2"]}},
            BenchFileError,
            "for each of the sensor's 3 channels",
        ),
        (
            {"settings": {"streams": ["DEMOZ2", "DEMON2", "OTHER"], "patience": 1.0}},
            NoAnswerError,
            "streams OTHER of .A. not received within 1 s; received DEMOE2",
        ),
        (
            {"settings": {"patience": 1.0}, "channels": ({"name": "Z", "sensitivity": 1.0},)},
            NoAnswerError,
            "expected 1 streams of one digitizer, received DEMOE2, DEMON2, DEMOZ2",
        ),
    ],
)
async def test_wrong_settings_are_reported(
    running: tuple[RunningDevice, ...], changes: dict[str, Any], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        await record(sensor(running, 0, **changes), 1)


def test_a_rate_without_gcf_code_is_refused() -> None:
    device = DeviceSpec(("A",), "guralp", "pty", 301.0, {})
    with pytest.raises(ScenarioError, match=r"'A': sampling_rate = 301; GCF has 400, 500, .* 5000"):
        guralp.create(device, cast("Source", None))


async def test_an_absent_server_is_reported() -> None:
    gone = device_at("udp://127.0.0.1:9", "D", "guralp")
    with pytest.raises(NotConnectedError, match=r"'D' on udp://127.0.0.1:9: datagrams refused"):
        await record(sensors(gone, TABLES[3])[0], 1)


@contextlib.asynccontextmanager
async def sending(streams: Sequence[str], n_blocks: int) -> AsyncIterator[str]:
    """Yield the port of a Scream server that sends so many blocks of each stream, and no more."""
    ended = asyncio.Event()
    begin_ns = 1_700_000_000 * 10**9

    async def send(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        assert await reader.read(1) == scream.TCP_SEND
        for k in range(n_blocks * len(streams)):
            number = k // len(streams)
            counts = np.arange(200, dtype=np.int32) + 200 * number
            block = SampleBlock(
                SystemId("SIM"),
                streams[k % len(streams)],
                begin_ns + number * 10**9,
                Fraction(200),
                counts,
            )
            writer.write(scream.encode_packet(scream.Packet(k, "test", block)))
        await ended.wait()

    async with served(send) as number:
        yield f"socket://127.0.0.1:{number}"
        ended.set()


@pytest.mark.parametrize("named", [False, True])
async def test_blocks_received_during_discovery_are_not_lost(named: bool) -> None:
    streams = ["0123Z2", "0123N2", "0123E2"]  # a block tells 123Z2
    settings = {"link": "scream", "patience": 5.0} | ({"streams": streams} if named else {})
    async with sending(streams, 2) as port:
        one = device_at(port, "C", "guralp", **settings)
        changes = {"settings": settings, "serial_number": "0123"}
        async with reading.reading(DRIVER, sensors(one, TABLES[2], **changes)) as items:
            blocks: list[Block] = []
            while sum(block.n_samples for block in blocks) < 400:
                item = await anext(items)
                assert isinstance(item, Block), item
                blocks.append(item)
    counts = np.concatenate([block.counts for block in blocks])
    assert np.array_equal(counts, np.repeat(np.arange(400)[:, None], 3, axis=1))


@contextlib.asynccontextmanager
async def unreliable(target: int, n_refused: int) -> AsyncIterator[int]:
    """Yield a TCP port that closes the first connections and passes the others on."""
    left = n_refused

    async def pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            there, here = await asyncio.open_connection("127.0.0.1", target)
            with contextlib.suppress(ConnectionError):
                while asked := await reader.read(3):
                    here.write(asked)
                    writer.write(await there.read(1100))
            here.close()

    async with served(pass_on) as number:
        yield number


async def test_failed_recovery_is_repeated() -> None:
    """Packets are lost every second; the server's TCP port lets nobody in at first."""
    drops = [{"kind": "drop", "at": 5.5, "every": 0.9}]
    streams = {"streams": ["D000Z2", "D000N2", "D000E2"]}  # known: one link from the beginning
    served = table("D", port="udp", settings=streams)
    with serving(spec(served, speed=SPEED) | {"faults": drops}) as (one,):
        async with unreliable(one.settings["recovery_port"], 2) as port:
            (chosen,) = sensors(one, served, settings={**streams, "recovery_port": port})
            blocks: list[Block] = []
            said: list[str] = []
            async with (
                asyncio.timeout(20),
                reading.reading(DRIVER, [chosen], speed=SPEED) as items,
            ):
                async for item in items:
                    if isinstance(item, Block):
                        blocks.append(item)
                    elif isinstance(item, Event) and "over TCP" in item.text:
                        said.append(item.text)
                        recovered_from = len(blocks)
                    if len(said) == 3 and len(blocks) > recovered_from + 4:
                        break
    assert [text.partition(": ")[0] for text in said[:2]] == [
        "no recovery of lost packets over TCP, next in 5 s",
        "no recovery of lost packets over TCP, next in 10 s",
    ]
    assert said[2] == "lost packets are recovered over TCP again"
    assert not any(block.reason for block in blocks[recovered_from + 1 :])
