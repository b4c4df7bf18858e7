"""Epson M-A552 on a CAN bus: the driver against canopen's own nodes on python-can's virtual bus."""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from daq.bench.model import Sensor
from daq.conformance.suite import Sent, check_blocks, check_counters, check_truth
from daq.devices.epson import can_driver
from daq.devices.epson import canopen as protocol
from daq.devices.interface import PresentPort
from daq.devices.registry import driver_type
from daq.errors import BenchFileError, NoAnswerError, WrongDeviceError
from daq.host_clock import SystemClock
from daq.protocols import block
from daq.protocols.block import Block, BlockFlag, DeviceItem, HostTime, Quantity, Reading
from tests.daq.devices.found import blocks_of, indices
from tests.daq.devices.simulated_can_bus import BUS_CELSIUS, SimulatedBus, encode_sample
from tests.sensors import sensor_at

RATE = 100.0
DRIVER = driver_type("epson-can")
NODES = {"A": 1, "B": 2, "C": 17}
_numbers = itertools.count()


def counts(node: int, first: int, n: int) -> NDArray[np.int32]:
    index = np.arange(first, first + n)[:, None]
    values: NDArray[np.int64] = (
        index * 7919 + node * 104729 + np.array([0, 1, 2]) * 15485863
    ) % 2**24 - 2**23
    return np.asarray(values, np.int32)


def sample(node: int, number: int) -> NDArray[np.int32]:
    return np.asarray(counts(node, number, 1)[0])


@contextlib.contextmanager
def serving(*nodes: int) -> Iterator[tuple[SimulatedBus, str]]:
    channel = f"huddle-{next(_numbers)}"
    bus = can.Bus(channel, interface="virtual")
    simulated = SimulatedBus(bus, {node: partial(sample, node) for node in nodes})
    try:
        yield simulated, channel
    finally:
        simulated.close()


def sensors(channel: str, *names: str, **changes: object) -> list[Sensor]:
    found = []
    for name in names:
        own = {"node_id": NODES[name], "interface": "virtual", **changes}
        found.append(sensor_at(f"can://{channel}", "epson-can", name, rate=RATE, settings=own))
    return found


async def read(bench: list[Sensor], n_samples: int) -> list[DeviceItem]:
    found: list[DeviceItem] = []
    ends = {one.name: 0 for one in bench}
    async with DRIVER.open(bench, SystemClock()) as session:
        assert [one.model for one in session.information] == ["M-A552AC10"] * len(bench)
        async for item in session.read():
            found.append(item)
            if isinstance(item, Block):
                ends[item.sensor] = item.end_sample
            if min(ends.values()) >= n_samples:
                break
    return found


def test_networks_that_are_can_buses_are_listed(tmp_path: Path) -> None:
    """As Linux lists them: a bus that is down can be brought up."""
    for name, kind, state in (("can0", 280, "up"), ("eth0", 1, "up"), ("can1", 280, "down")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n", encoding="utf-8")
        (tmp_path / name / "operstate").write_text(f"{state}\n", encoding="utf-8")
    found = can_driver.DRIVER.ports(folder=tmp_path)
    assert found == [
        PresentPort("can://can0", "socketcan, up"),
        PresentPort("can://can1", "socketcan, down"),
    ]


def test_messages_of_the_data_sheet() -> None:
    """TPDO1: Ax, Ay; TPDO2: Az, sample counter; little-endian."""
    made = encode_sample(3, np.array([1, -2, 0x123456], np.int32), 0xABCD)
    assert made == [
        (0x183, bytes.fromhex("01000000feffffff")),
        (0x283, bytes.fromhex("56341200cdab")),
    ]


@pytest.mark.peer
async def test_devices_on_one_bus_have_one_clock() -> None:
    with serving(*NODES.values()) as (simulated, channel):
        bench = sensors(channel, *NODES)
        for _ in range(2):
            found = await read(bench, 100)
            due = np.array(simulated.due)
            check_blocks(DRIVER, bench, found)
            check_counters(bench, found)
            for one in bench:
                node = NODES[one.name]
                check_truth(one, found, Sent(counts(node, 0, len(due)), due))
                blocks = blocks_of(found, one.name)
                np.testing.assert_array_equal(blocks[0].counts[0], counts(node, 0, 1)[0])


async def test_the_temperature_is_read_once_a_minute_while_samples_come(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(block, "READING_INTERVAL_NS", 500_000_000)
    with serving(1, 2) as (_, channel):
        bench = sensors(channel, "A", "B")
        found = await read(bench, 150)
    check_blocks(DRIVER, bench, found)
    check_counters(bench, found)
    readings = [item for item in found if isinstance(item, Reading)]
    assert len(readings) >= 4
    assert [one.sensor for one in readings[:4]] == ["A", "B", "A", "B"]
    assert all(one.quantity is Quantity.TEMPERATURE for one in readings)
    assert all(one.value == pytest.approx(BUS_CELSIUS, abs=0.002) for one in readings)


async def test_a_device_without_temperature_sends_samples_all_the_same() -> None:
    with serving(1) as (simulated, channel):
        simulated.nodes[1].object_dictionary[protocol.TEMPERATURE[0]].subindices.clear()
        found = await read(sensors(channel, "A"), 50)
    assert all(isinstance(item, Block) for item in found)


async def test_lost_messages_are_gaps_of_their_sensor() -> None:
    """Either message of a sample, and the first samples, of which nothing tells but the bus."""
    with serving(1, 2) as (simulated, channel):
        simulated.lost = {(1, 0, 20), (2, 1, 33), (2, 0, 34), (2, 0, 0), (2, 1, 0)}
        found = await read(sensors(channel, "A", "B"), 80)
    for name, node, lost in (("A", 1, {20}), ("B", 2, {0, 33, 34})):
        blocks = blocks_of(found, name)
        index = indices(blocks)
        assert set(range(80)) - set(index) == lost
        rows = np.concatenate([block.counts for block in blocks])
        np.testing.assert_array_equal(rows, counts(node, 0, index[-1] + 1)[index])
        assert BlockFlag.CLOCK_RESTART in blocks[0].flags
        assert all(
            b.reason
            for b, a in zip(blocks[1:], blocks, strict=False)
            if b.first_sample > a.end_sample
        )


async def test_a_device_that_does_not_answer_is_named() -> None:
    said = r"node 2.*check power, node_id and bitrate"
    with serving(1) as (_, channel):
        with pytest.raises(NoAnswerError, match=said):
            await read(sensors(channel, "B"), 1)
        async with DRIVER.open(sensors(channel, "A", "B"), SystemClock()) as session:
            known, missing = session.information
    assert not known.trouble
    assert re.search(said, missing.trouble)


async def test_another_device_is_refused() -> None:
    with serving(1) as (simulated, channel):
        simulated.nodes[1].set_data(protocol.DEVICE_NAME, 0, b"G552")
        with pytest.raises(WrongDeviceError, match="'G552'; expected an M-A552"):
            await read(sensors(channel, "A"), 1)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"node_id": 1}, "node_id"),
        ({"filter": "K1"}, "K512_FC210"),
    ],
)
def test_impossible_settings_are_refused(changes: dict[str, object], said: str) -> None:
    assert hasattr(DRIVER, "check")
    with pytest.raises(BenchFileError, match=said):
        DRIVER.check(sensors("can0", "A", "B", **changes))


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0x80, 0x181, 0x281, 0x182, 0x282, 0x123]), st.binary(max_size=9)
        ),
        max_size=60,
    ),
    st.integers(1, 7),
)
def test_any_messages(messages: list[tuple[int, bytes]], step: int) -> None:
    decoder = protocol.CanDecoder({"A": 1, "B": 2}, RATE, full_scale_counts=2**24)
    ends = {"A": 0, "B": 0}
    for k in range(0, len(messages), step):
        for item in decoder.receive(messages[k : k + step], HostTime(k * 10**7, 0)):
            if isinstance(item, Block):
                assert item.first_sample >= ends[item.sensor]
                ends[item.sensor] = item.end_sample


def test_messages_cut_anywhere_are_decoded() -> None:
    line: list[tuple[int, bytes]] = []
    for n in range(50):
        line.append((protocol.SYNC, b""))
        for node in (1, 2):
            line += encode_sample(node, counts(node, n, 1)[0], n + 65500)
    for step in (1, 2, 3, 5, 7, 250):
        decoder = protocol.CanDecoder({"A": 1, "B": 2}, RATE, full_scale_counts=2**24)
        found = [
            item
            for k in range(0, len(line), step)
            for item in decoder.receive(line[k : k + step], HostTime(10**9 + k * 2 * 10**6, 0))
        ]
        for name, node in (("A", 1), ("B", 2)):
            blocks = blocks_of(found, name)
            np.testing.assert_array_equal(
                np.concatenate([b.counts for b in blocks]), counts(node, 0, 50)
            )
            assert [b.first_sample for b in blocks[1:]] == [b.end_sample for b in blocks[:-1]]
