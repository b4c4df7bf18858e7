"""Connections to the pages: how many there may be, and for how long one may be silent.

Theory of operation
-------------------
Each connection is counted when it is accepted, before TLS and HTTP; all addresses of version 6 that
one person has are one. A connection is idle until all of a request has come, and after its answer.
Where an address, or all of them, have as many connections as they may, the longest idle one gives
way to the new one, or else the one whose peer has left its answer unread for longest; if all others
are being answered, the new one is closed. So who opens thousands and says nothing only pushes out
connections of that kind, and a visitor who asks at once is answered.

An idle connection ends `HEAD` seconds after it began to be idle, however many bytes of it came;
one whose peer does not read ends after `BLOCKED` seconds. A connection is ended by the shutdown of
its socket, which every layer above takes as the end of the stream.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from tui.web.access import network_of

HEAD = 10.0
"""Seconds for the TLS handshake and a request, and between two requests."""
BLOCKED = 60.0
"""Seconds for which a peer may leave a full buffer unread."""
TOTAL, OF_ADDRESS = 512, 64
"""Connections at the same time, at most; fewer if the process may open less than twice as many."""


@dataclass(slots=True, eq=False)
class _Held:
    """A connection; `limit` is the instant at which it ends, infinite while it is answered."""

    raw: socket.socket
    address: str
    limit: float
    is_idle: bool = True


class Connections:
    """The open connections of a server.

    Parameters
    ----------
    total, of_address : int
        Connections at the same time, at most.
    trusted : collection of str
        Addresses of proxies, which bring many visitors: only the total limits them.
    now : callable
        Seconds that never go back.
    """

    def __init__(
        self,
        total: int,
        of_address: int = OF_ADDRESS,
        *,
        trusted: Collection[str] = (),
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._total, self._of_address, self._trusted = total, of_address, frozenset(trusted)
        self._now = now
        self._held: dict[int, _Held] = {}
        """By descriptor, in the order in which they began to be idle."""
        self._n_of: Counter[str] = Counter()
        self.n_open = 0
        """Sockets that are not closed yet, those that were ended included."""

    @property
    def has_to_wait(self) -> bool:
        """Whether sockets that were ended must be closed before there is room for another one."""
        return self.n_open >= self._total and self.n_open > len(self._held)

    def __len__(self) -> int:
        return len(self._held)

    def admit(self, raw: socket.socket, address: str) -> bool:
        """Count a new connection; return False if it must be closed."""
        address = address if address in self._trusted else network_of(address)
        is_over = self._n_of[address] >= self._of_address and address not in self._trusted
        if (is_over or len(self._held) >= self._total) and not self._make_room(
            address if is_over else None
        ):
            return False
        self._held[raw.fileno()] = _Held(raw, address, self._now() + HEAD)
        self._n_of[address] += 1
        return True

    def _make_room(self, address: str | None) -> bool:
        """End the longest idle connection, or one that is not read; of an address if given."""
        rank = {
            number: (not each.is_idle, each.limit)
            for number, each in self._held.items()
            if address in {None, each.address} and each.limit < float("inf")
        }
        if rank:
            self._end(min(rank, key=rank.__getitem__))
        return bool(rank)

    def sweep(self) -> None:
        """End the connections whose time is over."""
        now = self._now()
        for number in [number for number, each in self._held.items() if each.limit < now]:
            self._end(number)

    def _end(self, number: int) -> None:
        raw = self._held[number].raw
        self.forget(number)
        with contextlib.suppress(OSError):  # the peer was faster
            raw.shutdown(socket.SHUT_RDWR)

    def idle(self, number: int) -> None:
        """Give a connection, by its descriptor, the time for another request."""
        if (held := self._held.pop(number, None)) is not None:
            held.is_idle, held.limit = True, self._now() + HEAD
            self._held[number] = held

    def busy(self, number: int, seconds: float = float("inf")) -> None:
        """Note that a connection has a request, and how long it may take from now on."""
        if (held := self._held.get(number)) is not None:
            held.is_idle, held.limit = False, self._now() + seconds

    def forget(self, number: int) -> None:
        """Take a connection that is closed off the count."""
        if (held := self._held.pop(number, None)) is not None:
            self._n_of[held.address] -= 1
            if not self._n_of[held.address]:
                del self._n_of[held.address]

    async def watch(self) -> None:
        """End connections whose time is over, until cancelled."""
        while True:
            self.sweep()
            await asyncio.sleep(1.0)

    def listening(self, address: str, port: int) -> Listening:
        """Return a listening socket whose connections are counted.

        Raises
        ------
        OSError
            Naming address and port, if it cannot be had.
        """
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        try:
            with socket.create_server((address, port), family=family) as made:
                return Listening(self, made.detach(), family)
        except OSError as error:
            raise OSError(error.errno, error.strerror, f"{address} port {port}") from error

    def protocol(self, headers: Mapping[str, str]) -> type[H11Protocol]:
        """Return the protocol that says which connections are idle.

        Parameters
        ----------
        headers : mapping
            Of the answer to bytes that are no request.
        """
        connections = self

        class Counted(H11Protocol):
            _number = -1

            def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn's
                self._number = transport.get_extra_info("socket").fileno()
                super().connection_made(transport)

            def handle_events(self) -> None:
                super().handle_events()
                if self._is_answering and self.conn.their_state is not h11.SEND_BODY:
                    connections.busy(self._number)

            def on_response_complete(self) -> None:
                super().on_response_complete()
                if not self._is_answering:
                    connections.idle(self._number)

            @property
            def _is_answering(self) -> bool:
                return not getattr(self.cycle, "response_complete", True)

            def pause_writing(self) -> None:
                super().pause_writing()
                connections.busy(self._number, BLOCKED)

            def resume_writing(self) -> None:
                super().resume_writing()
                connections.busy(self._number)

            def send_400_response(self, msg: str) -> None:
                with contextlib.suppress(h11.LocalProtocolError):  # in the middle of an answer
                    sent = [("content-type", "text/plain"), ("connection", "close")]
                    head = h11.Response(
                        status_code=400, headers=[*sent, *headers.items()], reason=b"Bad Request"
                    )
                    for event in (head, h11.Data(data=msg.encode()), h11.EndOfMessage()):
                        self.transport.write(self.conn.send(event) or b"")
                if self.cycle is not None:  # the request that is being answered ends here
                    self.cycle.disconnected = True
                    self.cycle.message_event.set()
                self.transport.close()

        return Counted


class Listening(socket.socket):
    """A listening socket whose connections are counted.

    Parameters
    ----------
    connections : Connections
    descriptor : int
    family : int
    """

    def __init__(self, connections: Connections, descriptor: int, family: int) -> None:
        super().__init__(family, socket.SOCK_STREAM, fileno=descriptor)
        self._connections = connections

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection that may stay, and its address.

        Raises
        ------
        ConnectionAbortedError
            If it may not stay: an event loop goes on with the next one.
        BlockingIOError
            If others are to be closed first: an event loop does that, and comes again.
        """
        if self._connections.has_to_wait:
            raise BlockingIOError
        accepted, address = super().accept()
        counted = _Counted(self._connections, accepted.detach(), self.family)
        if not self._connections.admit(counted, str(address[0])):
            counted.close()
            raise ConnectionAbortedError
        return counted, address


class _Counted(socket.socket):
    """A connection that is off the count when it is closed."""

    def __init__(self, connections: Connections, descriptor: int, family: int) -> None:
        super().__init__(family, socket.SOCK_STREAM, fileno=descriptor)
        self._connections = connections
        connections.n_open += 1

    def close(self) -> None:
        """Close the connection."""
        if self.fileno() >= 0:
            self._connections.forget(self.fileno())
            self._connections.n_open -= 1
        super().close()


def most_connections() -> int:
    """Return how many connections this process may hold: half of its descriptors, or `TOTAL`."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return TOTAL
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return TOTAL if most == resource.RLIM_INFINITY else min(TOTAL, max(8, most // 2))
