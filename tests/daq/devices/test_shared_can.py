"""Devices of a CAN bus that come and go, against an own peer: nobody costs the others rows."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import Iterator

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.devices.interface import DeviceInformation
from daq.devices.registry import driver_type
from daq.errors import NoAnswerError
from daq.host_clock import SystemClock
from daq.protocols.block import Block, BlockFlag, DeviceItem, EventKind
from tests.daq.devices.can_peer import Peer
from tests.daq.devices.found import blocks_of, events_of, indices
from tests.sensors import sensor_at
from tests.waiting import limit, wait_until

RATE = 100.0
DRIVER = driver_type("epson-can")
NODES = {"A": 1, "B": 2, "C": 3}
_channels = itertools.count()
pytestmark = pytest.mark.peer


@contextlib.contextmanager
def bus() -> Iterator[tuple[Peer, list[Sensor]]]:
    channel = f"huddle-shared-{next(_channels)}"
    peer = Peer(channel, list(NODES.values()), RATE)
    sensors = []
    for name, node in NODES.items():
        own = {"node_id": node, "interface": "virtual"}
        sensors.append(sensor_at(f"can://{channel}", "epson-can", name, rate=RATE, settings=own))
    try:
        yield peer, sensors
    finally:
        peer.close()


async def session(
    sensors: list[Sensor], rows: int, names: str = "ABC"
) -> tuple[tuple[DeviceInformation, ...], list[DeviceItem], str]:
    """Read until sensors have so many rows; return also why the session ended before."""
    found: list[DeviceItem] = []
    left = dict.fromkeys(names, rows)
    async with asyncio.timeout(limit(60)), DRIVER.open(sensors, SystemClock()) as opened:
        try:
            async for item in opened.read():
                found.append(item)
                if isinstance(item, Block) and item.sensor in left:
                    left[item.sensor] -= item.n_samples
                if all(n <= 0 for n in left.values()):
                    break
        except NoAnswerError as error:
            return opened.information, found, str(error)
    return opened.information, found, ""


def rows_of(found: list[DeviceItem], name: str) -> tuple[list[int], list[int]]:
    """Return the indices and ticks of all rows of a sensor."""
    blocks = blocks_of(found, name)
    assert all((b.counts[:, 1] == NODES[name]).all() for b in blocks)
    return indices(blocks), [int(tick) for b in blocks for tick in b.counts[:, 0]]


def check_rows(found: list[DeviceItem], *, complete: set[str]) -> None:
    """See that rows of one SYNC have one index, and that nobody lost a row for another."""
    origins = set()
    for name in NODES:
        index, ticks = rows_of(found, name)
        origins |= set((np.array(ticks, int) - np.array(index, int)).tolist())
        if name in complete:
            assert index == list(range(len(index)))
    assert len(origins) == 1


@pytest.mark.parametrize("away", [50, pytest.param(250, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", ["B", pytest.param("C", marks=pytest.mark.long)])
async def test_a_node_that_restarts_is_started_again_and_costs_nobody(name: str, away: int) -> None:
    with bus() as (peer, sensors):
        node = peer.nodes[NODES[name]]
        peer.schedule = {200: [node.leave], 200 + away: [node.come]}
        _, found, why = await session(sensors, 300)
    assert not why
    check_rows(found, complete=set(NODES) - {name})
    _, ticks = rows_of(found, name)
    missing = set(range(ticks[0], ticks[-1] + 1)) - set(ticks)
    assert missing == set(range(min(missing), max(missing) + 1))  # one gap
    assert len(missing) >= away
    (again,) = [b for b in blocks_of(found, name) if b.reason]
    assert again.flags & BlockFlag.CLOCK_RESTART
    assert again.flags & BlockFlag.MISSING_ESTIMATED
    kinds = [e.kind for e in events_of(found) if e.sensor == name]
    assert kinds == [EventKind.STALLED, EventKind.CONNECTED]


async def test_a_node_that_is_missing_at_first_joins_at_its_place() -> None:
    with bus() as (peer, sensors):
        node = peer.nodes[2]
        node.leave()
        peer.schedule = {300: [node.come]}
        information, found, why = await session(sensors, 60)
    assert not why
    assert [bool(one.trouble) for one in information] == [False, True, False]
    check_rows(found, complete={"A", "C"})


async def test_a_node_that_replied_too_late_is_started_with_its_counter() -> None:
    with bus() as (peer, sensors):
        node = peer.nodes[2]
        ask, n_asked = node.ask, itertools.count()
        node.ask = lambda request: ask(request) if next(n_asked) not in range(3, 5) else b""  # type: ignore[method-assign]
        information, found, _ = await session(sensors, 100)
    assert [bool(one.trouble) for one in information] == [False, True, False]
    check_rows(found, complete={"A", "C"})
    index, ticks = rows_of(found, "B")
    assert ticks == node.sent[: len(ticks)]
    assert index == list(range(index[0], index[-1] + 1))


async def test_a_node_that_boots_while_it_is_configured_is_configured_again() -> None:
    with bus() as (peer, sensors):
        node = peer.nodes[2]
        node.leave()
        ask = node.ask

        def booting(request: bytes) -> bytes:
            node.ask = ask  # type: ignore[method-assign]
            reply = ask(request)
            node.come()
            return reply

        node.ask = booting  # type: ignore[method-assign]
        peer.schedule = {250: [lambda: setattr(node, "is_there", True)]}
        _, found, _ = await session(sensors, 100)
    check_rows(found, complete={"A", "C"})
    index, ticks = rows_of(found, "B")
    assert ticks == list(range(ticks[0], ticks[-1] + 1))
    assert ticks == node.sent[: len(ticks)]
    assert index == list(range(index[0], index[-1] + 1))


@pytest.mark.parametrize(
    "order",
    [
        ["producer restarts", "C is dead"],
        pytest.param(["producer dies", "C is dead"], marks=pytest.mark.long),
        pytest.param(["producer dies"], marks=pytest.mark.long),
    ],
    ids="-".join,
)
async def test_the_bus_goes_on_without_its_producer_and_a_dead_node(order: list[str]) -> None:
    with bus() as (peer, sensors):
        producer, dead = peer.nodes[1], peer.nodes[3]
        peer.schedule = {200: [producer.leave]}
        if "C is dead" in order:
            peer.schedule[120] = [dead.leave]
        if "producer restarts" in order:
            peer.schedule[250] = [producer.come]
        _, before, why = await session(sensors, 10**6)
        assert "node 1" in why
        sent = [peer.nodes[NODES[name]].sent[-1] for name in "AB"]
        gone = {"A"} if "producer dies" in order else set()
        gone |= {"C"} if "C is dead" in order else set()
        alive = {"A", "B", "C"} - gone
        await asyncio.to_thread(wait_until, lambda: peer.tick > 250, "tick 250")
        information, after, why = await session(sensors, 90, "".join(alive))
    assert not why
    assert sent == [rows_of(before, name)[1][-1] for name in "AB"]  # up to the last SYNC
    assert {one.sensor for one in information if not one.trouble} == alive
    check_rows(before, complete={"A", "B"})
    check_rows(after, complete=alive)
