"""The simulated IIOD read by the clients of libiio, and our driver served by its real server.

``iiod`` serves the simulated board again: all that our driver says and hears there is its own.

Clients of libiio open a second connection for the buffer, and our ports of simulated devices have
one reader: so each connection has a server of its own here.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes.util
import shutil
import socket
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.devices.registry import driver_type
from daq.host_clock import SystemClock
from daq.protocols.block import Block, Reading
from sim_devices.devices.iio import Iiod
from sim_devices.devices.interface import Source
from sim_devices.server.serve import device_spec
from tests.sensors import sensor_at
from tests.sim_devices.simulated_bench import device, scenario
from tests.tcp import served
from tests.waiting import limit, wait_until

pytestmark = pytest.mark.peer

RATE = 200.0
IIOD = shutil.which("iiod", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")
SPEC = device_spec(device("A", "iio", port="tcp", sampling_rate=RATE))


def sampled(times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return what the board sampled at these times of its own."""
    first, last = round(times_ns[0] * 1e-9 * RATE), round(times_ns[-1] * 1e-9 * RATE)
    source = Source(scenario("A"), SPEC)
    assert source.times("A", first, 1)[0] * 1e9 == pytest.approx(times_ns[0], abs=2)
    return source.counts("A", first, last - first + 1)


@contextlib.asynccontextmanager
async def serving() -> AsyncIterator[str]:
    """Serve the simulated board; yield its URI."""
    source, loop = Source(scenario("A"), SPEC), asyncio.get_running_loop()
    began = loop.time() - 5.0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        iiod = Iiod(SPEC, source)
        iiod.connected(loop.time() - began)
        while True:
            received = b""
            wait = min(1.0, max(0.0, iiod.next_due() - (loop.time() - began)))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait):
                    received = await reader.read(4096)
                    if not received:
                        break
            for unit in iiod.receive(received, loop.time() - began):
                writer.write(unit)

    async with served(serve) as number:
        yield f"ip:127.0.0.1:{number}"


async def _run(*command: str) -> bytes:
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    async with asyncio.timeout(limit()):
        out, err = await process.communicate()
    assert process.returncode == 0, err
    assert b"validity" not in err, err
    return out


@pytest.mark.skipif(shutil.which("iio_info") is None, reason="libiio-utils is not installed")
async def test_iio_info_finds_the_device() -> None:
    async with serving() as uri:
        text = (await _run("iio_info", "-u", uri)).decode()
    assert "iio:device0: adxl355" in text
    for k, axis in enumerate("xyz"):
        assert f"accel_{axis}:  (input, index: {k}, format: be:S32/32>>0)" in text
    assert "timestamp:  (input, index: 3, format: le:S64/64>>0)" in text


@pytest.mark.skipif(shutil.which("iio_readdev") is None, reason="libiio-utils is not installed")
async def test_iio_readdev_reads_every_scan() -> None:
    async with serving() as uri:
        scans = await _run("iio_readdev", "-u", uri, "-b", "50", "-s", "300", "iio:device0")
    rows = np.frombuffer(scans, [("xyz", ">i4", 3), ("", "V4"), ("time", "<i8")])
    assert len(rows) == 300
    np.testing.assert_allclose(np.diff(rows["time"]), 1e9 / RATE, atol=2)
    np.testing.assert_allclose(rows["xyz"], sampled(rows["time"]), atol=0.5)


@pytest.mark.skipif(ctypes.util.find_library("iio") is None, reason="libiio is not installed")
async def test_pylibiio_reads_every_scan() -> None:
    def read(uri: str) -> NDArray[np.int64]:
        iio: Any = pytest.importorskip("iio")
        context = iio.Context(uri)
        board = context.find_device("adxl355")
        assert float(board.attrs["sampling_frequency"].value) == RATE
        scanned = [channel for channel in board.channels if channel.scan_element]
        attributes = board.find_channel("temp").attrs
        raw, offset, scale = (float(attributes[k].value) for k in ("raw", "offset", "scale"))
        assert abs((raw + offset) * scale - 25_000.0) <= 600.0  # thousandths of a degree
        for channel in scanned:
            channel.enabled = True
        buffer, scans = iio.Buffer(board, 50), []
        for _ in range(4):
            buffer.refill()
            columns = [
                np.frombuffer(c.read(buffer), "i8" if c.id == "timestamp" else "i4")
                for c in scanned
            ]
            scans.append(np.stack(columns, axis=1).astype(np.int64))
        return np.concatenate(scans)

    async with serving() as uri:
        rows = await asyncio.to_thread(read, uri)
    assert len(rows) == 200
    np.testing.assert_allclose(rows[:, :3], sampled(rows[:, 3]), atol=0.5)


@pytest.mark.skipif(IIOD is None, reason="iiod is not installed")
async def test_a_real_iiod_serves_our_driver() -> None:
    driver, found = driver_type("iio"), list[object]()
    async with serving() as uri, asyncio.timeout(limit()), _iiod(uri) as port:
        sensor = sensor_at(port, "iio", rate=RATE)
        for _ in range(2):  # the buffer is free again after a session
            found.clear()
            async with driver.open([sensor], SystemClock()) as session:
                (information,) = session.information
                async for item in session.read():
                    found.append(item)
                    if sum(isinstance(item, Block) for item in found) == 10:
                        break
    assert (information.model, information.sampling_rate) == ("adxl355", RATE)
    blocks = [item for item in found if isinstance(item, Block)]
    celsius, *_ = (item.value for item in found if isinstance(item, Reading))
    assert abs(celsius - 25.0) <= 0.6
    assert len(found) == len(blocks) + 1
    assert [b.first_sample for b in blocks] == [20 * k for k in range(10)]
    times = np.array([b.device_counter for b in blocks], np.int64)
    np.testing.assert_allclose(np.diff(times), 20 * 1e9 / RATE, atol=2)
    counts = np.concatenate([block.counts for block in blocks])
    ends = np.array([times[0], times[0] + round((len(counts) - 1) * 1e9 / RATE)])
    np.testing.assert_allclose(counts, sampled(ends), atol=0.5)


@contextlib.asynccontextmanager
async def _iiod(uri: str) -> AsyncIterator[str]:
    """Run the server of libiio on the context of another; yield its address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    nothing = asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(
        str(IIOD), "-p", str(number), "-u", uri, stdout=nothing, stderr=nothing
    )

    def is_ready() -> bool:
        assert process.returncode is None, "iiod has ended"
        with contextlib.suppress(ConnectionError):
            socket.create_connection(("127.0.0.1", number)).close()
            return True
        return False

    try:  # it binds its port once it knows the context
        await asyncio.to_thread(wait_until, is_ready, "iiod has its port")
        yield f"iio://127.0.0.1:{number}"
    finally:
        process.kill()  # on SIGTERM it waits a minute for its own client
        await process.wait()
