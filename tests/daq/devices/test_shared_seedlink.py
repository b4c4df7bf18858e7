"""Stations of a SeedLink server that come and go, against an own server: others lose nothing."""

from __future__ import annotations

import asyncio
import contextlib
from collections import defaultdict
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.conformance import suite
from daq.conformance.suite import DriverConformance, Served
from daq.devices import shared_port
from daq.devices.interface import Session
from daq.devices.registry import driver_type
from daq.devices.seedlink import driver
from daq.devices.seedlink.packets import PacketFinder
from daq.errors import NotConnectedError, WrongDeviceError
from daq.host_clock import HostClock, SystemClock
from daq.protocols.block import Block, DeviceItem, EventKind
from tests.daq.devices.found import blocks_of, events_of, indices
from tests.daq.devices.seedlink_peer import PER_RECORD, RATE, Server, record, value
from tests.sensors import sensor_at
from tests.waiting import limit, wait_until

DRIVER = driver_type("seedlink")
NAMES = ["AAA", "BBB", "CCC"]


def sensors(port: str, patience: float = 60.0) -> list[Sensor]:
    found = []
    for name in NAMES:
        own = {"network": "XX", "station": name, "late": 0.2, "patience": patience}
        one = sensor_at(port, "seedlink", name, rate=RATE, channels=["HNZ"], settings=own)
        found.append(one)
    return found


class Reader:
    """Reads a session in the background, and knows what came of each sensor."""

    def __init__(self) -> None:
        self.items: list[DeviceItem] = []
        self.rows: defaultdict[str, int] = defaultdict(int)
        self._changed = asyncio.Event()

    async def run(self, session: Session) -> None:
        """Read to the end."""
        async for item in session.read():
            self.items.append(item)
            if isinstance(item, Block):
                self.rows[item.sensor] += item.n_samples
            self._changed.set()

    async def until(self, server: Server, **rows: int) -> None:
        """Let the server make records until each sensor has so many rows more."""
        wanted = {name: self.rows[name] + more for name, more in rows.items()}
        async with asyncio.timeout(limit(30)):
            while any(self.rows[name] < n for name, n in wanted.items()):
                server.make()
                self._changed.clear()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._changed.wait(), 0.05)

    def check(self, name: str) -> None:
        """See that rows of a sensor are one stretch, each what the server made."""
        blocks = blocks_of(self.items, name)
        counts = np.concatenate([b.counts[:, 0] for b in blocks]).tolist()
        assert indices(blocks) == list(range(len(counts)))
        station = NAMES.index(name)
        begin = next(k for k in range(100_003) if value(station, k) == counts[0])
        assert counts == [value(station, begin + k) for k in range(len(counts))]


async def test_a_refused_station_costs_the_others_nothing_and_comes_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(shared_port, "FIRST_RETRY", 0.1)
    async with Server(NAMES) as server:
        server.refuses = {"BBB"}
        session, stack, reader, task = await _opened(server)
        about = {one.sensor: one.trouble for one in session.information}
        assert "ERROR" in about["BBB"]
        assert not about["AAA"]
        assert not about["CCC"]
        await reader.until(server, AAA=400, CCC=400)
        assert reader.rows["BBB"] == 0
        server.refuses = set()
        await reader.until(server, AAA=400, BBB=400, CCC=400)
        assert [e.kind for e in events_of(reader.items)] == [EventKind.CONNECTED]
        for name in NAMES:
            reader.check(name)
        server.refuses = {"CCC", "AAA"}  # a hang-up: the next session has BBB alone
        server.hang_up()
        with pytest.raises(NotConnectedError):
            await task
        await stack.aclose()
        session, stack, _, task = await _opened(server, session, reader)
        assert [bool(one.trouble) for one in session.information] == [True, False, True]
        await reader.until(server, BBB=200)
        server.refuses = {"CCC"}
        await reader.until(server, BBB=200, AAA=200)
        server.refuses = set()
        await reader.until(server, BBB=200, AAA=200, CCC=200)
        for name in NAMES:
            reader.check(name)
        await _close(task, stack)


async def test_a_station_that_a_later_connection_refuses_is_requested_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(shared_port, "FIRST_RETRY", 0.1)
    async with Server(NAMES) as server:
        server.refuses = {"BBB"}
        _, stack, reader, task = await _opened(server)
        server.refuses = {"CCC"}
        await reader.until(server, BBB=200)
        server.refuses = set()
        await reader.until(server, AAA=200, BBB=200, CCC=200)
        for name in NAMES:
            reader.check(name)
        await _close(task, stack)


async def test_records_that_come_while_a_connection_is_opened_and_lost_are_recorded() -> None:
    async with Server(NAMES) as server:
        server.away = {"AAA"}  # awaited for the patience
        clock = SystemClock(5.0)
        session, stack, reader, task = await _opened(server, clock=clock, patience=5.0)
        assert isinstance(session, driver.SeedLinkSession)
        await reader.until(server, BBB=200, CCC=200)
        server.hang_up()
        await asyncio.gather(task, return_exceptions=True)
        await stack.aclose()
        failing = asyncio.create_task(_opened(server, session, clock=clock, patience=1e3))
        await asyncio.to_thread(wait_until, lambda: bool(session.decoder.waiting), "records")
        server.hang_up()
        with pytest.raises(NotConnectedError):
            await failing
        _, stack, _, task = await _opened(server, session, reader, clock=clock, patience=5.0)
        await reader.until(server, BBB=200, CCC=200)
        for name in ("BBB", "CCC"):
            reader.check(name)
        await _close(task, stack)


async def _opening(
    server: Server, before: Session | None, reader: Reader, clock: HostClock, patience: float
) -> tuple[Session, contextlib.AsyncExitStack, Reader, asyncio.Task[None]]:
    stack = contextlib.AsyncExitStack()
    bench = sensors(server.port, patience)
    opened: AbstractAsyncContextManager[Session] = (
        DRIVER.open(bench, clock) if before is None else DRIVER.resume(bench, clock, before)
    )
    session = await stack.enter_async_context(opened)
    return session, stack, reader, asyncio.create_task(reader.run(session))


async def _opened(
    server: Server,
    before: Session | None = None,
    reader: Reader | None = None,
    *,
    clock: HostClock | None = None,
    patience: float = 60.0,
) -> tuple[Session, contextlib.AsyncExitStack, Reader, asyncio.Task[None]]:
    """Open the port while the server makes rows."""
    reader, clock = reader or Reader(), clock or SystemClock()
    opening = asyncio.create_task(_opening(server, before, reader, clock, patience))
    while not opening.done():
        server.make()
        await asyncio.wait([opening], timeout=0.05)
    return opening.result()


async def _close(task: asyncio.Task[None], stack: contextlib.AsyncExitStack) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await stack.aclose()


async def test_a_station_of_another_rate_costs_the_others_nothing() -> None:
    async with Server(NAMES) as server:
        server.rates = {"BBB": 50}
        session, stack, reader, task = await _opened(server)
        about = {one.sensor: one.trouble for one in session.information}
        assert "has 50 Hz; expected 100 Hz: correct sampling_rate" in about["BBB"]
        assert not about["AAA"]
        assert not about["CCC"]
        await reader.until(server, AAA=200, CCC=200)
        assert reader.rows["BBB"] == 0
        server.rates = {}
        await reader.until(server, AAA=200, BBB=200, CCC=200)
        for name in NAMES:
            reader.check(name)
        told = [(e.sensor, e.kind) for e in events_of(reader.items)]
        assert told == [("BBB", EventKind.REFUSED)]
        await _close(task, stack)


async def test_a_server_with_other_rates_only_is_named() -> None:
    async with Server(NAMES) as server:
        server.rates = dict.fromkeys(NAMES, 50)
        with pytest.raises(WrongDeviceError, match="has 50 Hz; expected 100 Hz"):
            await _opened(server)


async def test_a_server_that_refuses_all_stations_is_named() -> None:
    async with Server(NAMES) as server:
        server.refuses = set(NAMES)
        with pytest.raises(WrongDeviceError, match="expected OK to 'STATION AAA XX'"):
            await _opened(server)


@pytest.mark.parametrize("size", [256, 512, 1024])
@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("step", [1, 7, 10_000])
def test_records_have_the_length_that_they_state(size: int, padded: bool, step: int) -> None:
    finder = PacketFinder(3)
    records = [record("AAA", 0, turn, size=size) for turn in range(5)]
    line = b"".join(b"SL%06X" % n + r.ljust(512 * padded, b"\0") for n, r in enumerate(records))
    found = [p for k in range(0, len(line), step) for p in finder.receive(line[k : k + step])]
    assert [one.sequence for one in found] == list(range(5))
    assert [one.payload[:size] for one in found] == records


class Shared(DriverConformance):
    """The suite on this server; its clock is that of the test."""

    driver = DRIVER

    @contextlib.asynccontextmanager
    async def serve(self) -> AsyncIterator[Served]:
        """Serve stations, of which one may be refused."""

        async def make() -> None:
            while True:
                server.make()
                await asyncio.sleep(PER_RECORD / RATE)

        async with Server(NAMES) as server:
            task = asyncio.create_task(make())

            def away(name: str, is_away: bool) -> None:
                server.refuses = {name} if is_away else set()

            try:
                yield Served(sensors(server.port), away=away)
            finally:
                task.cancel()
                await asyncio.wait([task])


def test_the_suite_holds_for_stations_that_are_away() -> None:
    Shared().test_a_device_that_is_away_costs_the_others_nothing()


def test_the_suite_sees_a_device_that_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_port, "FIRST_RETRY", 1000.0)
    monkeypatch.setattr(suite, "LIMIT", 6.0)
    with pytest.raises(TimeoutError):
        Shared().test_a_device_that_is_away_costs_the_others_nothing()


def test_the_suite_sees_a_driver_that_names_no_trouble(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "_information", lambda *_: ())
    with pytest.raises(AssertionError, match="`trouble` of the device that is away, only"):
        Shared().test_a_device_that_is_away_costs_the_others_nothing()
