"""SeedLink packets into blocks of sensors.

Theory of operation
-------------------
Each record holds samples of one channel and the UTC of the first. Which streams belong to a sensor
its *selection* says, patterns for location and channel codes; which streams there are is learned
from the records, which are kept until then. The streams of a sensor are joined by time
(:mod:`daq.protocols.joined_streams`).

Records come late, and out of order between channels. A hole in all streams of a sensor waits
``hold`` seconds for a late record, then becomes a gap of exact length. The same decoder goes on
over connections: :attr:`SeedLinkDecoder.last` says after which packet of each station, and
samples that come again are dropped.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from daq.protocols.block import Block, Event, EventKind, HostTime
from daq.protocols.errors import RemoteProtocolError
from daq.protocols.joined_streams import JoinedStreams
from daq.protocols.seedlink.packets import PacketFinder
from daq.protocols.seedlink.records import decode_record

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import numpy as np

    from daq.protocols.seedlink.packets import Packet, Version
    from daq.protocols.seedlink.records import WaveRecord

COMPONENTS = "ZNE123UVWXY"
"""Last characters of channel codes, in the order in which a pattern's channels are taken."""
MAX_KEPT = 4096
"""Records kept while it is not known which streams a sensor has, and of one stream while others
have not come as far."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Which streams a sensor has.

    Attributes
    ----------
    network, station : str
        Codes.
    patterns : tuple of (location, channel)
        ``?`` stands for any character, ``*`` for any location. One for each channel, or one for all
        of them.
    n_channels : int
        Of the sensor.
    """

    network: str
    station: str
    patterns: tuple[tuple[str, str], ...]
    n_channels: int

    @property
    def station_id(self) -> str:
        """As in packets of version 4."""
        return f"{self.network}_{self.station}"

    def matches(self, record: WaveRecord) -> bool:
        """Whether a record is of a stream that may be the sensor's."""
        if (record.network, record.station) != (self.network, self.station):
            return False
        return any(_fits(record.location, record.channel, pattern) for pattern in self.patterns)

    def streams(self, heard: Counter[str]) -> tuple[str, ...] | None:
        """Return the stream of each channel, None as long as that is not clear.

        Parameters
        ----------
        heard : Counter of str
            Stream IDs that match, with the number of records.
        """
        if len(self.patterns) == self.n_channels:
            chosen = [[s for s in heard if _id_fits(s, one)] for one in self.patterns]
            if all(len(streams) == 1 for streams in chosen):
                return tuple(streams[0] for streams in chosen)
            return None
        if len(heard) == self.n_channels and max(heard.values()) > 1:
            return tuple(sorted(heard, key=_component))
        return None


def _fits(location: str, channel: str, pattern: tuple[str, str]) -> bool:
    wanted = "" if pattern[0] == "--" else pattern[0]
    return fnmatchcase(location, wanted) and fnmatchcase(channel, pattern[1])


def _id_fits(stream_id: str, pattern: tuple[str, str]) -> bool:
    _, _, location, channel = stream_id.split(".")
    return _fits(location, channel, pattern)


def _component(stream_id: str) -> tuple[int, str]:
    return COMPONENTS.find(stream_id[-1]) % (len(COMPONENTS) + 1), stream_id


class _Sensor:
    """One sensor: its streams once they are known, until then its records."""

    def __init__(self, name: str, selection: Selection, dtype: np.dtype[np.generic]) -> None:
        self.name = name
        self.selection = selection
        self.joined: JoinedStreams | None = None
        self.streams: tuple[str, ...] = ()
        self.heard: Counter[str] = Counter()
        self.kept: list[tuple[WaveRecord, HostTime]] = []
        self._dtype = dtype
        self._refused: set[str] = set()
        self._hole_ns: int | None = None  # when the hole was noticed

    def add(self, record: WaveRecord, at: HostTime, *, hold: float) -> Iterator[Block | Event]:
        """Take a record of this sensor's station; yield what it completes."""
        if record.counts.dtype.kind != self._dtype.kind:
            yield from self._refuse(record, at)
            return
        if self.joined is None:
            self.heard[record.stream_id] += 1
            if len(self.kept) < MAX_KEPT:
                self.kept.append((record, at))
            streams = self.selection.streams(self.heard)
            if streams is None:
                return
            self.streams = streams
            self.joined = JoinedStreams(self.name, streams, max_pending=MAX_KEPT)
            kept, self.kept = self.kept, []
            for earlier, then in kept:
                yield from self._joined(self.joined, earlier, then, hold=hold)
        else:
            yield from self._joined(self.joined, record, at, hold=hold)

    def _joined(
        self, joined: JoinedStreams, record: WaveRecord, at: HostTime, *, hold: float
    ) -> Iterator[Block | Event]:
        if record.stream_id not in self.streams:
            if record.stream_id not in self._refused:
                self._refused.add(record.stream_id)
                text = f"stream {record.stream_id} is of no channel of this sensor"
                yield Event(self.name, EventKind.REFUSED, text, at)
            return
        yield from joined.add(record, at)
        yield from joined.take(at, awaiting=self._awaits(joined, at, hold), reason="not received")

    def _awaits(self, joined: JoinedStreams, at: HostTime, hold: float) -> bool:
        if not joined.has_hole:
            self._hole_ns = None
            return True  # samples that follow one another need not wait; a hole behind them does
        if self._hole_ns is None:
            self._hole_ns = at.monotonic_ns
        return not joined.is_crowded and at.monotonic_ns - self._hole_ns < hold * 1e9

    def _refuse(self, record: WaveRecord, at: HostTime) -> Iterator[Event]:
        if record.stream_id not in self._refused:
            self._refused.add(record.stream_id)
            text = (
                f"stream {record.stream_id} has samples of type {record.counts.dtype}, expected"
                f" {self._dtype}: set settings.samples"
            )
            yield Event(self.name, EventKind.REFUSED, text, at)


class SeedLinkDecoder:
    """Packets of one server into blocks.

    Parameters
    ----------
    selections : mapping of str to Selection
        For each sensor.
    dtypes : mapping of str to dtype
        Type of the counts of each sensor.
    hold : float
        Seconds that a hole waits for a late record.
    """

    def __init__(
        self,
        selections: Mapping[str, Selection],
        dtypes: Mapping[str, np.dtype[np.generic]],
        *,
        hold: float,
    ) -> None:
        self._sensors = {
            name: _Sensor(name, selection, dtypes[name]) for name, selection in selections.items()
        }
        self._hold = hold
        self._finder = PacketFinder(3)
        self._n_unreadable = 0
        self._name = next(iter(selections)) if len(selections) == 1 else ""
        self.last: dict[str, tuple[int, int]] = {}
        """Number of the last packet of each station, by ``NET_STA``, and UTC of its first sample in
        ns."""

    def begin(self, version: Version) -> None:
        """Begin with the packets of a new connection."""
        self._finder = PacketFinder(version)

    @property
    def silent(self) -> tuple[str, ...]:
        """Names of sensors of which not all streams have been heard."""
        return tuple(name for name, one in self._sensors.items() if one.joined is None)

    def heard(self, sensor: str) -> tuple[str, ...]:
        """Return the streams heard that may be a sensor's."""
        return tuple(sorted(self._sensors[sensor].heard))

    def streams(self, sensor: str) -> tuple[str, ...]:
        """Return the stream of each channel of a sensor; none until they are known."""
        return self._sensors[sensor].streams

    def sampling_rate(self, sensor: str) -> float | None:
        """Return the sampling rate of a sensor in Hz, once it is known."""
        joined = self._sensors[sensor].joined
        rate = None if joined is None else joined.sampling_rate
        return None if rate is None else float(rate)

    def receive(self, data: bytes, at: HostTime) -> list[Block | Event]:
        """Take bytes after the handshake, cut anywhere."""
        found: list[Block | Event] = []
        for packet in self._finder.receive(data):
            found += self._packet(packet, at)
        return found

    def _packet(self, packet: Packet, at: HostTime) -> Iterator[Block | Event]:
        if packet.sequence is None or not packet.is_miniseed:
            return
        try:
            record = decode_record(packet.payload)
        except RemoteProtocolError as error:
            self._n_unreadable += 1
            text = f"{str(error)[:150]} ({self._n_unreadable} so far)"
            yield Event(self._name, EventKind.CHECKSUM, text, at)
            return
        if record is None:
            return
        self.last[f"{record.network}_{record.station}"] = packet.sequence, record.start_ns
        for sensor in self._sensors.values():
            if sensor.selection.matches(record):
                yield from sensor.add(record, at, hold=self._hold)
