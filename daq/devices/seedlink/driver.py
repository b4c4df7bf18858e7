"""Driver for SeedLink servers: seismic digitizers and servers that forward their records.

``port`` is ``seedlink://host`` or ``seedlink://host:port`` (default 18000, with TLS 18500). All
sensors of a port share one connection. The driver uses version 4 of the protocol if the server
offers it, else 3.

A station that the server refuses costs the others nothing: it is requested again, on a second
connection that replaces the first once the server has the station (:mod:`daq.devices.shared_port`).

Blocks state the digitizer's UTC, so no clock model is fitted. After a reconnection each station
continues with the packet after its last one. No samples are lost while the server still has the
packets, and repeated samples are recorded once. Packets that the server no longer has become a gap
of exact length.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, PositiveFloat, Strict

from daq.devices.interface import DeviceInformation, Driver, DriverSettings, Session
from daq.devices.port_rules import host_of, port_label
from daq.devices.seedlink import packets
from daq.devices.seedlink.decoder import SeedLinkDecoder, StreamSelection
from daq.devices.shared_port import Presence
from daq.errors import (
    DeviceError,
    NoAnswerError,
    NotConnectedError,
    WrongDeviceError,
)
from daq.transport.address import USUAL_NUMBERS
from daq.transport.ports import open_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
    from contextlib import AbstractAsyncContextManager

    from daq.bench.model import Sensor
    from daq.devices.seedlink.packets import Version
    from daq.host_clock import HostClock
    from daq.protocols.block import Block, Event, HostTime
    from daq.transport.byte_stream import ByteStream

PORT, TLS_PORT = USUAL_NUMBERS["seedlink"]
SCHEME = "seedlink"
REPLY_TIMEOUT = 10.0

Code = Annotated[str, Field(pattern=r"^[A-Z0-9]{1,8}$")]
ChannelPattern = Annotated[str, Field(pattern=r"^[A-Z0-9?]{3}$")]


class SeedLinkSettings(DriverSettings, strict=True):
    """``[sensors.settings]`` of a station on a SeedLink server."""

    network: Code
    """Code of the network, such as ``"GE"``."""
    station: Code
    """Code of the station."""
    location: Annotated[str, Field(pattern=r"^(\*|--|[A-Z0-9?]{2})$")] = "*"
    """Location code, ``"--"`` if blank, ``"*"`` for any; ``?`` matches any character."""
    channels: Annotated[tuple[ChannelPattern, ...], Strict(strict=False)] | None = None
    """Code of each channel, such as ``["HNZ", "HNN", "HNE"]``, or one pattern for all, such as
    ``["HN?"]``, whose channels are in the order Z, N, E, 1, 2, 3. Default: the names of the
    sensor's channels."""
    protocol: Literal["auto", "3", "4"] = "auto"
    """Version of SeedLink; default: 4 if the server offers it, else 3."""
    tls: bool | None = None
    """Encrypt the connection and verify the server's certificate; default: on port 18500."""
    ca_file: str | None = None
    """File with the certificates (PEM) that are trusted; default: those that the system trusts."""
    credentials: str | None = None
    """File with user and password, or a token (JWT), in one line; its path is absolute or begins
    with ``~``. They are not in the bench file because recordings have a copy of that."""
    samples: Literal["int32", "float32", "float64"] = "int32"
    """Type of the samples in the records."""
    late: PositiveFloat = 10.0
    """Seconds to wait for a late record before a hole becomes a gap."""
    patience: PositiveFloat = 60.0
    """Seconds without a record after which the server is lost and reconnected."""

    def is_encrypted(self, number: int) -> bool:
        """Return whether the connection to a TCP port is encrypted."""
        return number == TLS_PORT if self.tls is None else self.tls

    def context(self) -> ssl.SSLContext:
        """Return what a server's certificate is verified with; raise OSError if unreadable."""
        return ssl.create_default_context(cafile=self.ca_file and Path(self.ca_file).expanduser())

    def check_credentials(self, sensor: Sensor, number: int) -> None:
        """Raise BenchFileError if credentials cannot, or should not, be sent."""
        if self.credentials is None:
            return
        expected = ""
        if not Path(self.credentials).expanduser().is_absolute():
            expected = "expected an absolute path, or one that begins with ~"
        elif self.protocol == "3":
            expected = "SeedLink 3 has no credentials; expected protocol 4"
        elif self.tls is None and not self.is_encrypted(number):
            expected = "others on the network can read them; expected tls = true (or false: send)"
        if expected:
            raise sensor.fault("settings.credentials", expected, self.credentials)

    def read_credentials(self, sensor: Sensor) -> list[str]:
        """Return user and password, or a token; raise BenchFileError if the file has neither."""
        path = Path(self.credentials or "").expanduser()
        try:
            words = path.read_text(encoding="utf-8").split()
            expected = "expected a file of one or two words: a token, or user and password"
        except (OSError, UnicodeDecodeError) as error:
            words, expected = [], f"cannot be read: {error}"
        if len(words) not in {1, 2}:
            raise sensor.fault("settings.credentials", expected, str(path))
        return words

    def selection(self, sensor: Sensor) -> StreamSelection:
        """Return the selection of the sensor's streams; raise BenchFileError if invalid."""
        n_channels = len(sensor.channels)
        codes = self.channels or tuple(channel.name for channel in sensor.channels)
        fits = len(codes) in {1, n_channels} and all(len(code) == 3 for code in codes)
        if not fits or len(set(codes)) < len(codes):
            expected = (
                f"expected the code of each of the sensor's {n_channels} channels, or one pattern"
                ' such as "HN?" for all of them'
            )
            raise sensor.fault("settings.channels", expected, list(codes))
        patterns = tuple((self.location, code) for code in codes)
        rate = sensor.sampling_rate
        return StreamSelection(self.network, self.station, patterns, n_channels, rate)


@dataclass(eq=False)
class SeedLinkSession(Session):
    """A server that sends; all streams of at least one sensor have been received."""

    hint = "the server sends no records; check its digitizer"

    link: _Link
    information: tuple[DeviceInformation, ...]
    resumed: bool

    def __post_init__(self) -> None:
        self.decoder = self.link.decoder
        self.patience = self.link.settings.patience

    async def read(self) -> AsyncIterator[Block | Event]:
        """Yield blocks and events."""
        while self.decoder.waiting:
            yield self.decoder.waiting.pop(0)
        link = self.link
        refused: dict[str, Presence] = {}
        while True:
            for name in link.refused.keys() - refused.keys():  # each connection may refuse others
                refused[name] = Presence(name, link.clock, trouble=link.refused[name])
            received, at = await link.read(refused.values())
            for item in self.decoder.receive(received, at):
                yield item
            self.decoder.check()
            for presence in [one for one in refused.values() if one.is_due]:
                for event in await presence.try_again(partial(link.connect, presence.sensor)):
                    yield event
                for item in link.taken():
                    yield item
            refused = {name: one for name, one in refused.items() if one.is_gone}


@dataclass(eq=False)
class _Link:
    """The connection to a server, which is replaced when the server has a refused station."""

    planned: _Planned
    sensors: Sequence[Sensor]
    clock: HostClock
    decoder: SeedLinkDecoder

    def __post_init__(self) -> None:
        self.label = port_label(self.sensors)
        self.settings = self.planned.settings[self.sensors[0].name]
        self.refused: dict[str, str] = {}
        """Why the server refused the station of a sensor."""
        self.server: _Server
        self._found: list[Block | Event] = []
        self._stack = contextlib.AsyncExitStack()

    async def connect(self, wanted: str = "") -> None:
        """Connect, select all stations that the server has, and close the connection before.

        Raises
        ------
        WrongDeviceError
            If the server refuses the station of the sensor ``wanted``, or all stations.
        """
        settings = self.settings
        host, number = self.planned.address
        tls = None
        if settings.is_encrypted(number):
            try:
                tls = await asyncio.to_thread(settings.context)
            except OSError as error:
                text = f"{self.label}: settings.ca_file cannot be read: {error}"
                raise NotConnectedError(text) from error
        async with contextlib.AsyncExitStack() as stack:
            address = f"socket://{host}:{number}"
            opening = open_port(address, self.clock, label=self.label, tls=tls)
            server = _Server(await stack.enter_async_context(opening), is_encrypted=tls is not None)
            await server.greet(settings.protocol)
            if settings.credentials is not None:
                await server.authenticate(settings.read_credentials(self.sensors[0]))
            chosen = await server.choose(self.planned.selections, self.decoder.last, wanted=wanted)
            before, self._stack = self._stack, stack.pop_all()
        self.server, self.refused = server, chosen
        await before.aclose()
        self.decoder.begin(server.version)
        if server.rest is not None:
            self._found += self.decoder.receive(*server.rest)

    async def read(self, refused: Iterable[Presence]) -> tuple[bytes, HostTime]:
        """Return received bytes, or none when a refused station is due."""
        dues = [one.due_ns for one in refused]
        wait = None
        if dues:
            left = (min(dues) - self.clock.now().monotonic_ns) * 1e-9 / self.clock.speed
            wait = max(0.0, left)
        try:
            async with asyncio.timeout(wait):
                return await self.server.stream.read()
        except TimeoutError as error:
            if isinstance(error, DeviceError):
                raise
            return b"", self.clock.now()

    def taken(self) -> list[Block | Event]:
        """Return the items that came with the replies of a new connection."""
        found, self._found = self._found, []
        return found

    async def aclose(self) -> None:
        """Close the connection."""
        await self._stack.aclose()


class SeedLinkDriver(Driver[SeedLinkSettings]):
    """See :class:`daq.devices.interface.Driver`."""

    name = "seedlink"
    summary = "SeedLink server: seismic digitizers (Centaur, Q330, Raspberry Shake, SeisComP)"
    settings = SeedLinkSettings
    of_the_port = ("protocol", "tls", "ca_file", "credentials", "late", "patience")

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:
        """Return the type of the samples in the records."""
        return np.dtype(self.typed([sensor])[sensor.name].samples)

    def check(self, sensors: Sequence[Sensor]) -> _Planned:
        """Return the plan of the server; raise BenchFileError if it is impossible."""
        first, settings = sensors[0], self.typed(sensors)
        common = settings[first.name]
        host, number = host_of(first, SCHEME, TLS_PORT if common.tls else PORT)
        common.check_credentials(first, number)
        selections = {one.name: settings[one.name].selection(one) for one in sensors}
        return _Planned(settings, selections, (host, number))

    def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AbstractAsyncContextManager[SeedLinkSession]:
        """Connect, select stations, and listen until every stream has been received."""
        return _opened(self.check(sensors), sensors, clock, None)

    def resume(
        self, sensors: Sequence[Sensor], clock: HostClock, before: Session
    ) -> AbstractAsyncContextManager[SeedLinkSession]:
        """Open, and continue after the last received packets."""
        last = before if isinstance(before, SeedLinkSession) else None
        return _opened(self.check(sensors), sensors, clock, last)


@dataclass(frozen=True, slots=True)
class _Planned:
    """Settings of one server in the bench file."""

    settings: dict[str, SeedLinkSettings]
    selections: dict[str, StreamSelection]
    address: tuple[str, int]


@contextlib.asynccontextmanager
async def _opened(
    planned: _Planned, sensors: Sequence[Sensor], clock: HostClock, before: SeedLinkSession | None
) -> AsyncIterator[SeedLinkSession]:
    decoder = before.decoder if before is not None else None
    if decoder is None:
        dtypes = {name: np.dtype(one.samples) for name, one in planned.settings.items()}
        late = planned.settings[sensors[0].name].late
        decoder = SeedLinkDecoder(planned.selections, dtypes, hold=late)
    link = _Link(planned, sensors, clock, decoder)
    async with contextlib.aclosing(link):
        await link.connect()
        decoder.waiting += link.taken()
        await _listen(link)
        yield SeedLinkSession(link, _information(link), resumed=before is not None)


class _Server:
    """Commands to a server, and its replies."""

    def __init__(self, stream: ByteStream, *, is_encrypted: bool) -> None:
        self.version: Version = 3
        self.is_encrypted = is_encrypted
        self.software = self.organisation = ""
        self.rest: tuple[bytes, HostTime] | None = None
        """Bytes received after the last reply."""
        self.stream = stream
        self._buffer = b""
        self._at: HostTime | None = None

    async def greet(self, wanted: str) -> None:
        """Request the server's name, and select the version of the protocol."""
        await self._send("HELLO")
        self.software, self.organisation = await self._line("HELLO"), await self._line("HELLO")
        if "seedlink" not in self.software.lower():
            raise WrongDeviceError(
                f"{self.stream.label}: expected a SeedLink server, got {self.software[:60]!r}"
            )
        offered = packets.speaks_version_4(self.software)
        if wanted == "4" and not offered:
            raise WrongDeviceError(
                f"{self.stream.label}: settings.protocol is 4, but the server does not offer it:"
                f" {self.software[:80]!r}"
            )
        if offered and wanted != "3":
            await self._ask("SLPROTO 4.0")
            self.version = 4

    async def authenticate(self, credentials: Sequence[str]) -> None:
        """State who the client is."""
        if self.version == 3:
            raise WrongDeviceError(
                f"{self.stream.label}: the server speaks SeedLink 3, which has no credentials;"
                " remove settings.credentials"
            )
        await self._ask(packets.auth_command(credentials), shown="AUTH …")

    async def choose(
        self,
        selections: Mapping[str, StreamSelection],
        last: Mapping[str, tuple[int, int]],
        *,
        wanted: str = "",
    ) -> dict[str, str]:
        """Select stations and channels, and start the transfer; return why sensors are refused.

        Raises
        ------
        WrongDeviceError
            If the server refuses the sensor ``wanted``, or all of them.
        """
        stations: dict[str, list[str]] = {}
        for name in sorted(selections, key=lambda name: name != wanted):  # the wanted one first
            stations.setdefault(selections[name].station_id, []).append(name)
        refused: dict[str, WrongDeviceError] = {}
        for station, names in stations.items():
            try:
                await self._choose([selections[name] for name in names], last.get(station))
            except WrongDeviceError as error:
                if wanted in names:
                    raise
                refused |= dict.fromkeys(names, error)
        if len(refused) == len(selections):
            raise next(iter(refused.values()))
        await self._send("END")
        if self._buffer and self._at is not None:
            self.rest = self._buffer, self._at
        return {name: str(error) for name, error in refused.items()}

    async def _choose(
        self, chosen: Sequence[StreamSelection], last: tuple[int, int] | None
    ) -> None:
        """Select one station and its channels."""
        one = chosen[0]
        await self._ask(packets.station_command(self.version, one.network, one.station))
        for pattern in dict.fromkeys(p for selection in chosen for p in selection.patterns):
            await self._ask(packets.select_command(self.version, *pattern))
        await self._ask(packets.data_command(self.version, last))

    async def _ask(self, command: str, *, shown: str = "") -> None:
        await self._send(command)
        reply = await self._line(shown or command)
        if reply != "OK":
            is_about_access = bool(shown) or "AUTH" in reply
            which = "credentials" if is_about_access else "network, station, location and channels"
            raise WrongDeviceError(
                f"{self.stream.label}: expected OK to {shown or command!r}, got {reply[:80]!r};"
                f" check {which}"
            )

    async def _send(self, command: str) -> None:
        await self.stream.write(command.encode("ascii") + packets.LINE_END)

    async def _line(self, command: str) -> str:
        try:
            async with asyncio.timeout(REPLY_TIMEOUT):
                while packets.LINE_END not in self._buffer:
                    if len(self._buffer) > packets.RECORD_SIZE:
                        break
                    received, self._at = await self.stream.read()
                    self._buffer += received
        except TimeoutError as error:
            raise NoAnswerError(
                f"{self.stream.label}: no answer to {command!r} in {REPLY_TIMEOUT:g} s; is it a"
                " SeedLink server?"
            ) from error
        line, found, self._buffer = self._buffer.partition(packets.LINE_END)
        text = line.decode("ascii", "replace").strip()
        if not found:
            raise WrongDeviceError(
                f"{self.stream.label}: expected a line in answer to {command!r}, got {text[:60]!r}"
            )
        return text


async def _listen(link: _Link) -> None:
    """Listen until the streams of every sensor are decided, for at most the patience."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(link.settings.patience / link.clock.speed):
            while not set(link.decoder.silent) <= {*link.refused, *link.decoder.refused}:
                received, at = await link.server.stream.read()
                link.decoder.waiting += link.decoder.receive(received, at)


def _information(link: _Link) -> tuple[DeviceInformation, ...]:
    found, decoder, server = [], link.decoder, link.server
    for sensor in link.sensors:
        if trouble := _trouble(sensor, link):
            found.append(DeviceInformation(sensor=sensor.name, trouble=trouble))
            continue
        details = {
            "server": server.software[:80],
            "organisation": server.organisation[:80],
            "protocol": f"SeedLink {server.version}{', encrypted' if server.is_encrypted else ''}",
            "streams": ", ".join(decoder.streams(sensor.name)),
        }
        name, model, rate = sensor.name, sensor.model, decoder.sampling_rate(sensor.name)
        found.append(DeviceInformation(name, model, sampling_rate=rate, details=details))
    if all(one.trouble for one in found):
        error = WrongDeviceError if decoder.refused else NoAnswerError
        raise error(found[0].trouble)
    return tuple(found)


def _trouble(sensor: Sensor, link: _Link) -> str:
    """Return why a sensor is not read; empty if it is."""
    decoder, name = link.decoder, sensor.name
    if name not in decoder.silent or name in link.refused:
        return link.refused.get(name, "")
    if why := decoder.refused.get(name):
        return f"{link.label}: {name!r}: {why}"
    settings, there = link.planned.settings[name], ", ".join(decoder.heard(name)) or "none"
    return (
        f"{link.label}: the {len(sensor.channels)} streams of {name!r} not received in"
        f" {settings.patience:g} s; of {settings.network}.{settings.station} that match: {there}"
    )


DRIVER = SeedLinkDriver()
