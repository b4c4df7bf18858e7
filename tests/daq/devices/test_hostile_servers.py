"""Servers that cut connections within a packet, repeat, lose and delay what they send.

A proxy of bytes stands between each driver and its simulated device. It passes a random number of
bytes and hangs up, again and again; meanwhile the device repeats and loses packets. Each recorded
sample must be in its place.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.bench.model import Bench
from daq.errors import DeviceError
from daq.recorder.connection import MAX_RETRY_DELAY
from daq.recorder.recorder import RecorderStatus, record
from daq.recording.reader import Recording
from tests.daq.devices.driver_modes import Served, serving_all
from tests.daq.devices.test_conformance_faults import HELD_UP, hold_against_the_world
from tests.devices import host_clock, run

pytestmark = [pytest.mark.devices, pytest.mark.timeout(240)]

SPEED = 4.0
N_CUTS = 6
"""Of each connection."""
FEWEST, MOST = 300, 9000
"""Bytes that a connection passes before it is cut."""
FEW = {"registers tcp": 3000}
"""Instead of ``MOST``, where few bytes pass in a second."""
SECONDS = 6.0
"""Of samples wanted after the last cut, of host time."""
FAULTS: dict[str, dict[str, dict[str, Any]]] = {
    "registers tcp": {"duplicate": {"count": 2}, "late": {"duration": 0.6}},
    "scream tcp": {"duplicate": {"count": 2}, "drop": {}, "late": {"duration": 0.6}},
    "fifo tcp": {"duplicate": {}, "corrupt": {"count": 3}, "drop": {}},
    "seedlink 4": {"duplicate": {"count": 2}, "drop": {}, "late": {"duration": 0.6}},
    "seedlink tls": {"duplicate": {"count": 2}, "drop": {}, "late": {"duration": 0.6}},
    "seedlink 3": {"duplicate": {"count": 2}, "drop": {}, "late": {"duration": 0.6}, "wrap": {}},
    "text tcp": {"duplicate": {}, "drop": {}},
}
"""What the device does meanwhile."""


class HostileProxy:
    """Passes bytes between a driver and a device; hangs up after a random number of them."""

    def __init__(self, port: str, seed: int, most: int) -> None:
        self._scheme, _, address = port.partition("://")
        host, _, number = address.partition(":")
        self._device = host, int(number)
        self._rng = np.random.default_rng(seed)
        self._most = most
        self.n_cuts = 0
        self.is_armed = False
        """Whether it hangs up."""
        self.port = ""

    @contextlib.asynccontextmanager
    async def open(self) -> AsyncIterator[str]:
        """Listen; yield the port for the driver."""
        tasks: set[asyncio.Task[None]] = set()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            task = asyncio.current_task()
            if task is not None:
                tasks.add(task)
            try:
                await self._pass(reader, writer)
            finally:
                writer.transport.abort()

        async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
            self.port = f"{self._scheme}://127.0.0.1:{server.sockets[0].getsockname()[1]}"
            yield self.port
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        left: int | None = None
        there, back = await asyncio.open_connection(*self._device)

        async def forth() -> None:
            with contextlib.suppress(ConnectionError):
                while received := await reader.read(4096):
                    back.write(received)
            back.transport.abort()

        sending = asyncio.create_task(forth())
        try:
            with contextlib.suppress(ConnectionError):
                while received := await there.read(4096):
                    if left is None and self.is_armed and self.n_cuts < N_CUTS:
                        left = int(self._rng.integers(FEWEST, self._most))
                    if left is not None and len(received) >= left:
                        writer.write(received[:left])
                        await writer.drain()
                        self.n_cuts += 1
                        return
                    left = None if left is None else left - len(received)
                    at = int(self._rng.integers(0, len(received) + 1))
                    for piece in (received[:at], received[at:]):
                        writer.write(piece)
                        await writer.drain()
        finally:
            sending.cancel()
            back.transport.abort()
            await asyncio.gather(sending, return_exceptions=True)


async def _recorded(served: Served, path: Path, proxies: Sequence[HostileProxy]) -> None:
    sensors = []
    for mode, proxy in zip(FAULTS, proxies, strict=True):
        sensors += served.sensors(mode, port=proxy.port)
    stop, done_at = asyncio.Event(), 0.0

    def look(status: RecorderStatus) -> None:
        nonlocal done_at
        for proxy in proxies:  # once all are recorded
            proxy.is_armed = proxy.is_armed or all(one.samples for one in status.sensors.values())
        if not done_at and all(proxy.n_cuts == N_CUTS for proxy in proxies):
            done_at = status.elapsed
        if done_at and status.elapsed > done_at + SECONDS * SPEED:
            stop.set()

    bench = Bench(name="hostile", sampling_rate=20.0, sensors=tuple(sensors))
    while not stop.is_set():
        try:
            await record(bench, path, clock=host_clock(SPEED), stop=stop, acknowledged=look)
        except* DeviceError:  # cut while the devices were set up
            await asyncio.to_thread(path.unlink, missing_ok=True)


@pytest.mark.long
def test_each_sample_is_in_its_place(
    tmp_path: Path, subtests: pytest.Subtests, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("protocols.sample_counter", "devices.labjack.stream"):
        monkeypatch.setattr(f"daq.{module}.SLACK", 2 * HELD_UP * SPEED)
    monkeypatch.setattr("daq.recorder.connection.MAX_RETRY_DELAY", MAX_RETRY_DELAY / SPEED)
    script = [
        {"kind": kind, "sensors": [f"{mode} 1"], "at": 14.0 + 1.7 * n, "every": 5.3, **keys}
        for mode, kinds in FAULTS.items()
        for n, (kind, keys) in enumerate(kinds.items())
    ]
    path = tmp_path / "hostile.h5"
    with serving_all(speed=SPEED, faults=script) as served:
        proxies = [
            HostileProxy(served.device(mode).port, k, FEW.get(mode, MOST))
            for k, mode in enumerate(FAULTS)
        ]

        async def main() -> None:
            async with contextlib.AsyncExitStack() as stack:
                for proxy in proxies:
                    await stack.enter_async_context(proxy.open())
                await _recorded(served, path, proxies)

        run(main())
        with Recording.open(path) as recording:
            for mode, sensor in itertools.product(FAULTS, recording.sensors):
                if sensor.name in served.device(mode).sensors:
                    with subtests.test(sensor=sensor.name):
                        kinds = [e.kind for e in recording.events if e.sensor == sensor.name]
                        assert kinds.count("connected") > N_CUTS // 3  # some end before they begin
                        assert set(FAULTS[mode]) & {one["kind"] for one in served.struck(mode)}
                        hold_against_the_world(served, mode, sensor)
