"""The simulated IIOD, read by the programs of libiio.

They open a second connection for the buffer, and our ports of simulated devices have one reader: so
each connection has a server of its own here.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest

from sim_devices.devices.iio import Iiod
from sim_devices.devices.interface import Source
from sim_devices.server.serve import device_spec
from tests.sim_devices.simulated_bench import device, scenario
from tests.waiting import limit

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.peer

RATE = 200.0


@contextlib.asynccontextmanager
async def serving() -> AsyncIterator[str]:
    """Serve the simulated board; yield its URI."""
    spec = device_spec(device("A", "iio", port="tcp", sampling_rate=RATE))
    source, loop = Source(scenario("A"), spec), asyncio.get_running_loop()
    began, tasks = loop.time() - 5.0, set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        tasks.add(asyncio.current_task())
        iiod = Iiod(spec, source)
        iiod.connected(loop.time() - began)
        with contextlib.suppress(ConnectionError):
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
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        yield f"ip:127.0.0.1:{server.sockets[0].getsockname()[1]}"
    await asyncio.gather(*filter(None, tasks))


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
    assert rows["xyz"].std(axis=0).min() > 0
