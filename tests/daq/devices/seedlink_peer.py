"""A SeedLink 3 server with its own miniSEED, from the manuals; shares no code with the driver."""

from __future__ import annotations

import asyncio
import struct
from datetime import UTC, datetime

RATE, PER_RECORD = 100, 40
EPOCH = datetime(2026, 3, 1, tzinfo=UTC)


def value(station: int, number: int) -> int:
    """Return sample ``number`` of a station."""
    return (number * 7919 + station * 104729) % 100_003


def record(name: str, station: int, turn: int, *, size: int = 256, rate: int = RATE) -> bytes:
    """Return a miniSEED 2 record of 32-bit integers, big-endian, with blockette 1000."""
    begin = EPOCH.timestamp() + turn * PER_RECORD / RATE
    at = datetime.fromtimestamp(begin, UTC)
    start = struct.pack(
        ">HHBBBxH",
        *(at.year, at.timetuple().tm_yday, at.hour, at.minute, at.second),
        round(at.microsecond / 100),
    )
    head = b"%06dD " % (turn % 10**6) + name.encode().ljust(5) + b"  HNZXX" + start
    head += struct.pack(">HhhBBBBiHH", PER_RECORD, rate, 1, 0, 0, 0, 1, 0, 64, 48)
    head += struct.pack(">HHBBBx", 1000, 0, 3, 1, size.bit_length() - 1)
    first = turn * PER_RECORD
    samples = [value(station, first + k) for k in range(PER_RECORD)]
    return (head.ljust(64, b"\0") + struct.pack(f">{PER_RECORD}i", *samples)).ljust(size, b"\0")


class Server:
    """Keeps all records that it made; ``make`` makes one more of each station that is not away.

    ``made`` has the turns of the records of each station, ``refuses`` stations that get ERROR,
    ``rates`` those whose records state another rate; ``hang_up`` closes all connections.
    """

    def __init__(self, stations: list[str], *, size: int = 256, padded: bool = False) -> None:
        self.stations = stations
        self.made: dict[str, list[int]] = {name: [] for name in stations}
        self.refuses: set[str] = set()
        self.away: set[str] = set()
        self.rates: dict[str, int] = {}
        self.n_turns = 0
        self.n_connections = 0
        self._size, self._padded = size, padded
        self._streams: dict[asyncio.StreamWriter, dict[str, int]] = {}
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Server:
        self._server = await asyncio.start_server(self._connected, "127.0.0.1", 0)
        self.port = f"seedlink://127.0.0.1:{self._server.sockets[0].getsockname()[1]}"
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        self.hang_up()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def hang_up(self) -> None:
        """Close all connections."""
        for task in self._tasks:
            task.cancel()

    def make(self) -> None:
        """Make one record of each station, and send what is requested."""
        for name in set(self.stations) - self.away:
            self.made[name].append(self.n_turns)
        self.n_turns += 1
        for writer, following in self._streams.items():
            self._send(writer, following)

    def _send(self, writer: asyncio.StreamWriter, following: dict[str, int]) -> None:
        for name, sent in following.items():
            for number, turn in enumerate(self.made[name][sent:], sent):
                rate = self.rates.get(name, RATE)
                station = self.stations.index(name)
                payload = record(name, station, turn, size=self._size, rate=rate)
                if self._padded:
                    payload = payload.ljust(512, b"\0")
                writer.write(b"SL%06X" % number + payload)
            following[name] = max(sent, len(self.made[name]))

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        self.n_connections += 1
        chosen: dict[str, int] = {}
        name = ""
        try:
            while line := (await reader.readline()).decode().split():
                command, rest = line[0], line[1:]
                if command == "HELLO":
                    writer.write(b"SeedLink v3.1 (own)\r\nbench\r\n")
                    continue
                if command == "END":
                    self._streams[writer] = chosen
                    self._send(writer, chosen)
                    continue
                if command == "STATION":
                    name = rest[0]
                if name in self.refuses or name not in self.stations:
                    writer.write(b"ERROR\r\n")
                    continue
                if command == "DATA":
                    chosen[name] = int(rest[0], 16) if rest else len(self.made[name])
                writer.write(b"OK\r\n")
        except (asyncio.CancelledError, ConnectionError):
            pass
        finally:
            self._streams.pop(writer, None)
            writer.transport.abort()
