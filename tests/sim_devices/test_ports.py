"""The simulated ends of wires: an address never leads to somebody else's device."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import time
from collections.abc import Sequence

import pytest

from sim_devices.devices.interface import NEVER, Endpoint, Line
from sim_devices.faults import LineFaults, parse
from sim_devices.server.serve import PseudoTerminal, Served, TcpPort, WorldClock

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")


class Deaf:
    """A device that does nothing."""

    def connected(self) -> None:
        """Nobody cares."""

    def disconnected(self) -> None:
        """Nobody cares."""

    def received(self, data: bytes) -> None:
        """Nobody cares."""


async def test_the_address_is_removed_before_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of a closed terminal is given to the next one made, by whatever process."""
    line = PseudoTerminal(Deaf())
    await line.open()
    assert os.path.lexists(line.address)  # noqa: ASYNC240 - at once, by intent
    there: list[bool] = []
    close = os.close

    def watched(descriptor: int) -> None:
        there.append(os.path.lexists(line.address))
        close(descriptor)

    with monkeypatch.context() as patched:
        patched.setattr("sim_devices.server.serve.os.close", watched)
        line.hang_up()
    assert there == [False]  # the terminal's own end, and nothing before it
    line.restore()
    assert os.path.lexists(line.address)  # noqa: ASYNC240 - at once, by intent
    with monkeypatch.context() as patched:
        patched.setattr("sim_devices.server.serve.os.close", watched)
        await line.close()
    assert not any(there)


class _Echo(Deaf):
    """A device that says what it hears."""

    def __init__(self) -> None:
        self.port = TcpPort(self, "tcp")
        self.left = asyncio.Event()

    def disconnected(self) -> None:
        """Say that the client has left."""
        self.left.set()

    def received(self, data: bytes) -> None:
        """Say it."""
        self.port.send([data])


async def test_a_client_that_connects_before_its_end_is_read_is_served() -> None:
    echo = _Echo()
    port = echo.port
    await port.open()
    number = int(port.address.rpartition(":")[2])
    _, before = await asyncio.open_connection("127.0.0.1", number)
    before.write(b"a")
    reader, again = await asyncio.open_connection("127.0.0.1", number)
    before.close()  # the server has accepted the other by now, or will in this turn
    again.write(b"b")
    assert await reader.read(1) == b"b"
    other, refused = await asyncio.open_connection("127.0.0.1", number)
    with contextlib.suppress(ConnectionError):
        assert await other.read(1) == b""
    echo.left.clear()
    for writer in (again, refused):
        writer.close()
    await echo.left.wait()
    await port.close()


class _Flood(Endpoint):
    """Sends without end while somebody is connected."""

    def __init__(self) -> None:
        self._is_on = False
        self.ended = asyncio.Event()

    def connected(self, now: float) -> Sequence[bytes]:
        """Begin."""
        del now
        self._is_on = True
        return ()

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Ignore it."""
        del received, now
        return ()

    def disconnected(self, now: float) -> None:
        """End."""
        del now
        self._is_on = False
        self.ended.set()

    def due(self, now: float) -> Sequence[bytes]:
        """Return what is sent."""
        del now
        return (b"x" * 65536,) if self._is_on else ()

    def next_due(self) -> float:
        """Return the time of the next unit."""
        return 0.0 if self._is_on else NEVER


async def test_only_what_a_reader_could_have_read_counts_as_sent() -> None:
    """A reader pauses until the cable is pulled: what waits in the device never arrives."""
    sent: list[bytes] = []
    flood = _Flood()
    pulled = parse([{"kind": "disconnect", "at": 0.2, "duration": 60.0}])
    served = Served(
        Line(flood, "tcp"),
        WorldClock(time.monotonic_ns()),
        LineFaults(pulled, "A"),
        lambda *_: None,
        lambda _, unit: sent.append(unit),
    )
    await served.port.open()
    number = int(served.port.address.rpartition(":")[2])
    reader, writer = await asyncio.open_connection("127.0.0.1", number, limit=1024)
    await flood.ended.wait()
    received = 0
    with contextlib.suppress(ConnectionError):
        while piece := await reader.read(1 << 20):
            received += len(piece)
    writer.close()
    await served.close()
    assert 0 < sum(map(len, sent)) <= received < sum(map(len, sent)) + 65536
