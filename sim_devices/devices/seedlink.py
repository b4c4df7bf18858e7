"""A simulated SeedLink server with the stations of a bench, in protocol versions 3 and 4.

Simulated functions: ``HELLO``, ``SLPROTO``, ``AUTH``, ``STATION``, ``SELECT``, ``DATA`` with a
sequence number, ``END``, ``INFO ID``, ``CAT``, ``BYE``; a ring of packets that is filled also while
no client is connected and holds the last ``keep`` seconds. Each sensor is a station; a record holds
100 samples of a channel. The setting ``delays`` delays the records of a channel by a number of
records. With ``tls`` the connection is encrypted; with ``credentials`` only clients that state them
get stations. The fault ``reset`` restarts the server with an empty ring and sequence number 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from fractions import Fraction
from pathlib import Path

import numpy as np

from daq.devices.seedlink.decoder import WaveRecord, encode_log, encode_record
from daq.devices.seedlink.packets import LINE_END, WRAP, Packet, Version, encode_packet
from sim_devices.devices.interface import NEVER, DeviceSpec, Endpoint, Line, Samples, Source, whole

RECORD_SAMPLES = 100
KEEP = 600.0
"""Default duration of the packets in the ring, s."""
HELLO = "SeedLink v3.1 (simulated) :: SLPROTO:4.0 SLPROTO:3.1"
_CAPABILITIES = ("multistation", "window-extraction", "info:id", "info:capabilities")
_INFO = (
    '<?xml version="1.0"?><seedlink software="SeedLink v3.1 (simulated)" organization="huddle">'
    + "".join(f'<capability name="{name}"/>' for name in _CAPABILITIES)
    + "</seedlink>"
)
_NS = 1_000_000_000


class SimulatedStation:
    """One station: its records in the order of sending."""

    def __init__(self, device: DeviceSpec, source: Source, sensor: str) -> None:
        settings = {**device.settings, **device.sensor_settings.get(sensor, {})}
        self.network = str(settings.get("network", "XX"))
        self.station = str(settings["station"])
        location = str(settings.get("location", "00"))
        self._location = "00" if location in {"*", "??"} else location.replace("--", "")
        names = [c.name for c in device.channels[sensor] if not c.auxiliary]
        codes = list(settings.get("channels") or names)
        if len(codes) == 1 and len(names) > 1:
            codes = [codes[0].replace("?", letter) for letter in "ZNE123"[: len(names)]]
        self.channels = codes
        delays = settings.get("delays", {})
        self._delays = [int(delays.get(code, 0)) for code in codes]
        self._rate = source.sampling_rate
        offset = -device.utc_ns % _NS / _NS
        self._source, self._sensor = source.disciplined(offset), sensor
        self._samples = Samples(self._source, [sensor])
        self._utc_ns = device.utc_ns
        self._keep = float(settings.get("keep", KEEP))
        self._turn: int | None = None
        self.began = 0
        """First turn in the ring; in each turn every channel sends one record."""
        count = int(settings.get("first_count", 0))  # of the fault `wrap`, as of a 16-bit counter
        n_left = (65536 - count) // RECORD_SAMPLES * self.n_channels if count else WRAP
        self._first_sequence = WRAP - n_left + 1
        self.next: int | None = None
        """Index of the next packet to the client; None if it has not requested the station."""
        self.selectors: list[str] = []

    @property
    def n_channels(self) -> int:
        """Number of packets per turn."""
        return len(self.channels)

    def turn_at(self, now: float) -> int:
        """Return the first incomplete turn at world time ``now``."""
        if self._turn is None:
            self._turn = max(0, self._samples.first_after(now) // RECORD_SAMPLES - 1)
        while self.due(self._turn) <= now:
            self._turn += 1
        return self._turn

    def due(self, turn: int) -> float:
        """Return the world time at which a turn is complete."""
        return self._samples.time((turn + 1) * RECORD_SAMPLES - 1)

    def oldest(self, now: float) -> int:
        """Return the oldest turn in the ring."""
        kept = math.floor(self._keep * self._rate / RECORD_SAMPLES)
        return max(self.began, self.turn_at(now) - kept)

    def start(self, sequence: int | None, now: float, version: Version) -> int:
        """Return the index of the first packet to send, counted from turn 0."""
        current = self.turn_at(now) * self.n_channels
        if sequence is None:
            return current
        index = sequence - self._first_sequence + self.began * self.n_channels
        if version == 3:
            ahead = (index - current + WRAP // 2) % WRAP - WRAP // 2
            index = current + ahead
        oldest = self.oldest(now) * self.n_channels
        return index if oldest <= index <= current else oldest

    def packet(self, index: int) -> Packet | None:
        """Return a packet; None if its channel is delayed and has not started."""
        turn, column = divmod(index, self.n_channels)
        record = turn - self._delays[column]
        if record < self.began:
            return None
        first = record * RECORD_SAMPLES
        counts = whole(self._samples.counts(first, RECORD_SAMPLES), -(1 << 31), (1 << 31) - 1)
        start_ns = self._utc_ns + round(self._samples.time(first) * _NS)
        codes = self.network, self.station, self._location, self.channels[column]
        stated_ns = self._source.stated_ns(self._sensor, start_ns // 1000 * 1000)
        rate = Fraction(self._rate).limit_denominator(1000)
        made = WaveRecord(*codes, stated_ns, rate, counts[:, column].astype(np.int32))
        (payload,) = encode_record(made)
        sequence = index - self.began * self.n_channels + self._first_sequence
        return Packet(sequence, payload, f"{self.network}_{self.station}")

    def take(self, now: float) -> Iterator[Packet]:
        """Yield the complete packets of the selected channels."""
        if self.next is None:
            return
        begin = max(self.next, self.oldest(now) * self.n_channels)
        self.next = max(begin, self.turn_at(now) * self.n_channels)
        for index in range(begin, self.next):
            packet = self.packet(index)
            if packet is not None and self._is_selected(index):
                yield packet

    def _is_selected(self, index: int) -> bool:
        code = self.channels[index % self.n_channels]
        wanted = [selector.replace("_", "") for selector in self.selectors]
        return not wanted or any(
            fnmatchcase(code, one[-3:]) and fnmatchcase(self._location, one[:-3] or "*")
            for one in wanted
        )


class SeedLinkServer(Endpoint):
    """The server; an :class:`~sim_devices.devices.interface.Endpoint`."""

    def __init__(self, device: DeviceSpec, source: Source) -> None:
        self._stations = [SimulatedStation(device, source, sensor) for sensor in device.sensors]
        self._hello = HELLO if device.settings.get("offers_version_4", True) else HELLO[:24]
        path = device.settings.get("credentials")
        words = Path(path).expanduser().read_text(encoding="utf-8").split() if path else []
        self._wanted = ["USERPASS" if len(words) == 2 else "JWT", *words] if words else None
        self.disconnected(0.0)

    def disconnected(self, now: float) -> None:  # noqa: ARG002 -- interface
        """Stop sending, and wait for commands."""
        self._is_known = self._wanted is None
        self._received = b""
        self._version: Version = 3
        self._chosen: SimulatedStation | None = None
        self._sends = False
        for station in self._stations:
            station.next, station.selectors = None, []

    def reset(self, now: float) -> None:
        """Restart with an empty ring."""
        for station in self._stations:
            station.began = station.turn_at(now)
            if station.next is not None:
                station.next = station.began * station.n_channels

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Process commands; return the replies."""
        self._received += received
        *lines, self._received = self._received.replace(b"\n", b"\r").split(b"\r")
        answers: list[bytes] = []
        for line in lines:
            words = line.decode("ascii", "replace").split()
            if words:
                answers += self._command(words[0].upper(), words[1:], now)
        return [*answers, *self.due(now)]

    def _command(self, command: str, rest: list[str], now: float) -> list[bytes]:
        if command == "HELLO":
            return [(self._hello + "\r\nhuddle\r\n").encode()]
        if command == "INFO":
            return [self._info()]
        if command in {"END", "BYE"}:
            self._sends = command == "END"
            return []
        return [self._configure(command, rest, now) + LINE_END]

    def _configure(self, command: str, rest: list[str], now: float) -> bytes:
        """Carry out a command; return the reply."""
        if command == "AUTH" and self._version == 4:
            self._is_known = self._is_known or rest == self._wanted
            return b"OK" if self._is_known else b"ERROR AUTH not allowed to connect"
        if command == "STATION" and not self._is_known:
            return b"ERROR UNAUTHORIZED authentication required"
        return b"OK" if self._accepts(command, rest, now) else b"ERROR"

    def _accepts(self, command: str, rest: list[str], now: float) -> bool:
        if command == "SLPROTO":
            offered = "SLPROTO:4.0" in self._hello and rest == ["4.0"]
            self._version = 4 if offered else self._version
            return offered
        if command == "STATION":
            names = rest[0].split("_") if self._version == 4 and rest else rest[::-1]
            self._chosen = next(
                (s for s in self._stations if [s.network, s.station] == names), None
            )
            return self._chosen is not None
        if self._chosen is None:
            return command in {"BATCH", "CAPABILITIES", "USERAGENT"}
        if command == "SELECT" and rest:
            self._chosen.selectors.append(rest[0])
            return True
        if command == "DATA":
            sequence = int(rest[0], 10 if self._version == 4 else 16) if rest else None
            self._chosen.next = self._chosen.start(sequence, now, self._version)
            return True
        return False

    def _info(self) -> bytes:
        text = _INFO
        if self._version == 4:
            return encode_packet(Packet(0, text.encode()), 4)
        return encode_packet(Packet(None, encode_log(text)), 3)

    def due(self, now: float) -> Sequence[bytes]:
        """Return the complete packets."""
        sent = [p for s in self._stations for p in s.take(now)] if self._sends else []
        return [encode_packet(packet, self._version) for packet in sent]

    def next_due(self) -> float:
        """Return the world time at which the next packet is complete."""
        if not self._sends:
            return NEVER
        requested = ((s, s.next // s.n_channels) for s in self._stations if s.next is not None)
        return min((station.due(turn) for station, turn in requested), default=NEVER)


def create(device: DeviceSpec, source: Source) -> list[Line]:
    """Return the server's one line."""
    tls = bool(device.settings.get("tls"))
    return [Line(SeedLinkServer(device, source), "tcp", scheme="seedlink", tls=tls)]
