"""The fault script against the links that recover, and the digitizer that counts what it lost."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from daq.devices.registry import driver_type
from daq.protocols.block import Block, BlockFlag, Event
from sim_devices.server.launch import RunningDevice
from tests.daq.devices.reading import reading, record
from tests.devices import serving
from tests.sim_devices.simulated_bench import device, sensors, spec

pytestmark = pytest.mark.devices

SPEED = 8.0
RATE = 200.0
AGE = 5.0


def table(name: str, driver: str, **changes: Any) -> dict[str, Any]:  # noqa: ANN401
    channels = [{"name": axis, "sensitivity": 3e5} for axis in "ZNE"]
    return device(name, driver, channels={name: channels}, **changes)


TABLES = [table("A", "guralp"), table("B", "guralp", port="udp"), table("L", "labjack", port="tcp")]
HURT = ("drop", "corrupt", "cut", "garbage", "duplicate", "merge", "checksum")
FAULTS: list[dict[str, Any]] = [
    {"kind": kind, "at": AGE + 3 + 2.3 * i, "every": 17.0, "sensors": ["A"]}
    for i, kind in enumerate(HURT)
]
FAULTS += [
    {"kind": kind, "at": AGE + 3 + 2.3 * i, "every": 7.0, "count": 2, "sensors": ["B"]}
    for i, kind in enumerate(("drop", "corrupt", "duplicate"))
]
# as soon as somebody reads: again and again
FAULTS += [{"kind": "overflow", "at": AGE, "every": 6.0, "duration": 1.5, "sensors": ["L"]}]
FAULTS += [{"kind": "drop", "at": AGE + 3, "every": 6.0, "count": 2, "sensors": ["L"]}]


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[RunningDevice, ...]]:
    with serving({**spec(*TABLES, speed=SPEED, age=AGE), "faults": FAULTS}) as devices:
        yield devices


@pytest.mark.parametrize("index", [0, 1])
async def test_a_link_that_recovers_loses_nothing(
    running: tuple[RunningDevice, ...], index: int
) -> None:
    """Frames over a serial line are refused and come again; packets over UDP are asked for."""
    (sensor,) = sensors(running[index], TABLES[index])
    blocks, events = await record(driver_type("guralp"), sensor, 25 * 200, speed=SPEED)
    hurt = [e for e in events if e.kind in {"checksum", "resynchronised"}]
    assert hurt, "the faults did strike"
    assert [b.first_sample for b in blocks] == [0, *(b.end_sample for b in blocks[:-1])]
    assert not any(b.reason for b in blocks)
    start_ns = blocks[0].device_counter or 0
    assert all((b.device_counter or 0) == start_ns + b.first_sample * 5_000_000 for b in blocks)
    assert np.isfinite(np.concatenate([b.counts for b in blocks]).std())


async def test_a_digitizer_counts_what_it_lost(
    running: tuple[RunningDevice, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Overflows of 1.5 s and lost packets, each gap by the device's own clock."""
    monkeypatch.setattr("daq.protocols.sample_counter.SLACK", SPEED)  # a second of a busy machine
    blocks: list[Block] = []
    events: list[Event] = []
    async with (
        asyncio.timeout(60),
        reading(driver_type("labjack"), sensors(running[2], TABLES[2]), speed=SPEED) as items,
    ):
        async for item in items:
            if isinstance(item, Event):
                events.append(item)
            if not isinstance(item, Block):
                continue
            blocks.append(item)
            # an overflow in which the stream began lies before its first block
            if {b.reason for b in blocks[1:]} >= {"buffer overflow", "lost packet"}:
                break
    assert {e.kind for e in events} == {"overflow", "resynchronised"}
    start = (blocks[0].device_counter or 0) - blocks[0].first_sample * 200_000  # it may begin full
    assert all((b.device_counter or 0) == start + b.first_sample * 200_000 for b in blocks)
    assert all(BlockFlag.MISSING_ESTIMATED not in b.flags for b in blocks)
    overflow = next(i for i, b in enumerate(blocks) if i and b.reason == "buffer overflow")
    missing = blocks[overflow].first_sample - blocks[overflow - 1].end_sample
    assert missing >= 1.5 * RATE - 1  # more where a lost packet falls together with it
    lost = next(i for i, b in enumerate(blocks) if i and b.reason == "lost packet")
    assert blocks[lost].first_sample - blocks[lost - 1].end_sample >= 20
