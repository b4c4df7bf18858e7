"""Register poller and simulated slaves over real wires."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.devices.modbus import rtu
from daq.devices.modbus.bus import open_bus
from daq.devices.registry import driver_type
from daq.errors import BenchFileError, NoAnswerError, NotConnectedError, WrongDeviceError
from daq.host_clock import SystemClock
from daq.protocols.block import Block, BlockFlag, Event
from sim_devices.server.launch import RunningDevice
from tests.devices import device_at, host_clock, serving
from tests.sim_devices.simulated_bench import device, sensors, spec
from tests.tcp import served

pytestmark = pytest.mark.devices

SPEED = 4.0
DRIVER = driver_type("registers")
G = 32768 / 16 / 9.80665
CHANNELS = [{"name": axis, "sensitivity": G * 1000} for axis in "xyz"]
VOLTS = [{"name": f"AIN{k}", "sensitivity": 1.0} for k in range(3)]
ON_BUS: dict[str, dict[str, Any]] = {
    "A": {"preset": "witmotion"},
    "B": {"preset": "witmotion", "device_id": 0x51},
}
TABLES: list[dict[str, Any]] = [
    {
        "sensors": ["A", "B"],
        "driver": "registers",
        "port": "pty",
        "sampling_rate": 50.0,
        "sensor_settings": ON_BUS,
        "channels": {"A": CHANNELS, "B": CHANNELS},
    },
    device(
        "C",
        "registers",
        port="tcp",
        sampling_rate=50.0,
        settings={"preset": "labjack-ain"},
        channels={"C": VOLTS},
    ),
]


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[RunningDevice, ...]]:
    with serving(spec(*TABLES, speed=SPEED, sampling_rate=50.0)) as devices:
        yield devices


def on_bus(running: RunningDevice, **more: object) -> list[Sensor]:
    both = sensors(running, TABLES[0])
    return [s.model_copy(update={"settings": {**ON_BUS[s.name], **more}}) for s in both]


async def read(
    chosen: Sequence[Sensor], n_samples: int, clock: SystemClock
) -> dict[str, list[Block]]:
    """Read until every sensor has so many samples."""
    found: dict[str, list[Block]] = {sensor.name: [] for sensor in chosen}
    async with DRIVER.open(chosen, clock) as session:
        async for item in session.read():
            assert isinstance(item, Block), item
            found[item.sensor].append(item)
            if all(blocks and blocks[-1].end_sample >= n_samples for blocks in found.values()):
                break
    return found


async def test_two_slaves_on_one_bus_are_recorded_at_their_instants(
    running: tuple[RunningDevice, ...],
) -> None:
    found = await read(on_bus(running[0]), 150, host_clock(SPEED))
    for blocks in found.values():
        assert blocks[0].flags == BlockFlag.CLOCK_RESTART
        instants = np.concatenate([b.instants_ns for b in blocks if b.instants_ns is not None])
        # readings of one clock of 50 Hz, told in ms: the polls' jitter is not in them, but for
        # the least latency still being found
        steps = np.diff(instants) / 1e6
        off_grid = np.abs(steps - 20.0 * np.rint(steps / 20.0))
        assert np.quantile(off_grid, 0.9) <= 1.001
        counts = np.concatenate([b.counts for b in blocks])
        assert counts.dtype == np.int16
        assert counts.std() > 1
    assert len({tuple(b[0].counts[0]) for b in found.values()}) == 2  # not the same slave twice


async def test_registers_with_gaps_are_read_separately() -> None:
    """A device refuses a request for registers it does not have."""
    settings = {
        "addresses": [10, 20, 300],
        "data_type": "float64",
        "time_address": 0,
        "time_format": "uint32-us",
    }
    table = device("H", "registers", port="tcp", channels={"H": VOLTS}, settings=settings)
    with serving(spec(table, speed=SPEED)) as (one,):
        (sensor,) = sensors(one, table, settings=settings, sampling_rate=50.0)
        found = await read([sensor], 40, host_clock(SPEED))
        counts = np.concatenate([block.counts for block in found["H"]])
        assert counts.shape[1] == 3
        assert 1e-3 < counts.std(axis=0).min() <= counts.std(axis=0).max() < 1.0
        (whole,) = sensors(one, table, settings={"address": 0, "data_type": "float64"})
        with pytest.raises(
            WrongDeviceError, match=r"registers 0 to 11 .*of .*illegal data address"
        ):
            await read([whole], 1, host_clock(SPEED))


async def test_an_absent_device_is_named_in_the_error(running: tuple[RunningDevice, ...]) -> None:
    absent = [
        s.model_copy(update={"settings": {"preset": "witmotion", "device_id": n, "timeout": 0.05}})
        for n, s in enumerate(on_bus(running[0]), start=7)
    ]
    said = r"'A': expected registers 48 to 54 \(0x0030 to 0x0036\) of device 7; .*'A'"
    with pytest.raises(NoAnswerError, match=said):
        await read(absent, 1, host_clock(SPEED))
    other = sensors(running[1], TABLES[1], settings={"address": 900})
    with pytest.raises(WrongDeviceError, match=r"900 to 902.*exception 2 \(illegal data address\)"):
        await read(other, 1, host_clock(SPEED))
    nowhere = sensors(running[1], TABLES[1], port="modbus-tcp://127.0.0.1:1")
    nowhere = [s.model_copy(update={"settings": {"address": 0}}) for s in nowhere]
    with pytest.raises(NotConnectedError, match=r"'C' on modbus-tcp://.*: connection refused"):
        await read(nowhere, 1, host_clock(SPEED))
    with pytest.raises(BenchFileError, match=r'sensors\["C"\]\.settings\.address: is missing'):
        await read(sensors(running[1], TABLES[1], settings={}), 1, host_clock(SPEED))


async def test_a_slave_that_was_off_is_configured_again(tmp_path: Path) -> None:
    """The other on the bus is polled on; who comes back is set to its rate again."""
    off = {"kind": "silent", "sensors": ["B"], "at": 29.0, "every": 40.0, "duration": 8.0}
    log = tmp_path / "sent"
    world = spec(TABLES[0], speed=SPEED, sampling_rate=50.0)
    with serving(world | {"faults": [off], "sent_log": str(log)}) as (one,):
        clock = host_clock(SPEED)
        blocks: dict[str, list[Block]] = {"A": [], "B": []}
        events: list[Event] = []
        back_at = 0
        async with asyncio.timeout(60), DRIVER.open(on_bus(one, timeout=2.0), clock) as session:
            n_set = _n_set(log)
            async for item in session.read():
                if isinstance(item, Block):
                    blocks[item.sensor].append(item)
                    if back_at and len(blocks["B"]) > back_at + 5:
                        break
                    continue
                # The other may miss a poll of a busy host.
                if isinstance(item, Event) and item.sensor == "B":
                    events.append(item)
                    if item.kind == "connected":
                        back_at = len(blocks["B"])
    lost = [event for event in events if event.kind == "stalled"]
    n_lost = len(lost)
    assert n_lost >= 3
    said = re.search(r"no answer in (\S+) s to device 81, function 3", lost[0].text)
    assert said
    assert float(said[1]) < 1.0, "no longer than its replies may take: the others wait"
    assert f"({n_lost} so far)" in lost[-1].text
    assert "answers again, after" in next(e.text for e in events if e.kind == "connected")
    gap = blocks["B"][back_at]
    assert 7.0 * 50 < gap.first_sample - blocks["B"][back_at - 1].end_sample < 24.0 * 50
    # the other was polled on meanwhile; how often, a busy host says
    meanwhile = [
        block.n_samples
        for block in blocks["A"]
        if block.received.monotonic_ns < gap.received.monotonic_ns
        and block.received.monotonic_ns > blocks["B"][back_at - 1].received.monotonic_ns
    ]
    assert sum(meanwhile) >= 20
    assert _n_set(log) > n_set, "its rate is set again"


def _n_set(log: Path) -> int:
    """Return how often the second slave has had its rate set."""
    sent = [json.loads(line).get("unit", "") for line in log.read_text().splitlines()]
    return sum(unit.startswith("51060003") for unit in sent)


async def test_a_cancellation_is_not_lost_to_a_reply_that_comes_with_it(
    running: tuple[RunningDevice, ...],
) -> None:
    async with open_bus(running[1].port, host_clock(), label="bus", reply_timeout=1.0) as bus:
        loop = asyncio.get_running_loop()
        reading = asyncio.create_task(bus.read(4, 1, 0, 2))

        def cancel_with_the_reply() -> None:
            link: Any = bus._link  # noqa: SLF001 -- the very turn the reply comes in
            if link._client.ctx.response_future.done():  # noqa: SLF001
                reading.cancel()
            else:
                loop.call_soon(cancel_with_the_reply)

        await asyncio.sleep(0)
        cancel_with_the_reply()
        with pytest.raises(asyncio.CancelledError):
            await reading


async def test_a_bus_is_opened_again_without_a_silent_slave(
    running: tuple[RunningDevice, ...],
) -> None:
    both = on_bus(running[0], timeout=1.0)
    settings = {**both[1].settings, "device_id": 9}
    both[1] = both[1].model_copy(update={"settings": settings})
    async with DRIVER.open(both, host_clock(SPEED)) as session:
        there, absent = session.information
        assert not there.trouble
        assert "registers 48 to 54 (0x0030 to 0x0036) of device 9" in absent.trouble
        first = await anext(session.read())
    assert isinstance(first, Block)
    assert first.sensor == "A"


async def test_replies_of_other_units_and_short_ones_are_counted() -> None:
    """A slave that answers in turn as it should, as another unit, too shortly, and not at all."""

    async def slave(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        n = 0
        while len(await reader.read(64)) >= 8:
            values = np.arange(1 if n % 5 == 3 else 3, dtype=np.uint16) + n
            answers = [
                rtu.encode_registers(7 if n % 5 == 2 else 1, 3, values),
                rtu.encode_exception(1, 3, 4),
                rtu.encode(1, bytes([3, 255]) + bytes(9)),
            ]
            writer.write(answers[{4: 1, 5: 2}.get(n % 6, 0)])
            n += 1

    async with served(slave) as number:
        port = f"socket://127.0.0.1:{number}"
        table = device("A", "registers", sampling_rate=20.0, channels={"A": CHANNELS})
        here = device_at(port, "A", "registers")
        (sensor,) = sensors(here, table, settings={"address": 0, "timeout": 0.1})
        events: list[str] = []
        async with DRIVER.open([sensor], host_clock()) as session:
            async for item in session.read():
                if isinstance(item, Event):
                    events.append(f"{item.kind}: {item.text}")
                if len(events) >= 30:
                    break
    for said in (
        "stalled: .*; received a reply of unit 7, expected unit 1 (1 so far)",
        "checksum: .*; received 14 bytes that are no reply (",
        "resynchronised: received a reply with 1 registers, a number not requested (2 so far)",
        "refused: .* Modbus exception 4 (device failure) .*(2 so far)",
    ):
        pattern = re.escape(said).replace(r"\.\*", ".*")
        assert any(re.match(pattern, event) for event in events), (said, events)
