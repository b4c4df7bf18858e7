"""What is on the wires: a log of all bytes of every port, and a replay of such a log.

The log is text, one JSON object a line. ``port`` numbers the openings of ports in their order::

    {"port": 0, "open": "socket://host:4001", "label": "sensor 'A' on …", "at_ns": 1, "utc_ns": 2}
    {"port": 0, "out": "49440d0a", "at_ns": 3, "utc_ns": 4}
    {"port": 0, "in": "…", "at_ns": 5, "utc_ns": 6}
    {"port": 0, "unread": "…", "at_ns": 7, "utc_ns": 8}
    {"port": 0, "lost": "…", "at_ns": 7, "utc_ns": 8}
    {"port": 0, "end": "", "at_ns": 7, "utc_ns": 8}

Times are host times, monotonic and UTC. ``in`` is what one read of the driver returned, so that a
replay returns the same; ``unread`` is what the driver discarded. After ``end`` it closes
its session. :func:`active` is what
:func:`daq.transport.ports.open_port` and :func:`daq.transport.udp.open_datagrams` ask: a context
variable, so that tasks started within :func:`using` have it, and no driver has to pass it on.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from collections import deque
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from daq.errors import NotConnectedError, ReplayError
from daq.host_clock import HostClock
from daq.protocols.block import HostTime
from daq.transport.byte_stream import ByteStream


class PortLog:
    """The lines of one opening of a port."""

    def __init__(self, file: IO[str], number: int, clock: HostClock) -> None:
        self._file, self._number, self._clock = file, number, clock

    def received(self, received: bytes, at: HostTime) -> None:
        """Note bytes that the driver read."""
        self.write(at, **{"in": received.hex()})

    def unread(self, received: bytes) -> None:
        """Note bytes that the driver discarded."""
        if received:
            self.write(None, unread=received.hex())

    def sent(self, payload: bytes) -> None:
        """Note bytes before they are sent."""
        self.write(None, out=payload.hex())

    def lost(self, reason: str) -> None:
        """Note that the port closed by itself."""
        self.write(None, lost=reason)

    def write(self, at: HostTime | None, **fields: str) -> None:
        """Write one line."""
        at = at or self._clock.now()
        line = {"port": self._number, **fields, "at_ns": at.monotonic_ns, "utc_ns": at.utc_ns}
        self._file.write(json.dumps(line, ensure_ascii=False) + "\n")


class WireLog:
    """A log that is written."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._numbers = itertools.count()
        self._by_task: dict[asyncio.Task[Any] | None, list[PortLog]] = {}

    def opened(self, port: str, label: str, clock: HostClock) -> PortLog:
        """Return the log of a port that is opened."""
        log = PortLog(self._file, next(self._numbers), clock)
        log.write(None, open=port, label=label)
        self._by_task.setdefault(asyncio.current_task(), []).append(log)
        return log

    def session_ends(self) -> None:
        """Note that the driver that this task reads closes its session now."""
        for log in self._by_task.pop(asyncio.current_task(), ()):
            log.write(None, end="")


@dataclass(slots=True)
class _Line:
    kind: str
    text: str
    at: HostTime

    @classmethod
    def of(cls, table: dict[str, Any]) -> _Line:
        kind = next(
            kind for kind in ("open", "in", "out", "unread", "lost", "end") if kind in table
        )
        return cls(kind, table[kind], HostTime(table["at_ns"], table["utc_ns"]))


class ReplayClock:
    """Host time of the last line that was replayed; see :class:`daq.host_clock.HostClock`."""

    speed = 1.0
    suspended = 0.0

    def __init__(self, at: HostTime) -> None:
        self.at = at

    def now(self) -> HostTime:
        """Return the time of the last line."""
        return self.at

    def utc_ns(self) -> int:
        """Return UTC of the last line."""
        return self.now().utc_ns


class ReplayedStream(ByteStream):
    """One opening of a port or a socket for datagrams, from a log.

    Each read returns what a read returned, once everything that was sent before it has been sent
    again.
    """

    def __init__(self, label: str, lines: list[_Line], clock: ReplayClock) -> None:
        super().__init__(label, clock)
        self.strangers: set[str] = set()
        self._lines = deque(line for line in lines if line.kind != "unread")
        self._at_clock = clock
        self._to_send = b""
        self._was_sent = asyncio.Event()

    async def read(self) -> tuple[bytes, HostTime]:
        """Return what the next read of the log returned."""
        while self._lines and self._lines[0].kind == "out":
            self._was_sent.clear()
            await self._was_sent.wait()
        line = self._lines.popleft() if self._lines else None
        if line is None or line.kind in {"lost", "end"}:
            self._lines.clear()  # how the session was closed is not replayed
            why = line.text if line is not None and line.text else "end of the log"
            raise NotConnectedError(f"{self.label}: the port closed ({why})")
        self._at_clock.at = line.at
        await asyncio.sleep(0)
        return bytes.fromhex(line.text), line.at

    def bind(self) -> None:
        """Do nothing: the log has the datagrams of the known host."""

    async def write(self, payload: bytes) -> None:
        """Compare what is sent with what was sent."""
        self._to_send += payload
        while self._to_send:
            line = next((line for line in self._lines if line.kind != "in"), None)
            if line is not None and line.kind == "lost" and line is self._lines[0]:
                raise NotConnectedError(f"{self.label}: the port closed ({line.text})")
            if line is None or line.kind != "out":  # the log has only what was sent before
                self._to_send = b""
                return
            expected = bytes.fromhex(line.text)
            if not expected.startswith(self._to_send[: len(expected)]):
                raise ReplayError(f"{self.label}: sent {self._to_send!r}; the log has {expected!r}")
            if len(self._to_send) < len(expected):
                return
            self._lines.remove(line)
            self._at_clock.at = line.at
            self._to_send = self._to_send[len(expected) :]
            self._was_sent.set()

    def expect(self, n_frames: int, size: int = 1, *, n_pending: int = 0) -> None:
        """Do nothing: reads are those of the log."""

    def discard(self) -> int:
        """Do nothing: what was discarded is not read."""
        return 0


class Replay:
    """A log that is replayed: each opening of a port is the next one of that port in the log."""

    def __init__(self, path: str | Path) -> None:
        self._ports: list[tuple[str, list[_Line]]] = []
        for text in Path(path).read_text(encoding="utf-8").splitlines():
            table = json.loads(text)
            line = _Line.of(table)
            if line.kind == "open":
                self._ports.append((line.text, []))
            else:
                self._ports[table["port"]][1].append(line)
        firsts = [lines[0].at for _, lines in self._ports if lines]
        self.clock = ReplayClock(
            min(firsts, key=lambda at: at.monotonic_ns, default=HostTime(0, 0))
        )

    def open(self, port: str, label: str) -> ReplayedStream:
        """Return the next opening of a port."""
        for number, (name, lines) in enumerate(self._ports):
            if name == port:
                del self._ports[number]
                return ReplayedStream(label, lines, self.clock)
        raise ReplayError(f"the log has no further opening of {port}")


_ACTIVE: ContextVar[WireLog | Replay | None] = ContextVar("wire log", default=None)


def session_ends() -> None:
    """Note in the log, if there is one, that the driver that this task reads closes its session."""
    log = active()
    if isinstance(log, WireLog):
        log.session_ends()


def active() -> WireLog | Replay | None:
    """Return the log or the replay of this task."""
    return _ACTIVE.get()


@contextlib.contextmanager
def using(log: WireLog | Replay) -> Iterator[None]:
    """Log or replay all ports that are opened in the context, also by its tasks."""
    token = _ACTIVE.set(log)
    try:
        yield
    finally:
        _ACTIVE.reset(token)


@contextlib.contextmanager
def logging_to(path: str | Path) -> Iterator[None]:
    """Log all ports into a new file.

    Raises
    ------
    FileExistsError
        If the file exists.
    """
    with Path(path).open("x", encoding="utf-8", newline="\n") as file, using(WireLog(file)):
        yield
