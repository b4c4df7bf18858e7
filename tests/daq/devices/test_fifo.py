"""Block FIFO driver and simulated unit over a pseudo-terminal and TCP."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.devices.interface import DeviceInformation
from daq.devices.modbus import rtu
from daq.devices.modbus.fifo import FifoSession, FifoSettings
from daq.devices.modbus.fifo_protocol import FifoDecoder
from daq.devices.registry import driver_type
from daq.errors import BenchFileError, NoAnswerError, WrongDeviceError
from daq.protocols.block import Block, BlockFlag, Event, HostTime
from daq.transport.byte_stream import ByteStream
from daq.transport.ports import open_port
from sim_devices.devices.fifo import create
from sim_devices.devices.interface import Source
from sim_devices.faults import LineFaults
from sim_devices.server.launch import RunningDevice
from sim_devices.server.serve import Served, WorldClock, device_spec
from sim_devices.world.world import World
from tests.daq.devices.reading import reading, record
from tests.devices import host_clock, paced_clock, serving
from tests.sim_devices.simulated_bench import device, scenario, sensors, spec

pytestmark = pytest.mark.devices

RATE = 2000.0
COUNTS = 100_000.0
DRIVER = driver_type("fifo")


def table(name: str, *, rate: float = RATE, **changes: Any) -> dict[str, Any]:  # noqa: ANN401 -- whatever a table holds
    return device(name, "fifo", sensitivity=COUNTS, sampling_rate=rate, **changes)


TABLE = table("A", settings={"capacity": 6000})


@pytest.fixture(scope="module")
def running() -> Iterator[RunningDevice]:
    with serving(spec(TABLE, sampling_rate=RATE)) as (one,):
        yield one


def sensor(running: RunningDevice, **changes: Any) -> Sensor:  # noqa: ANN401
    settings = {"capacity": 6000, **changes.pop("settings", {})}
    return sensors(running, TABLE, settings=settings, **changes)[0]


async def test_every_sample_is_received_at_the_factory_rate() -> None:
    """7812 Hz of three channels, 191 reads a second: counts are the world's, one after the other.

    The header is the level after a read, unlike that of the conformance suite.
    """
    rate, settings = 7812.0, {"capacity": 65_535, "header": "left", "unit": 7}
    one = table("A", rate=rate, settings=settings)
    world = spec(one, sampling_rate=rate, age=0.0)
    with serving(world) as (running,):
        patient = sensors(running, one, settings={**settings, "timeout": 2.0})[0]
        blocks, events = await record(DRIVER, patient, 4000)
    assert not events
    assert [b.first_sample for b in blocks] == [0, *(b.end_sample for b in blocks[:-1])]
    assert blocks[0].flags == BlockFlag.CLOCK_RESTART
    assert {b.flags for b in blocks[1:]} == {BlockFlag.NONE}
    counts = np.concatenate([b.counts for b in blocks])[:4000]
    assert counts.dtype == np.int16
    elapsed = round((blocks[0].received.monotonic_ns - world["epoch_ns"]) * 1e-9 * rate)
    first, truth = max(0, elapsed - 6000), World(scenario("A", sampling_rate=rate))
    felt = truth.samples("A", first, elapsed - first + 4200) * COUNTS
    start = int(np.abs(felt[:-4000] - counts[0]).max(axis=1).argmin())
    assert np.abs(felt[start : start + 4000] - counts).max() <= 0.5


async def test_replies_are_not_delayed(monkeypatch: pytest.MonkeyPatch) -> None:
    """However rarely a device sends what is due, and however long ago the computer was started."""
    monkeypatch.setattr("sim_devices.server.serve.MIN_INTERVAL", 1e9)
    described = device_spec(table("A"))
    (line,) = create(described, Source(scenario("A", sampling_rate=RATE), described))
    clock = WorldClock(paced_clock().now_ns(), monotonic_ns=paced_clock().now_ns)
    served = Served(line, clock, LineFaults((), "A", begin=0.0), lambda *_: None)
    try:
        await served.port.open()
        async with asyncio.timeout(10), open_port(served.port.address, host_clock()) as stream:
            for _ in range(3):
                await stream.write(rtu.read_request(1, 2, 1))
                assert (await stream.read())[0]
    finally:
        await served.close()


async def test_a_link_that_is_too_slow_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daq.devices.modbus.fifo.MAX_FILLING_TIME", 0.4)
    one = table("A", settings={"baud_rate": 115_200, "capacity": 6000})
    with serving(spec(one, sampling_rate=RATE)) as (running,):
        slow = sensors(running, one, settings={})[0]
        with pytest.raises(NoAnswerError, match=r"never empty, 58\d\d words left: the link is too"):
            await record(DRIVER, slow, 1)


async def test_a_lost_reply_is_not_reported_as_a_slow_link(monkeypatch: pytest.MonkeyPatch) -> None:
    """However much waits: a link is slow where that never lessens."""
    monkeypatch.setattr("daq.devices.modbus.fifo.MAX_FILLING_TIME", 0.4)

    class Backlog:
        label, level, asked = "backlog", 6000, 0

        def discard(self) -> None:
            pass

        async def write(self, request: bytes) -> None:
            n = int.from_bytes(request[4:6], "big") - 1
            self.asked += 1
            self.reply = rtu.encode_registers(1, 4, np.array([self.level] + [7] * n, np.uint16))
            self.level = max(0, self.level - n)

        async def read(self) -> tuple[bytes, HostTime]:
            await asyncio.sleep(10.0 if self.asked == 1 else 0.015)
            return self.reply, host_clock().now()

    settings = FifoSettings(timeout=0.1, poll_interval=1e-3)
    decoder = FifoDecoder("A", RATE, n_channels=3, header="size", unit=1, capacity=None)
    stream = cast("ByteStream", Backlog())
    session = FifoSession(
        stream,
        settings,
        decoder,
        information=(DeviceInformation("A"),),
        clock=host_clock(),
        patience=10.0,
    )
    items = []
    async with asyncio.timeout(30):
        async for item in session.read():
            items.append(item)
            if len(items) == 2:
                break
    assert isinstance(items[0], Event)
    assert isinstance(items[1], Block)


async def test_an_overflow_is_reported_and_its_gap_estimated(running: RunningDevice) -> None:
    """2000 samples fit; nobody reads for 2.5 s, 5000 samples."""
    blocks: list[Block] = []
    events: list[Event] = []
    has_idled = False
    async with reading(DRIVER, [sensor(running)]) as items:
        async for item in items:
            if isinstance(item, Event):
                events.append(item)
            if not isinstance(item, Block):
                continue
            blocks.append(item)
            if item.end_sample >= 400 and not has_idled:
                has_idled = True
                await asyncio.sleep(2.5)  # the test's own idleness is what is tested
            if item.end_sample >= 6000:
                break
    assert [e.kind for e in events] == ["overflow"]
    gap = next(b for b in blocks if b.reason)
    before = blocks[blocks.index(gap) - 1]
    assert gap.reason == "FIFO full"
    assert gap.flags == BlockFlag.MISSING_ESTIMATED
    assert gap.first_sample - before.end_sample > 300
    # by the host, all samples of the time are there or missing, to what the host may be late by:
    # without the gap 3000 would be missing
    elapsed = (blocks[-1].received.monotonic_ns - blocks[0].received.monotonic_ns) * 1e-9 * RATE
    assert blocks[-1].end_sample - blocks[0].end_sample == pytest.approx(elapsed, abs=2500)


@pytest.mark.parametrize(
    ("changes", "error", "said"),
    [
        ({"settings": {"unit": 9}}, NoAnswerError, "of unit 9: nothing received; check cable"),
        ({"sampling_rate": 20_001.0}, WrongDeviceError, "refused setting .*: illegal data value"),
        ({"sampling_rate": 0.5}, BenchFileError, "expected whole Hz"),
    ],
)
async def test_wrong_settings_are_reported(
    running: RunningDevice, changes: dict[str, Any], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        await record(DRIVER, sensor(running, **changes), 1)


async def test_two_sensors_do_not_share_a_line(running: RunningDevice) -> None:
    some = [sensor(running, name=name) for name in ("P", "Q")]
    with pytest.raises(BenchFileError, match="'P', 'Q'; reading one FIFO takes all of a line"):
        async with DRIVER.open(some, host_clock()):
            pass
