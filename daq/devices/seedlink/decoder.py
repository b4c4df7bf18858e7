"""SeedLink packets into blocks of sensors.

Theory of operation
-------------------
Each record holds samples of one channel and the UTC of the first. The *selection* of a sensor,
patterns for location and channel codes, determines its streams. The available streams are known
only from received records, which are kept until the streams of the sensor are decided. The streams
of a sensor are joined by time (:mod:`daq.protocols.joined_streams`).

Records arrive late, and out of order between channels. A hole in all streams of a sensor stays open
for ``hold`` seconds, then becomes a gap of exact length. The decoder continues over reconnections:
:attr:`SeedLinkDecoder.last` has the last packet of each station, and repeated samples are dropped.

miniSEED records are read and written by libmseed (pymseed).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from daq.devices.seedlink.packets import RECORD_SIZE, WRAP, Packet, PacketFinder, Version
from daq.protocols.block import Block, Event, EventKind, HostTime
from daq.protocols.errors import RemoteProtocolError
from daq.protocols.joined_streams import JoinedStreams
from daq.python_process import install_command

SampleArray: TypeAlias = NDArray[np.int32] | NDArray[np.float32] | NDArray[np.float64]


try:
    from pymseed import MiniSEEDError, MS3Record, nslc2sourceid, sourceid2nslc
except ImportError as error:  # an optional dependency
    raise ImportError(
        f"SeedLink needs pymseed, which is not installed; run: {install_command('seedlink')}"
    ) from error


TEXT, STEIM_2 = 0, 11
"""miniSEED encodings."""
_MAX_DENOMINATOR = 100_000
"""Of sampling rates: records have them as a float, or as a factor and a multiplier."""


@dataclass(frozen=True, slots=True, eq=False)
class WaveRecord:
    """One record with samples.

    Attributes
    ----------
    network, station, location, channel : str
        Codes; the location may be empty.
    start_ns : int
        UTC of the first sample, in ns since 1970.
    sampling_rate : Fraction
        In Hz.
    counts : ndarray, shape (n_samples,)
        int32, float32 or float64, as recorded.
    """

    network: str
    station: str
    location: str
    channel: str
    start_ns: int
    sampling_rate: Fraction
    counts: SampleArray

    @property
    def stream_id(self) -> str:
        """The four codes, joined by dots."""
        return f"{self.network}.{self.station}.{self.location}.{self.channel}"


def decode_record(payload: bytes) -> WaveRecord | None:
    """Decode a miniSEED record; return None if it holds no samples, such as a log.

    Raises
    ------
    RemoteProtocolError
        If the record is invalid.
    """
    try:
        record = MS3Record.parse(payload, unpack_data=True)
        if not record.samplecnt or record.sampletype not in {"i", "f", "d"}:
            return None
        codes = sourceid2nslc(record.sourceid)
        rate = Fraction(record.samprate).limit_denominator(_MAX_DENOMINATOR)
        counts: Any = np.array(record.np_datasamples)  # a copy: the record owns the memory
    except (MiniSEEDError, ValueError, OverflowError) as error:
        raise RemoteProtocolError(f"a miniSEED record that cannot be read: {error}") from error
    if rate <= 0 or not len(counts):
        return None
    return WaveRecord(*codes, record.starttime, rate, counts)


def encode_record(record: WaveRecord) -> list[bytes]:
    """Encode samples as miniSEED 2 records of 512 bytes, Steim 2; int32 only."""
    made = MS3Record(reclen=RECORD_SIZE, encoding=STEIM_2)
    made.formatversion = 2
    made.sourceid = nslc2sourceid(record.network, record.station, record.location, record.channel)
    made.samprate = float(record.sampling_rate)
    made.starttime = record.start_ns
    return list(made.generate(record.counts.astype(np.int32), "i"))


def encode_log(text: str) -> bytes:
    """Encode a miniSEED 2 record of text, as in version 3's reply to INFO."""
    made = MS3Record(reclen=RECORD_SIZE, encoding=TEXT)
    made.formatversion = 2
    made.sourceid = nslc2sourceid("SL", "INFO", "", "INF")
    made.samprate = 0.0
    made.starttime = 0
    (payload,) = made.generate(text.encode("ascii"), "t")
    return bytes(payload)


COMPONENTS = "ZNE123UVWXY"
"""Last characters of channel codes, in the order of the channels that match one pattern."""
_SAME_RATE = 1e-6  # share by which rates may differ
MAX_KEPT = 4096
"""Maximum number of records kept while a sensor's streams are not decided, and number of records
that one stream may then be ahead of the others."""


@dataclass(frozen=True, slots=True)
class StreamSelection:
    """Selection of the streams of a sensor.

    Attributes
    ----------
    network, station : str
        Codes.
    patterns : tuple of (location, channel)
        One per channel, or one for all channels. ``?`` matches any character, ``*`` any location.
    n_channels : int
        Number of channels of the sensor.
    """

    network: str
    station: str
    patterns: tuple[tuple[str, str], ...]
    n_channels: int
    sampling_rate: float | None = None
    """That of the bench file in Hz; records of another rate are refused."""

    @property
    def station_id(self) -> str:
        """Station ID as in packets of version 4."""
        return f"{self.network}_{self.station}"

    def matches(self, record: WaveRecord) -> bool:
        """Return whether the stream of a record matches the selection."""
        if (record.network, record.station) != (self.network, self.station):
            return False
        return any(_fits(record.location, record.channel, pattern) for pattern in self.patterns)

    def streams(self, heard: Counter[str]) -> tuple[str, ...] | None:
        """Return the stream of each channel, or None while it is not decided.

        Parameters
        ----------
        heard : Counter of str
            Number of records by matching stream ID.
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
    """One sensor: its streams if decided, else its kept records."""

    def __init__(self, name: str, selection: StreamSelection, dtype: np.dtype[np.generic]) -> None:
        self.name = name
        self.selection = selection
        self.joined: JoinedStreams | None = None
        self.streams: tuple[str, ...] = ()
        self.heard: Counter[str] = Counter()
        self.kept: list[tuple[WaveRecord, HostTime]] = []
        self._dtype = dtype
        self.refused = ""
        """Why records were refused last; empty if none were."""
        self._refused: set[str] = set()
        self._hole_ns: int | None = None  # host time at which the hole was detected

    def add(
        self, record: WaveRecord, at: HostTime, *, hold: float, in_turn: bool | None
    ) -> Iterator[Block | Event]:
        """Add a record of this sensor's station; yield the completed blocks and events.

        `in_turn`: see :meth:`daq.protocols.joined_streams.JoinedStreams.add`.
        """
        if text := self._unwanted(record):
            self.refused = f"stream {record.stream_id} {text}"
            if record.stream_id not in self._refused:
                self._refused.add(record.stream_id)
                yield Event(self.name, EventKind.REFUSED, self.refused, at)
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
            yield from self._joined(self.joined, record, at, hold=hold, in_turn=in_turn)

    def _joined(
        self,
        joined: JoinedStreams,
        record: WaveRecord,
        at: HostTime,
        *,
        hold: float,
        in_turn: bool | None = None,
    ) -> Iterator[Block | Event]:
        if record.stream_id not in self.streams:
            if record.stream_id not in self._refused:
                self._refused.add(record.stream_id)
                text = f"stream {record.stream_id} belongs to no channel of this sensor"
                yield Event(self.name, EventKind.REFUSED, text, at)
            return
        yield from joined.add(record, at, in_turn=in_turn)
        yield from joined.take(at, awaiting=self._awaits(joined, at, hold), reason="not received")

    def _awaits(self, joined: JoinedStreams, at: HostTime, hold: float) -> bool:
        if not joined.has_hole:
            self._hole_ns = None
            return True  # contiguous samples do not wait, but a hole behind them stays open
        if self._hole_ns is None:
            self._hole_ns = at.monotonic_ns
        return not joined.is_crowded and at.monotonic_ns - self._hole_ns < hold * 1e9

    def _unwanted(self, record: WaveRecord) -> str:
        """Return why a record cannot be recorded; empty if it can."""
        if record.counts.dtype.kind != self._dtype.kind:
            found = record.counts.dtype
            return f"has samples of type {found}; expected {self._dtype}: set settings.samples"
        wanted, rate = self.selection.sampling_rate, float(record.sampling_rate)
        if wanted is not None and abs(rate / wanted - 1) > _SAME_RATE:
            return (
                f"has {rate:g} Hz; expected {wanted:g} Hz: correct sampling_rate, or select other"
                " channels"
            )
        return ""


class SeedLinkDecoder:
    """Decoder of the packets of one server into blocks.

    Parameters
    ----------
    selections : mapping of str to StreamSelection
        Selection of each sensor.
    dtypes : mapping of str to dtype
        Type of the counts of each sensor.
    hold : float
        Time in s for which a hole stays open for a late record.
    """

    def __init__(
        self,
        selections: Mapping[str, StreamSelection],
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
        self._n_jumps: Counter[str] = Counter()  # of the numbers of a station's packets
        self._n_jumps_at: dict[str, int] = {}  # at the latest record of a stream
        self.waiting: list[Block | Event] = []
        """Items that no session has yielded yet: a connection may be lost while it is opened."""
        self.last: dict[str, tuple[int, int]] = {}
        """Last packet of each station, by ``NET_STA``: its number, UTC of its first sample in
        ns."""

    def begin(self, version: Version) -> None:
        """Start decoding the packets of a new connection."""
        self._finder = PacketFinder(version)

    @property
    def silent(self) -> tuple[str, ...]:
        """Names of the sensors whose streams have not all been received."""
        return tuple(name for name, one in self._sensors.items() if one.joined is None)

    @property
    def refused(self) -> dict[str, str]:
        """Why no record of a sensor can be used, by name."""
        found = {name: self._sensors[name].refused for name in self.silent}
        return {name: why for name, why in found.items() if why}

    def heard(self, sensor: str) -> tuple[str, ...]:
        """Return the received streams that match a sensor's selection."""
        return tuple(sorted(self._sensors[sensor].heard))

    def streams(self, sensor: str) -> tuple[str, ...]:
        """Return the stream of each channel of a sensor; empty until decided."""
        return self._sensors[sensor].streams

    def sampling_rate(self, sensor: str) -> float | None:
        """Return the sampling rate of a sensor in Hz, or None before its first record."""
        joined = self._sensors[sensor].joined
        rate = None if joined is None else joined.sampling_rate
        return None if rate is None else float(rate)

    def receive(self, data: bytes, at: HostTime) -> list[Block | Event]:
        """Decode bytes after the handshake, cut anywhere."""
        found: list[Block | Event] = []
        for packet in self._finder.receive(data):
            found += self._packet(packet, at)
        return found

    def check(self) -> None:
        """Raise RemoteProtocolError if the bytes behind the last packet are no packet.

        Called when the items of :meth:`receive` are handed on.
        """
        self._finder.receive(b"")

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
        station = f"{record.network}_{record.station}"
        # Some servers number the packets of all stations together: a jump need not be a loss.
        before = self.last.get(station, (-2, 0))[0]
        if packet.sequence not in {before + 1, (before + 1) % WRAP}:
            self._n_jumps[station] += 1
        # The lost packet may be one of this stream, though the jump was seen in another one.
        jumps, stream_id = self._n_jumps[station], record.stream_id
        in_turn = True if self._n_jumps_at.get(stream_id) == jumps else None
        self.last[station] = packet.sequence, record.start_ns
        for sensor in self._sensors.values():
            if sensor.selection.matches(record):
                self._n_jumps_at[stream_id] = jumps
                yield from sensor.add(record, at, hold=self._hold, in_turn=in_turn)
