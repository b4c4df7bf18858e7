"""libmodbus, mbpoll and minimalmodbus against our slaves; our driver against libmodbus."""

from __future__ import annotations

import itertools
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.devices.registry import driver_type
from daq.protocols.block import Block, Event, EventKind
from sim_devices.server.launch import RunningDevice
from sim_devices.world.world import World
from tests.devices import host_clock, serving
from tests.peers.libmodbus import build, ready, running, serial_cable
from tests.sensors import sensor_at
from tests.sim_devices.simulated_bench import device, scenario, spec

pytestmark = [pytest.mark.devices, pytest.mark.peer]

RATE = 50.0
STILL = 1e-6  # a world so slow that every reading is the same
AGE = 5.01
COUNTS_PER_UNIT = 1e5
SLAVE = 0x50


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile the libmodbus program."""
    return build("libmodbus_peer.c", tmp_path_factory.mktemp("libmodbus"))


@pytest.fixture(scope="module", params=["tcp", "rtu"])
def slave(request: pytest.FixtureRequest) -> Iterator[tuple[str, RunningDevice]]:
    """Serve one simulated slave whose readings stand still."""
    table = device(
        "A",
        "registers",
        port="tcp" if request.param == "tcp" else "pty",
        sampling_rate=RATE,
        settings={"address": 0x34, "device_id": SLAVE},
        sensitivity=COUNTS_PER_UNIT,
    )
    with serving(spec(table, speed=STILL, age=AGE, sampling_rate=RATE)) as (one,):
        yield request.param, one


@pytest.fixture(scope="module")
def reading() -> list[int]:
    """Return what the slave's registers hold, from the world itself."""
    row = World(scenario("A", sampling_rate=RATE)).samples("A", int(AGE * RATE), 1)[0]
    counts: list[int] = np.rint(row * COUNTS_PER_UNIT).astype(np.int16).astype(int).tolist()
    return counts


def signed(registers: list[int]) -> list[int]:
    return [value - 65536 * (value > 32767) for value in registers]


def test_libmodbus_reads_our_slave(
    peer: Path, slave: tuple[str, RunningDevice], reading: list[int]
) -> None:
    kind, one = slave
    where = one.port.rpartition(":")[2] if kind == "tcp" else one.port
    said = subprocess.run(
        [str(peer), "read", kind, where, str(SLAVE), "3", str(0x34), "3"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert signed([int(word) for word in said.stdout.split()]) == reading
    refused = subprocess.run(
        [str(peer), "read", kind, where, str(SLAVE), "3", "900", "1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Illegal data address" in refused.stderr


def test_mbpoll_reads_our_slave(slave: tuple[str, RunningDevice], reading: list[int]) -> None:
    program = shutil.which("mbpoll")
    if program is None:
        pytest.skip("mbpoll (Debian: mbpoll) is not installed")
    kind, one = slave
    where = ["-m", "rtu", "-b", "9600", "-P", "none", one.port]
    if kind == "tcp":
        where = ["-m", "tcp", "-p", one.port.rpartition(":")[2], "127.0.0.1"]
    asked = ["-a", str(SLAVE), "-0", "-r", str(0x34), "-c", "3", "-t", "4", "-1"]
    said = subprocess.run([program, *asked, *where], capture_output=True, text=True, check=True)
    values = re.findall(r"^\[\d+\]:\s+(\d+)", said.stdout, re.MULTILINE)
    assert signed([int(value) for value in values]) == reading


@pytest.mark.parametrize("slave", ["rtu"], indirect=True)  # it does not speak TCP
def test_minimalmodbus_reads_our_slave(
    slave: tuple[str, RunningDevice], reading: list[int]
) -> None:
    minimalmodbus = pytest.importorskip(
        "minimalmodbus", reason="minimalmodbus (PyPI) is not installed"
    )
    _, one = slave
    instrument = minimalmodbus.Instrument(one.port, SLAVE)
    instrument.serial.baudrate = 9600
    instrument.serial.timeout = 1.0
    try:
        assert signed(instrument.read_registers(0x34, 3)) == reading
        assert instrument.read_register(0x34, signed=True) == reading[0]
        with pytest.raises(minimalmodbus.IllegalRequestError):
            instrument.read_register(900)
    finally:
        instrument.serial.close()


async def _polled(port: str, settings: dict[str, Any]) -> list[list[int]]:
    """Return the rows of 100 requests, of which each was answered once.

    Register 0 counts the requests. A busy computer may answer late: the driver asks again, and
    says that the device stalled, once for several requests.
    """
    sensor = sensor_at(port, "registers", rate=100.0, channels=("n", "a", "b"), settings=settings)
    rows: list[list[int]] = []
    has_stalled = False
    async with driver_type("registers").open([sensor], host_clock()) as session:
        async for item in session.read():
            if isinstance(item, Block):
                rows += item.counts.tolist()
            else:
                assert isinstance(item, Event), item
                assert item.kind == EventKind.STALLED, item
                has_stalled = True
            if len(rows) >= 100:
                break
    counts = [row[0] for row in rows]
    assert len(counts) >= 100
    assert all(before < after for before, after in itertools.pairwise(counts))
    n_asked_again = counts[-1] - counts[0] - (len(counts) - 1)
    assert n_asked_again == 0 or (has_stalled and n_asked_again < 10)
    return rows


@pytest.mark.parametrize("function", [3, 4])
async def test_our_driver_reads_a_libmodbus_server_over_tcp(peer: Path, function: int) -> None:
    with running(str(peer), "serve", "tcp") as server:
        port = server.stdout.readline().strip() if server.stdout else ""
        settings = {"function": function, "addresses": [0, 7, 9], "device_id": 255}
        rows = await _polled(f"modbus-tcp://127.0.0.1:{port}", settings)
    assert {tuple(row[1:]) for row in rows} == {(21, 27)}


async def test_our_driver_reads_a_libmodbus_server_over_rtu(peer: Path, tmp_path: Path) -> None:
    with (
        serial_cable(tmp_path) as (ours, theirs),
        ready(str(peer), "serve", "rtu", theirs),
    ):
        rows = await _polled(ours, {"addresses": [0, 7, 9], "device_id": 5, "baud_rate": 115200})
    assert {tuple(row[1:]) for row in rows} == {(21, 27)}
