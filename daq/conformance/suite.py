"""Tests that every driver must pass, run against its simulated device.

A package subclasses :class:`DriverConformance` in one of its test modules::

    class TestAX3(DriverConformance):
        driver = DRIVER

        @contextlib.asynccontextmanager
        async def serve(self):
            server = ...
            yield Served([Sensor(...)], vanish=server.close)

The tests run in real time, each for some seconds. Where the sensors' port is ``socket://``, the
suite also puts itself between driver and device and lets the connection pause.
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, cast

import numpy as np
import pytest
from pydantic import BaseModel

from daq.acquisition.block_checks import BlockValidator
from daq.acquisition.connection import patience_of
from daq.errors import DeviceError, NoAnswerError, NotConnectedError
from daq.host_clock import SystemClock
from daq.protocols.block import Block, BlockFlag, Event, EventKind
from daq.protocols.errors import RemoteProtocolError
from daq.transport.address import host_and_port

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Sequence
    from contextlib import AbstractAsyncContextManager

    from daq.bench.model import Sensor
    from daq.drivers.interface import DriverType

LIMIT = 60.0
"""Seconds that any test may take."""
PAUSE = 2.0
"""Seconds for which a connection pauses."""
NORMAL_EVENTS = {EventKind.CONNECTED, EventKind.STATUS}
"""Kinds of events of a device that nothing is wrong with."""
SOCKET = "socket://"


@dataclass(frozen=True, slots=True)
class Served:
    """A simulated device that runs.

    Attributes
    ----------
    sensors
        All sensors of its port, as a bench file would connect to them.
    vanish : callable or None
        Ends the device at once, as a pulled cable does.
    """

    sensors: Sequence[Sensor]
    vanish: Callable[[], object] | None = None


class DriverConformance:
    """The tests; a subclass names the driver and serves its simulated device."""

    driver: ClassVar[DriverType]
    seconds: ClassVar[float] = 2.0
    """How much is read of every sensor, in seconds of its sampling rate."""

    def serve(self) -> AbstractAsyncContextManager[Served]:
        """Serve a simulated device until the context ends."""
        raise NotImplementedError

    # --- what it says ------------------------------------------------------------------------

    def test_it_says_what_it_is(self) -> None:
        """Name, summary, settings that refuse unknown keys."""
        driver = self.driver
        assert driver.name == driver.name.strip() != ""
        assert driver.summary, "a line for huddle init and huddle check"
        assert isinstance(driver.shares_clock, bool)
        assert issubclass(driver.settings, BaseModel)
        forbids = driver.settings.model_config.get("extra") == "forbid"
        assert forbids, "a misspelt setting must be an error: ConfigDict(extra='forbid')"

    # --- what it yields ----------------------------------------------------------------------

    def test_blocks_are_in_order_and_whole(self) -> None:
        """Twice: the port is free again after a session, and a session begins with sample 0."""

        async def run() -> None:
            async with self.serve() as served:
                for _ in range(2):
                    check_blocks(self.driver, served.sensors, await self._read(served.sensors))

        _run(run())

    def test_a_pause_ends_nothing(self) -> None:
        """The network holds everything for two seconds, then delivers it."""

        async def run() -> None:
            async with self.serve() as served:
                port = served.sensors[0].port
                if not port.startswith(SOCKET):
                    pytest.skip(f"the suite pauses socket:// ports, not {port}")
                async with _Proxy(*host_and_port(port)) as proxy:
                    sensors = [s.model_copy(update={"port": proxy.port}) for s in served.sensors]
                    found = await self._read(sensors, pauses=proxy.pause)
                    check_blocks(self.driver, sensors, found)

        _run(run())

    # --- what goes wrong ---------------------------------------------------------------------

    def test_a_port_that_is_not_there_is_named(self) -> None:
        """By sensor and port."""

        async def run() -> None:
            async with self.serve() as served:
                sensors = _at(served.sensors, 1)
            with pytest.raises(NotConnectedError) as caught:
                await self._read(sensors)
            assert sensors[0].port in str(caught.value)
            assert sensors[0].name in str(caught.value)

        _run(run())

    @pytest.mark.parametrize("garbage", [b"", bytes(range(256)) * 3], ids=["silence", "garbage"])
    def test_strangers_are_no_devices(self, garbage: bytes) -> None:
        """Something listens at the port that is no such device: an error, and no block."""

        async def run() -> None:
            async with self.serve() as served, _stranger(garbage) as number:
                sensors = _at(served.sensors, number)
                with pytest.raises((DeviceError, RemoteProtocolError)):
                    await self._read(sensors)

        _run(run())

    def test_a_device_that_vanishes_ends_the_session(self) -> None:
        """With an error that names a sensor."""

        async def run() -> None:
            async with self.serve() as served:
                if served.vanish is None:
                    pytest.skip("the simulated device cannot vanish")
                with pytest.raises((NotConnectedError, NoAnswerError)) as caught:
                    await self._read(served.sensors, first=served.vanish, seconds=1e6)
                assert any(sensor.name in str(caught.value) for sensor in served.sensors)

        _run(run())

    async def _read(
        self,
        sensors: Sequence[Sensor],
        *,
        pauses: Callable[[], object] | None = None,
        first: Callable[[], object] | None = None,
        seconds: float | None = None,
    ) -> list[Block | Event]:
        """Read until every sensor has enough; ``first`` and ``pauses`` are called once, early."""
        wanted = {s.name: (seconds or self.seconds) * s.sampling_rate for s in sensors}
        found: list[Block | Event] = []
        ends = dict.fromkeys(wanted, 0)
        validator = BlockValidator(self.driver, sensors)
        async with self.driver.open(sensors, SystemClock()) as session:
            assert [one.sensor for one in session.information] == list(wanted)
            patience = patience_of(session)
            assert patience > 0
            items = cast("AsyncGenerator[Block | Event]", session.read())
            async with contextlib.aclosing(items):
                while any(ends[name] < n for name, n in wanted.items()):
                    try:
                        async with asyncio.timeout(patience):
                            item = validator.validated(await anext(items))
                    except TimeoutError as error:
                        if isinstance(error, DeviceError):
                            raise
                        name = sensors[0].name
                        raise NoAnswerError(f"{name!r}: nothing in {patience:g} s") from error
                    found.append(item)
                    if isinstance(item, Block):
                        ends[item.sensor] = item.end_sample
                        for act in filter(None, (pauses, first)):
                            act()
                        pauses = first = None
        return found


def check_blocks(
    driver: DriverType, sensors: Sequence[Sensor], found: Sequence[Block | Event]
) -> None:
    """See that the blocks of a session follow one another, and that nothing was wrong."""
    wrong = [item for item in found if isinstance(item, Event) and item.kind not in NORMAL_EVENTS]
    assert not wrong
    for sensor in sensors:
        blocks = [b for b in found if isinstance(b, Block) and b.sensor == sensor.name]
        assert blocks, f"no block of {sensor.name}"
        assert blocks[0].first_sample == 0
        assert BlockFlag.CLOCK_RESTART in blocks[0].flags, "the sampling clock begins here"
        dtype = driver.counts_dtype(sensor)
        end, at = 0, 0
        for block in blocks:
            assert block.counts.dtype == dtype
            assert block.counts.shape == (block.n_samples, len(sensor.channels))
            if block.instants_ns is None:
                assert block.first_sample == end, "samples were lost"
            assert block.received.monotonic_ns >= at
            assert block.instants_ns is None or np.all(np.diff(block.instants_ns) > 0)
            end, at = block.end_sample, block.received.monotonic_ns


def _run(coroutine: Coroutine[object, object, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(LIMIT):
            await coroutine

    asyncio.run(limited())


def _at(sensors: Sequence[Sensor], number: int) -> list[Sensor]:
    """Return sensors on another TCP port of this computer."""
    scheme, found, _ = sensors[0].port.partition("://")
    if scheme == "udp":
        pytest.skip("nobody can be a stranger on a UDP port")
    port = f"{scheme if found else 'socket'}://127.0.0.1:{number}"
    return [sensor.model_copy(update={"port": port}) for sensor in sensors]


@contextlib.asynccontextmanager
async def _stranger(garbage: bytes) -> AsyncIterator[int]:
    """Serve something that says the same to whatever comes."""
    tasks: set[asyncio.Task[None]] = set()

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is not None:
            tasks.add(task)
        with contextlib.suppress(ConnectionError):
            writer.write(garbage)
            while await reader.read(4096):
                writer.write(garbage)
        writer.transport.abort()

    async with await asyncio.start_server(talk, "127.0.0.1", 0) as server:
        yield server.sockets[0].getsockname()[1]
    await asyncio.gather(*tasks)


class _Proxy:
    """Stands between driver and device, and holds what passes for a while."""

    def __init__(self, host: str, number: int) -> None:
        self._where = host, number
        self._open = asyncio.Event()
        self._open.set()
        self._tasks: set[asyncio.Task[None]] = set()
        self.port = ""

    async def __aenter__(self) -> _Proxy:
        self._server = await asyncio.start_server(self._connected, "127.0.0.1", 0)
        self.port = f"{SOCKET}127.0.0.1:{self._server.sockets[0].getsockname()[1]}"
        return self

    async def __aexit__(self, *_: object) -> None:
        self._open.set()
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def pause(self) -> None:
        """Hold everything for ``PAUSE`` seconds."""
        self._open.clear()
        asyncio.get_running_loop().call_later(PAUSE, self._open.set)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        device_reader, device_writer = await asyncio.open_connection(*self._where)
        for source, sink in ((reader, device_writer), (device_reader, writer)):
            task = asyncio.create_task(self._pass_on(source, sink))
            self._tasks.add(task)

    async def _pass_on(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        try:
            while received := await source.read(4096):
                await self._open.wait()
                sink.write(received)
        except ConnectionError:
            pass
        finally:
            sink.close()
