"""UDP ports: datagrams with the host times of their arrival.

This is the counterpart of :mod:`daq.transport.ports` for devices that send packets. Depending on
the driver, ``udp://host:port`` is the address to listen on or that of a server.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator
from typing import cast

from daq.errors import NotConnectedError
from daq.host_clock import HostClock
from daq.protocols.block import HostTime
from daq.transport import wire_log
from daq.transport.address import host_and_port
from daq.transport.byte_stream import StreamLog

MAX_UNREAD = 8192
"""Maximum number of unread datagrams; beyond, the oldest are dropped."""

_MOST_STRANGERS = 16


class DatagramStream(asyncio.DatagramProtocol):
    """The datagrams of one UDP port. Made by :func:`open_datagrams`.

    Anybody can send to a port. Until a host is known, datagrams of all hosts are read; :meth:`bind`
    keeps that of the last one.
    """

    def __init__(self, label: str, clock: HostClock, sender: str | None = None) -> None:
        self.label = label
        self._clock = clock
        self._waiting: deque[tuple[bytes, HostTime, str]] = deque(maxlen=MAX_UNREAD)
        self._arrived = asyncio.Event()
        self._failure: Exception | None = None
        self._sender, self._last = sender, ""
        self.strangers: set[str] = set()
        """Hosts other than the known one; their datagrams are ignored."""
        self._transport: asyncio.DatagramTransport
        self.log: StreamLog | None = None
        """Where everything read and sent is logged."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport."""
        self._transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Store a datagram and its arrival; ignore hosts other than the known one."""
        if self._is_strange(addr[0]):
            return
        self._waiting.append((data, self._clock.now(), addr[0]))
        self._arrived.set()

    def _is_strange(self, host: str) -> bool:
        if self._sender in {None, host}:
            return False
        if len(self.strangers) < _MOST_STRANGERS:
            self.strangers.add(host)
        return True

    def bind(self) -> None:
        """Know the host of the datagram that was read last, if none is known: it was valid."""
        if self._sender is None:
            self._sender = self._last
            kept = [each for each in self._waiting if not self._is_strange(each[2])]
            self._waiting.clear()
            self._waiting.extend(kept)

    def error_received(self, exc: Exception) -> None:
        """Store the failure: the other end refuses datagrams."""
        self._failure = exc
        self._arrived.set()

    async def read(self) -> tuple[bytes, HostTime]:
        """Return the next datagram and its arrival.

        Raises
        ------
        NotConnectedError
            If the other end refuses datagrams.
        """
        while not self._waiting:
            if self._failure is not None:
                raise NotConnectedError(
                    f"{self.label}: datagrams refused ({self._failure});"
                    " check that the server is on, and the port number"
                )
            self._arrived.clear()
            await self._arrived.wait()
        received, at, self._last = self._waiting.popleft()
        if self.log is not None:
            self.log.received(received, at)
        return received, at

    def discard(self) -> None:
        """Discard unread datagrams."""
        if self.log is not None:
            self.log.unread(b"".join(received for received, *_ in self._waiting))
        self._waiting.clear()

    async def write(self, payload: bytes) -> None:
        """Send a datagram to the server."""
        if self.log is not None:
            self.log.sent(payload)
        if not self._transport.is_closing():
            self._transport.sendto(payload)


@contextlib.asynccontextmanager
async def open_datagrams(
    address: str, clock: HostClock, *, listen: bool, label: str, sender: str | None = None
) -> AsyncIterator[DatagramStream]:
    """Open a UDP port and close it on exit.

    Parameters
    ----------
    address
        ``udp://host:port``: an address to listen on (``0.0.0.0`` for any interface), or a server.
    listen
        Whether to listen on the address instead of connecting to it.
    label
        Start of every error message, with sensor and port.
    sender
        Address of the only host whose datagrams are read.

    Raises
    ------
    NotConnectedError
        If listening or connecting fails.
    """
    log = wire_log.active()
    if isinstance(log, wire_log.Replay):
        yield cast("DatagramStream", log.open(address, label))
        return
    try:
        where = host_and_port(address)
        transport, stream = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: DatagramStream(label, clock, sender),
            local_addr=where if listen else None,
            remote_addr=None if listen else where,
        )
    except (OSError, ValueError) as error:
        raise NotConnectedError(f"{label}: {error}") from error
    if log is not None:
        stream.log = log.opened(address, label, clock)
    try:
        yield stream
    finally:
        transport.close()
        await asyncio.sleep(0)  # the loop closes the socket on its next turn
