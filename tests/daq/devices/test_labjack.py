"""LabJack driver and simulated digitizer: three sensors on one, both stream modes."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.bench.model import Sensor
from daq.devices.labjack.driver import LabJackDriver
from daq.devices.labjack.registers import actual_scan_rate
from daq.devices.registry import driver_type
from daq.errors import (
    BenchFileError,
    DeviceError,
    NoAnswerError,
    NotConnectedError,
    WrongDeviceError,
)
from daq.protocols.block import Block, BlockFlag, Event, Reading
from sim_devices.server.launch import RunningDevice
from sim_devices.world.world import World
from tests.daq.devices.reading import reading, record_all
from tests.devices import host_clock, serving
from tests.sim_devices.simulated_bench import scenario, sensors, spec

pytestmark = pytest.mark.devices

SPEED = 4.0
RATE = 200.0
TICKS = 200_000
COUNTS = 3166.5 * 100
CENTER = 33523
DRIVER = driver_type("labjack")
NAMES = ("A", "B", "C")


def table(names: Sequence[str] = NAMES, **changes: Any) -> dict[str, Any]:  # noqa: ANN401
    channels = [{"name": axis, "sensitivity": COUNTS} for axis in "xyz"]
    return {
        "sensors": list(names),
        "driver": "labjack",
        "port": "tcp",
        "sampling_rate": RATE,
        "channels": dict.fromkeys(names, channels),
        **changes,
    }


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[RunningDevice, ...]]:
    tables = [
        table(serial_number="470001234"),
        table(["F"], settings={"ends_with": 2945, "ends_after": 400}),
        table(["T"], model="T8", sampling_rate=RATE),
    ]
    with serving(spec(*tables, speed=SPEED, sampling_rate=RATE)) as devices:
        yield devices


def bench(
    one: RunningDevice,
    *,
    own: dict[str, dict[str, Any]] | None = None,
    **changes: Any,  # noqa: ANN401
) -> list[Sensor]:
    settings = {**one.settings, **changes.pop("settings", {})}
    return [
        sensor.model_copy(update={"settings": {**settings, **(own or {}).get(sensor.name, {})}})
        for sensor in sensors(one, table(one.sensors), **changes)
    ]


async def record(some: list[Sensor], n_samples: int) -> tuple[dict[str, list[Block]], list[Event]]:
    return await record_all(DRIVER, some, n_samples, speed=SPEED)


def joined(blocks: list[Block]) -> NDArray[Any]:
    return np.concatenate([b.counts for b in blocks])


@pytest.mark.parametrize("mode", ["spontaneous", "command-response"])
async def test_the_core_timer_can_be_left_out(
    running: tuple[RunningDevice, ...], mode: str
) -> None:
    """The sensors have one index; what rows hold with the timer, the conformance suite says."""
    some = bench(running[0], settings={"mode": mode, "core_timer": False})
    found, events = await record(some, 400)
    assert not events
    starts = {tuple(block.first_sample for block in blocks[:3]) for blocks in found.values()}
    assert len(starts) == 1
    for blocks in found.values():
        assert [b.first_sample for b in blocks] == [0, *(b.end_sample for b in blocks[:-1])]
        assert {block.device_counter for block in blocks} == {None}


async def test_any_inputs_can_be_used(running: tuple[RunningDevice, ...]) -> None:
    """The simulated inputs are A's x, y, z on AIN0-2, B's on AIN3-5, C's on AIN6-8."""
    own: dict[str, dict[str, Any]] = {
        "A": {"inputs": ["AIN8", 0, "ain4"]},
        "B": {"inputs": [1, 2, 3]},
        "C": {"inputs": [5, 6, 7]},
    }
    found, _ = await record(bench(running[0], own=own), 600)
    straight, _ = await record(bench(running[0]), 600)
    mixed = np.hstack([joined(found[n])[:600] for n in NAMES]).std(axis=0)
    plain = np.hstack([joined(straight[n])[:600] for n in NAMES]).std(axis=0)
    assert mixed == pytest.approx(plain[[8, 0, 4, 1, 2, 3, 5, 6, 7]], rel=0.4)
    a = joined(found["A"]).astype(float)[:, 2] - CENTER
    b = joined(found["B"]).astype(float)[:, 0] - CENTER  # AIN4 and AIN1: both y
    assert np.corrcoef(a, b)[0, 1] > 0.999


@pytest.mark.parametrize("mode", ["spontaneous", "command-response"])
async def test_the_temperature_is_read_while_the_device_streams(
    running: tuple[RunningDevice, ...], mode: str
) -> None:
    some = bench(running[0], settings={"mode": mode})
    readings: list[Reading] = []
    async with reading(DRIVER, some, speed=SPEED) as items:
        async for item in items:
            readings += [item] if isinstance(item, Reading) else []
            if len(readings) >= 2 * len(NAMES):
                break
    assert [each.sensor for each in readings] == [*NAMES, *NAMES]
    times = [each.received.monotonic_ns // 60_000_000_000 for each in readings]
    assert times[-1] == times[0] + 1
    assert all(abs(each.value - 25.0) <= 0.5 for each in readings)


async def test_the_devices_information_is_reported(running: tuple[RunningDevice, ...]) -> None:
    some = bench(running[0], sampling_rate=333.0, serial_number="470001234")
    async with DRIVER.open(some, host_clock(SPEED)) as session:
        information = session.information
    assert [i.sensor for i in information] == list(NAMES)
    assert information[0].model == "LabJack T7"
    assert information[0].serial_number == "470001234"
    assert information[0].firmware == "1.0292"
    assert information[0].temperature == pytest.approx(25.0, abs=0.6)
    assert information[0].sampling_rate == pytest.approx(actual_scan_rate(333.0), rel=1e-12)
    assert information[1].details == {
        "inputs": "AIN3, AIN4, AIN5",
        "range": "±10 V",
        "counts per volt": "3166.5029",
        "counts per volt, negative": "3166.5029",
        "counts at 0 V": "33523",
    }


async def test_a_t8_has_its_own_ranges_calibration_and_rate(
    running: tuple[RunningDevice, ...],
) -> None:
    """Its rate is told after the start only; each of its inputs has a calibration of its own."""
    own: dict[str, Any] = {"settings": {"range": 4.8, "inputs": ["AIN0", "AIN1", "AIN7"]}}
    some = bench(running[2], sampling_rate=333.0, **own)
    async with DRIVER.open(some, host_clock(SPEED)) as session:
        (information,) = session.information
    assert information.model == "LabJack T8"
    assert information.sampling_rate == pytest.approx(40e6 / 120_120, rel=1e-7)
    details = information.details
    assert details["range"] == "±4.8 V"
    counts_per_volt = [float(details[f"counts per volt of AIN{n}"]) for n in (0, 1, 7)]
    nominal = 32768 / 4.884
    np.testing.assert_allclose(
        counts_per_volt, [nominal, nominal / 1.0001, nominal / 1.0007], rtol=1e-6
    )


async def test_a_t8_streams(running: tuple[RunningDevice, ...]) -> None:
    found, events = await record(bench(running[2]), 400)
    assert not events
    blocks = found["T"]
    assert [b.first_sample for b in blocks] == [0, *(b.end_sample for b in blocks[:-1])]
    world = World(scenario([*NAMES, "F", "T"], sampling_rate=RATE))
    truth = world.samples("T", 0, 400_000) * COUNTS
    counts = joined(blocks).astype(float) - CENTER
    start = int(np.abs(truth - counts[0]).max(axis=1).argmin())
    assert np.abs(truth[start : start + len(counts)] - counts).max() <= 0.5


@pytest.mark.parametrize(
    ("index", "settings", "said"),
    [
        (2, {"range": 10.0}, "range = 10.0: expected one of 11, 9.6, 4.8, 2.4"),
        (0, {"range": 9.6}, "range = 9.6: expected one of 10, 1, 0.1, 0.01 V for a T7"),
        (2, {"inputs": [0, 1, 8]}, "a T8 has AIN0 to AIN7"),
        (2, {"negative_inputs": [3, 4, 5]}, "its own negative terminal"),
    ],
)
async def test_settings_that_the_product_lacks_are_refused(
    running: tuple[RunningDevice, ...], index: int, settings: dict[str, Any], said: str
) -> None:
    own = {NAMES[0] if index == 0 else "T": settings}
    with pytest.raises(WrongDeviceError, match=said):
        async with DRIVER.open(bench(running[index], own=own), host_clock(SPEED)):
            pass


def test_a_bench_file_with_the_product_is_checked_without_the_device(
    running: tuple[RunningDevice, ...],
) -> None:
    some = bench(running[2], settings={"range": 10.0}, model="LabJack T8")
    with pytest.raises(BenchFileError, match=r'sensors\["T"\].settings.range = 10.0: expected one'):
        LabJackDriver().check(some)


async def test_a_stream_that_ends_is_restarted(running: tuple[RunningDevice, ...]) -> None:
    found, events = await record(bench(running[1]), 1200)
    blocks = found["F"]
    assert [e.text for e in events] == ["the buffer is full (2945)"]
    again = next(b for b in blocks if b.reason)
    assert again.flags == BlockFlag.CLOCK_RESTART
    assert again.reason == "the buffer is full"
    before = blocks[blocks.index(again) - 1]
    assert before.end_sample == 400
    ticks = (again.device_counter or 0) - (before.device_counter or 0)
    assert again.first_sample - before.first_sample == pytest.approx(ticks / TICKS, abs=0.5)


async def test_a_buffer_that_overflows_is_a_gap_of_exact_length(
    running: tuple[RunningDevice, ...],
) -> None:
    """Nobody reads for a while: 4096 bytes hold 186 scans of eleven."""
    some = bench(running[0], settings={"mode": "command-response", "buffer_bytes": 4096})
    blocks: list[Block] = []
    events: list[Event] = []
    async with reading(DRIVER, some, speed=SPEED) as items:
        async for item in items:
            if isinstance(item, Event):
                events.append(item)
            elif isinstance(item, Block) and item.sensor == "A":
                blocks.append(item)
                if len(blocks) == 5:
                    await asyncio.sleep(0.8)  # the test's own idleness is what is tested
                if len(blocks) > 5 and any(b.reason for b in blocks) and len(events) >= 2:
                    break
    gap = next(b for b in blocks if b.reason)
    before = blocks[blocks.index(gap) - 1]
    assert gap.reason == "buffer overflow"
    assert gap.flags == BlockFlag.NONE
    assert gap.first_sample - before.end_sample > 100
    elapsed = (gap.device_counter or 0) - (blocks[0].device_counter or 0)
    assert elapsed == gap.first_sample * TICKS
    assert "2940" in events[0].text
    assert "2941" in events[1].text


async def test_a_power_failure_is_detected_by_the_missing_stream() -> None:
    settings = {"mode": "command-response"}
    told = spec(table(["R"], settings=settings), speed=SPEED, sampling_rate=RATE)
    told["faults"] = [{"kind": "reset", "at": 6.0, "every": 1.0}]
    said = "reading the stream: .*exception 4.*, reason 2620"
    with serving(told) as (one,), pytest.raises(DeviceError, match=said):
        await record(bench(one, settings=settings), 10**6)


@pytest.mark.parametrize(
    ("changes", "own", "error", "said"),
    [
        (
            {"serial_number": "1"},
            {},
            WrongDeviceError,
            "expected serial number '1', got '470001234'",
        ),
        ({}, {"B": {"inputs": [1, 2]}}, BenchFileError, "one for each of the sensor's 3 channels"),
        (
            {},
            {"B": {"inputs": [0, 4, 5]}},
            BenchFileError,
            "AIN0 is already an input of sensor 'A'",
        ),
        ({"settings": {"stream_port": 1}}, {}, NotConnectedError, "connection refused"),
        ({"sampling_rate": 20_000.0}, {}, DeviceError, "the stream keeps ending: scan overlap"),
        (
            {"settings": {"trigger_index": 1 << 31}},
            {},
            NoAnswerError,
            "expected samples from socket",
        ),
    ],
)
async def test_impossible_settings_are_refused(
    running: tuple[RunningDevice, ...],
    changes: dict[str, Any],
    own: dict[str, dict[str, Any]],
    error: type[Exception],
    said: str,
) -> None:
    with pytest.raises(error, match=said):
        await record(bench(running[0], own=own, **changes), 10**6)
