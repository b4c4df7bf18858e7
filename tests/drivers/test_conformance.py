"""What every driver must do, swept over all of them and their simulated devices."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from daq.clock import SystemClock
from daq.drivers.registry import driver_names, driver_type
from daq.errors import DeviceError, NoAnswerError, NotConnectedError
from daq.protocols import epson
from daq.protocols.block import Block, BlockFlag, Event
from daq.protocols.errors import RemoteProtocolError
from sim_devices import launch
from tests.drivers.reading import reading
from tests.sim_devices.bench import device, sensors, spec

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from daq.bench import Sensor
    from sim_devices.launch import RunningDevice

SPEED = 4.0
RATE = 200.0
N = 150
XYZ = [{"name": axis, "sensitivity": 1e6} for axis in "xyz"]
CASES: dict[str, dict[str, Any]] = {
    "epson": {"sensitivity": epson.COUNTS_PER_UNIT, "settings": {}},
    "registers": {"sampling_rate": 20.0, "settings": {"address": 0, "timeout": 1.0}},
    "labjack": {"port": "tcp", "sensors": ["labjack 1", "labjack 2"], "settings": {}},
    "guralp": {"settings": {"patience": 2.0}},
    "fifo": {"settings": {}},
    "text": {"settings": {"columns": [0, 1, 2]}},
}
SCHEMES = {"registers": "modbus-tcp", "labjack": "modbus-tcp"}


def table(driver: str) -> dict[str, Any]:
    case = {"sensors": [f"{driver} 1"], "sampling_rate": RATE, **CASES[driver]}
    channels = [{**c, "sensitivity": case.pop("sensitivity", 1e6)} for c in XYZ[:1]]
    channels += [{**c, "sensitivity": channels[0]["sensitivity"]} for c in XYZ[1:]]
    return device("", driver, **case, channels=dict.fromkeys(case["sensors"], channels))


@pytest.fixture(scope="module")
def served() -> Iterator[dict[str, RunningDevice]]:
    tables = [table(driver) for driver in CASES]
    world = spec(*tables, speed=SPEED)
    for one in tables:
        for name in one["sensors"]:
            world["scenario"]["sensors"][name]["sampling_rate"] = one["sampling_rate"]
    with launch.start(world) as running:
        yield {one.driver: one for one in running}


def connecting(driver: str, one: RunningDevice, **changes: Any) -> list[Sensor]:  # noqa: ANN401
    settings = {**CASES[driver]["settings"], **one.settings}
    return sensors(one, table(driver), settings=settings, **changes)


def test_no_driver_is_left_out() -> None:
    assert set(CASES) == set(driver_names())


@pytest.mark.parametrize("driver", CASES)
async def test_blocks_are_in_order_and_whole(served: dict[str, RunningDevice], driver: str) -> None:
    kind = driver_type(driver)
    chosen = connecting(driver, served[driver])
    wanted = round(N * chosen[0].sampling_rate / RATE)
    by_name = {sensor.name: sensor for sensor in chosen}
    found: dict[str, list[Block]] = {name: [] for name in by_name}
    clock = SystemClock(SPEED)
    begin = clock.now()
    for _ in range(2):  # the port is free again after a session, and a session begins anew
        found = {name: [] for name in by_name}
        async with kind.open(chosen, clock) as session:
            assert [one.sensor for one in session.information] == list(by_name)
            async for item in session.read():
                if isinstance(item, Event):
                    assert item.kind in {"connected", "status"}, item
                    continue
                found[item.sensor].append(item)
                if all(blocks and blocks[-1].end_sample >= wanted for blocks in found.values()):
                    break
    for name, blocks in found.items():
        first = blocks[0]
        assert first.first_sample == 0
        assert BlockFlag.CLOCK_RESTART in first.flags
        assert not first.reason
        end, at = 0, begin.monotonic_ns
        for block in blocks:
            assert block.n_samples > 0
            assert block.counts.shape == (block.n_samples, len(by_name[name].channels))
            assert block.counts.dtype == kind.counts_dtype(by_name[name])
            if block.instants_ns is None:
                assert block.first_sample == end
            else:  # a busy host polls late: what it left out is said
                assert block.first_sample >= end
                assert bool(block.reason) == (block.first_sample > end)
            assert block.received.monotonic_ns >= at
            assert block.instants_ns is None or np.all(np.diff(block.instants_ns) > 0)
            end, at = block.end_sample, block.received.monotonic_ns
        assert np.concatenate([block.counts for block in blocks]).std(axis=0).min() > 0


@pytest.mark.parametrize("driver", CASES)
async def test_a_port_that_is_not_there_is_named(
    served: dict[str, RunningDevice], driver: str
) -> None:
    port = f"{SCHEMES.get(driver, 'socket')}://127.0.0.1:1"
    chosen = connecting(driver, served[driver], port=port)
    with pytest.raises(NotConnectedError) as caught:
        async with reading(driver_type(driver), chosen):
            pass
    assert port in str(caught.value)
    assert repr(chosen[0].name) in str(caught.value)


@contextlib.asynccontextmanager
async def stranger(garbage: bytes) -> AsyncIterator[int]:
    """Yield the number of a port where something listens that is no device."""
    tasks: list[asyncio.Task[None] | None] = []

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        tasks.append(asyncio.current_task())
        with contextlib.suppress(ConnectionError):
            writer.write(garbage)
            while await reader.read(4096):
                writer.write(garbage)
        writer.transport.abort()

    async with await asyncio.start_server(talk, "127.0.0.1", 0) as server:
        yield server.sockets[0].getsockname()[1]
    await asyncio.gather(*filter(None, tasks))


async def outcome(driver: str, chosen: list[Sensor]) -> tuple[Exception | None, int]:
    """Return how reading ends within a few seconds, and how many blocks came until then."""
    n_blocks = 0
    try:
        async with asyncio.timeout(4), reading(driver_type(driver), chosen, speed=SPEED) as items:
            async for item in items:
                n_blocks += isinstance(item, Block)
    except (DeviceError, RemoteProtocolError, TimeoutError) as error:
        return error, n_blocks
    return None, n_blocks


@pytest.mark.parametrize("garbage", [b"", bytes(range(256)) * 3], ids=["silence", "garbage"])
async def test_strangers_are_no_devices(served: dict[str, RunningDevice], garbage: bytes) -> None:
    async with stranger(garbage) as number:
        outcomes = await asyncio.gather(
            *(
                outcome(
                    driver,
                    connecting(
                        driver,
                        served[driver],
                        port=f"{SCHEMES.get(driver, 'socket')}://127.0.0.1:{number}",
                    ),
                )
                for driver in CASES
            )
        )
    for driver, (error, n_blocks) in zip(CASES, outcomes, strict=True):
        assert not n_blocks, driver
        assert isinstance(error, (DeviceError, RemoteProtocolError)), (driver, error)


@pytest.mark.parametrize("driver", CASES)
async def test_z_a_device_that_vanishes_ends_the_session(
    served: dict[str, RunningDevice], driver: str
) -> None:
    """Last in this file: it ends the devices."""
    chosen = connecting(driver, served[driver])
    error: Exception | None = None
    seen = 0
    try:
        async with (
            asyncio.timeout(15),
            reading(driver_type(driver), chosen, speed=SPEED) as items,
        ):
            async for item in items:
                seen += isinstance(item, Block)
                if seen:
                    served[driver].process.kill()
    except (NotConnectedError, NoAnswerError) as came:
        error = came
    assert seen
    assert error is not None
    assert repr(chosen[0].name) in str(error)
