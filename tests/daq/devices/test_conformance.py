"""What every driver must do, swept over all of them and their simulated devices."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncGenerator, Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.conformance.replay import replay
from daq.conformance.suite import (
    EARLY,
    LATENCY,
    check_blocks,
    check_counters,
    check_truth,
    stranger,
    watching_the_loop,
)
from daq.devices.registry import driver_names, driver_type
from daq.errors import DeviceError, NoAnswerError, NotConnectedError
from daq.protocols.block import Block, DeviceItem, Event
from daq.protocols.errors import RemoteProtocolError
from daq.transport.wire_log import WireLog, session_ends, using
from tests.daq.devices.driver_modes import CASES, RATE, Served, serving_all
from tests.daq.devices.reading import reading
from tests.devices import host_clock
from tests.waiting import limit

pytestmark = pytest.mark.devices

SPEED = 4.0
N = 150
NOT_REPLAYED = ("registers tcp",)
"""pymodbus has ports of its own."""


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with serving_all(speed=SPEED) as devices:
        yield devices


def test_no_driver_is_left_out() -> None:
    tested_elsewhere = {"epson-can", "nidaqmx", "sound"}  # have no simulated device to serve
    assert {case["driver"] for case in CASES.values()} | tested_elsewhere == set(driver_names())


@pytest.mark.parametrize("mode", CASES)
async def test_blocks_are_in_order_and_whole(served: Served, mode: str) -> None:
    kind = driver_type(CASES[mode]["driver"])
    chosen = served.sensors(mode)
    wanted = round(N * chosen[0].sampling_rate / RATE)
    by_name = {sensor.name: sensor for sensor in chosen}
    found: list[DeviceItem] = []
    clock = host_clock(SPEED)
    begin = clock.now()
    for _ in range(2):  # the port is free again after a session, and a session begins anew
        found, ends = [], dict.fromkeys(by_name, 0)
        async with kind.open(chosen, clock) as session:
            assert [one.sensor for one in session.information] == list(by_name)
            assert not any(one.trouble for one in session.information)
            stream = cast("AsyncGenerator[DeviceItem]", session.read())
            async with contextlib.aclosing(stream) as items:
                async for item in items:
                    found.append(item)
                    if isinstance(item, Block):
                        ends[item.sensor] = item.end_sample
                    if min(ends.values()) >= wanted:
                        break
    check_blocks(kind, chosen, found)
    check_counters(chosen, found)
    for name, sensor in by_name.items():
        blocks = [item for item in found if isinstance(item, Block) and item.sensor == name]
        assert blocks[0].received.monotonic_ns >= begin.monotonic_ns
        counts = np.concatenate([block.counts for block in blocks])
        assert counts.std(axis=0).min() > 0
        index = np.concatenate([np.arange(b.first_sample, b.end_sample) for b in blocks])
        if CASES[mode]["driver"] == "registers":
            which = served.assert_felt(mode, name, index, counts)
            instants = np.concatenate([b.instants_ns for b in blocks if b.instants_ns is not None])
            late = instants * 1e-9 - served.sent(mode, name, clock, speed=SPEED).due[which]
            assert late.min() >= -EARLY
            assert np.median(late) <= LATENCY
            continue
        check_truth(sensor, blocks, served.sent(mode, name, clock, speed=SPEED))


@pytest.mark.parametrize("mode", CASES)
def test_the_event_loop_is_not_blocked(served: Served, mode: str) -> None:
    """In a loop that does not wait for slow processes."""

    async def run() -> list[float]:
        async with watching_the_loop() as blocked:
            kind, found, chosen = driver_type(CASES[mode]["driver"]), 0, served.sensors(mode)
            async with asyncio.timeout(limit()), reading(kind, chosen) as items:
                async for item in items:
                    found += item.n_samples if isinstance(item, Block) else 0
                    if found >= N * chosen[0].sampling_rate / RATE:
                        break
        return blocked

    assert not asyncio.run(run())


@pytest.mark.parametrize("mode", [mode for mode in CASES if mode not in NOT_REPLAYED])
async def test_a_logged_session_is_replayed(served: Served, mode: str, tmp_path: Path) -> None:
    """Every block and event, with its host time; also if the line is lost after a block.

    Where the log ends otherwise, what the driver sends next seems to be sent.
    """
    kind, chosen = driver_type(CASES[mode]["driver"]), served.sensors(mode)
    found: list[DeviceItem] = []
    n_samples = 0
    live: list[Block] = []  # those that no read before the session was open completed
    log = tmp_path / "wire.jsonl"
    with log.open("x", encoding="utf-8", buffering=1) as file, using(WireLog(file)):
        async with reading(kind, chosen, speed=SPEED) as items:
            opened = None
            async for item in items:
                opened = last_read(log) if opened is None else opened
                found.append(item)
                if not isinstance(item, Block):
                    continue
                n_samples += item.n_samples
                if item.received.monotonic_ns > opened:
                    live.append(item)
                if n_samples >= N * chosen[0].sampling_rate / RATE and len(live) >= 3:
                    session_ends()
                    break
    replayed = await replay(log, kind, chosen, limit=limit())
    for was, now in zip(found, replayed, strict=False):
        assert_same(was, now)
    assert len(replayed) >= len(found)

    text = log.read_text()
    for lines in cut_at_blocks(text, live):
        outcomes = []
        for end in ("end", "lost"):
            cut = tmp_path / f"{end}.jsonl"
            cut.write_text("".join(lines) + ended(lines, end))
            outcomes.append(await replay(cut, kind, chosen, limit=limit()))
        whole, handed_on = outcomes
        assert any(isinstance(item, Block) for item in whole)
        assert len(handed_on) == len(whole), "what had arrived was not handed on"
        for was, now in zip(whole, handed_on, strict=True):
            assert_same(was, now)


def last_read(log: Path) -> int:
    """Return the host time of the last read in a log, ns."""
    lines = map(json.loads, log.read_text(encoding="utf-8").splitlines())
    return max((line["at_ns"] for line in lines if "in" in line), default=0)


def cut_at_blocks(log: str, blocks: list[Block]) -> Iterator[list[str]]:
    """Yield the lines of a log up to some of the reads that completed a block."""
    lines = log.splitlines(keepends=True)
    arrivals = {block.received.monotonic_ns for block in blocks}
    ends = [
        n
        for n, line in enumerate(map(json.loads, lines), 1)
        if "in" in line and line["at_ns"] in arrivals
    ]
    for n in {ends[len(ends) // 2], ends[3 * len(ends) // 4], ends[-1]}:  # the session is open
        yield lines[:n]


def ended(lines: list[str], how: str) -> str:
    """Return what ends a log: the driver's own end, or a line that is lost."""
    last = json.loads(lines[-1])
    ports = {json.loads(line)["port"] for line in lines}
    return "".join(
        json.dumps({"port": p, how: "", "at_ns": last["at_ns"], "utc_ns": last["utc_ns"]}) + "\n"
        for p in ports
    )


def assert_same(was: DeviceItem, now: DeviceItem) -> None:
    if isinstance(was, Block):
        assert isinstance(now, Block)
        np.testing.assert_array_equal(was.counts, now.counts)
        assert was.first_sample == now.first_sample
        assert was.device_counter == now.device_counter
        assert was.flags == now.flags
        assert was.received == now.received
    elif isinstance(was, Event):
        assert isinstance(now, Event)
        assert was.text == now.text
    else:
        assert was == now


@pytest.mark.parametrize("mode", CASES)
async def test_a_port_that_is_not_there_is_named(served: Served, mode: str) -> None:
    scheme = served.device(mode).port.partition("://")[0]
    known = scheme in {"modbus-tcp", "seedlink", "udp", "iio"}
    port = f"{scheme}://127.0.0.1:1" if known else "socket://127.0.0.1:1"
    if mode == "text udp":  # listens itself, at an address that is not this computer's
        port = "udp://192.0.2.1:8888"
    chosen = served.sensors(mode, port=port)
    with pytest.raises(NotConnectedError) as caught:
        async with reading(driver_type(CASES[mode]["driver"]), chosen) as items:
            await anext(items)
    assert port in str(caught.value)
    assert repr(chosen[0].name) in str(caught.value)


async def outcome(mode: str, chosen: list[Sensor]) -> tuple[Exception | None, int]:
    """Return how reading ends within a few seconds, and how many blocks came until then."""
    kind, n_blocks = driver_type(CASES[mode]["driver"]), 0
    try:
        async with asyncio.timeout(12), reading(kind, chosen, speed=SPEED) as items:
            async for item in items:
                n_blocks += isinstance(item, Block)
    except (DeviceError, RemoteProtocolError, TimeoutError) as error:
        return error, n_blocks
    return None, n_blocks


def _scheme(port: str) -> str:
    scheme = port.partition("://")[0]
    return scheme if scheme in {"modbus-tcp", "seedlink", "iio"} else "socket"


@pytest.mark.parametrize("garbage", [b"", bytes(range(256)) * 3], ids=["silence", "garbage"])
async def test_strangers_are_no_devices(served: Served, garbage: bytes) -> None:
    modes = [mode for mode in CASES if not served.device(mode).port.startswith("udp")]
    async with stranger(garbage) as number:
        ports = {
            mode: f"{_scheme(served.device(mode).port)}://127.0.0.1:{number}" for mode in modes
        }
        outcomes = await asyncio.gather(
            *(outcome(mode, served.sensors(mode, port=ports[mode])) for mode in modes)
        )
    for mode, (error, n_blocks) in zip(modes, outcomes, strict=True):
        assert not n_blocks, mode
        assert isinstance(error, (DeviceError, RemoteProtocolError)), (mode, error)


@pytest.mark.parametrize("mode", CASES)
async def test_z_a_device_that_vanishes_ends_the_session(served: Served, mode: str) -> None:
    """Last in this file: it ends the devices."""
    chosen = served.sensors(mode)
    error: Exception | None = None
    seen = 0
    try:
        async with (
            asyncio.timeout(30),
            reading(driver_type(CASES[mode]["driver"]), chosen, speed=SPEED) as items,
        ):
            async for item in items:
                seen += isinstance(item, Block)
                if seen:
                    served.device(mode).kill()
    except (NotConnectedError, NoAnswerError) as came:
        error = came
    assert seen
    assert error is not None
    assert repr(chosen[0].name) in str(error)
