"""Driver for Güralp digitizers: GCF over a serial line, or from a Scream server.

The driver configures nothing: the digitizer is configured at its own terminal. The driver listens
until it has received every stream, takes the sampling rate from the blocks, acknowledges blocks and
requests lost ones again. Blocks state UTC, so no clock model is fitted.

============================ =====================================================================
``port``                     protocol
============================ =====================================================================
serial, ``socket://``        frames with block recovery (``link = "serial"``)
``socket://``                a Scream server over TCP (``link = "scream"``)
``udp://host:port``          a Scream server over UDP; lost packets over TCP (``recovery_port``)
============================ =====================================================================

One port may serve several sensors, each with its own streams.

A link (a serial line, or a Scream server over TCP or UDP) receives and decodes bytes. It sends
replies to blocks on a serial line, and requests for packets lost over UDP. The settings of the
bench file are those of the link.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, Field, PositiveFloat

from daq.devices.guralp import scream
from daq.devices.guralp.decoders import FULL_SCALE_COUNTS, ScreamDecoder, SerialDecoder, Streams
from daq.devices.guralp.gcf import BLOCK_SIZE, component, serial_number
from daq.devices.interface import DeviceInformation, Driver, DriverSettings, Session
from daq.devices.port_rules import inputs_of, port_label, require_address
from daq.errors import (
    DeviceError,
    NoAnswerError,
    NotConnectedError,
    WrongDeviceError,
)
from daq.protocols.block import Block, DeviceItem, Event, EventKind, HostTime
from daq.transport.address import host_and_port
from daq.transport.ports import open_port
from daq.transport.udp import DatagramStream, open_datagrams

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Collection, Mapping, Sequence

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock
    from daq.transport.byte_stream import ByteStream


StreamId = Annotated[
    str, Field(pattern="^[0-9A-Z]{1,6}$"), AfterValidator(lambda text: text.lstrip("0") or "0")
]
"""A stream ID without leading zeros, which blocks do not preserve."""


class GuralpSettings(DriverSettings):
    """``[sensors.settings]`` of a Güralp digitizer."""

    streams: tuple[StreamId, ...] | None = None
    """Stream ID of each channel, such as ``("DEMOZ2", "DEMON2", "DEMOE2")``. Default: the streams
    of the only digitizer received, in the order Z, N, E, X of their fifth character."""
    link: Literal["serial", "scream"] = "serial"
    """Protocol of a ``socket://`` port."""
    baud_rate: Annotated[int, Field(gt=0)] = 115200
    acknowledge: bool = True
    """Whether to acknowledge blocks and request lost ones again (serial)."""
    recovery_port: Annotated[int, Field(ge=0, le=65535)] | None = None
    """TCP port for packets lost over UDP; default: the server's port; 0 for no recovery."""
    patience: PositiveFloat = 30.0
    """Seconds to wait for every stream at the start. Later, seconds without a block after which the
    digitizer is lost and reconnected."""
    system_id: str = ""
    """Expected system ID; empty for any."""


SEND_INTERVAL = 10.0
"""Interval of requests to continue sending, s."""
RECOVERY_TIMEOUT = 2.0
FIRST_RETRY, MAX_RETRY = 5.0, 300.0
"""Delay of the next recovery after a failed one, s; doubled after each failure."""


class Link:
    """A link that delivers blocks."""

    def __init__(
        self, stream: ByteStream | DatagramStream, decoder: SerialDecoder | ScreamDecoder
    ) -> None:
        self._stream = stream
        self._decoder = decoder

    @property
    def streams(self) -> Streams:
        """The received streams."""
        return self._decoder.streams

    async def receive(self) -> list[DeviceItem]:
        """Wait for the next bytes and decode them."""
        received, at = await self._stream.read()
        return self._decoder.receive(received, at)

    async def respond(self) -> list[DeviceItem]:
        """Send what the other end needs, once the received blocks are handed on.

        Return the blocks that this recovers. A port that is lost meanwhile raises no error here:
        the next :meth:`receive` returns what had arrived, and then raises.
        """
        return []


class _SerialLink(Link):
    _decoder: SerialDecoder

    async def respond(self) -> list[DeviceItem]:
        replies = self._decoder.take_replies()
        if replies:
            with contextlib.suppress(NotConnectedError):
                await self._stream.write(replies)
        return []


class _UdpLink(Link):
    _decoder: ScreamDecoder

    def __init__(
        self,
        stream: DatagramStream,
        ids: dict[str, tuple[str, ...]],
        clock: HostClock,
        recovery: tuple[str, int] | None,
    ) -> None:
        super().__init__(stream, ScreamDecoder(ids))
        self._clock = clock
        self._recovery = recovery
        self._delay = FIRST_RETRY
        self._retry_ns: int | None = None  # time of the next recovery, after a failed one
        self._at: HostTime | None = None  # arrival of the last datagram
        self._recovered: list[DeviceItem] = []  # not yet handed on
        self._name = next(iter(ids)) if len(ids) == 1 else ""

    async def receive(self) -> list[DeviceItem]:
        received, at = await self._stream.read()
        self._at = at
        return self._decoder.receive_datagram(received, at)

    async def respond(self) -> list[DeviceItem]:
        """Request missing packets over TCP; after a failure, wait before the next request."""
        at, where = self._at, self._recovery
        due = self._retry_ns is None or (at is not None and at.monotonic_ns >= self._retry_ns)
        if at is not None and where is not None and self._decoder.missing and due:
            await self._recover(where, at)
        recovered, self._recovered = self._recovered, []
        return recovered

    async def _recover(self, where: tuple[str, int], at: HostTime) -> None:
        """Add the blocks of missing packets to ``_recovered``."""
        found = self._recovered
        try:
            async with asyncio.timeout(RECOVERY_TIMEOUT):
                reader, writer = await asyncio.open_connection(*where)
                try:
                    for number in self._decoder.missing:
                        writer.write(scream.TCP_AGAIN + number.to_bytes(2, "big"))
                        data = await _packet(reader)
                        if data is None:
                            self._decoder.not_available(number)
                        else:
                            found += self._decoder.receive_datagram(data, self._clock.now())
                finally:
                    writer.close()
                    await writer.wait_closed()
        except (OSError, TimeoutError, asyncio.IncompleteReadError) as error:
            why = str(error) or "no answer"
            text = f"no recovery of lost packets over TCP, next in {self._delay:g} s: {why}"
            self._retry_ns = at.monotonic_ns + round(self._delay * 1e9)
            self._delay = min(2 * self._delay, MAX_RETRY)
            found.append(Event(self._name, EventKind.STATUS, text[:200], at))
            return
        if self._retry_ns is not None:
            text = "lost packets are recovered over TCP again"
            found.append(Event(self._name, EventKind.STATUS, text, at))
        self._retry_ns, self._delay = None, FIRST_RETRY


async def _packet(reader: asyncio.StreamReader) -> bytes | None:
    """Read one packet of a Scream server over TCP; None if the server no longer has it."""
    start = await reader.readexactly(4)
    if start == scream.NOT_AVAILABLE:
        return None
    data = start + await reader.readexactly(BLOCK_SIZE + 1 - len(start))
    size = scream.SIZES.get(data[-1], len(data))
    return data + await reader.readexactly(size - len(data))


@contextlib.asynccontextmanager
async def open_link(
    port: str,
    settings: GuralpSettings,
    clock: HostClock,
    ids: dict[str, tuple[str, ...]],
    *,
    label: str,
) -> AsyncIterator[Link]:
    """Open a port and yield its link."""
    if port.startswith("udp://"):
        async with open_datagrams(port, clock, listen=False, label=label) as datagrams:
            host, number = host_and_port(port)
            recovery = number if settings.recovery_port is None else settings.recovery_port
            asking = asyncio.create_task(_keep_asking(datagrams), name=label)
            try:
                yield _UdpLink(datagrams, ids, clock, (host, recovery) if recovery else None)
            finally:
                await _stop_asking(asking, datagrams)
        return
    async with open_port(port, clock, label=label, baud_rate=settings.baud_rate) as stream:
        if settings.link == "scream":
            await stream.write(scream.TCP_SEND)
            yield Link(stream, ScreamDecoder(ids, patience=0))  # TCP preserves order
        else:
            yield _SerialLink(stream, SerialDecoder(ids, replies=settings.acknowledge))


async def _keep_asking(stream: DatagramStream) -> None:
    while True:
        await stream.write(scream.SEND)
        await asyncio.sleep(SEND_INTERVAL)


async def _stop_asking(asking: asyncio.Task[None], stream: DatagramStream) -> None:
    asking.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await asking
    await stream.write(scream.STOP)


COMPONENTS = "ZNEX1234"


@dataclass(eq=False)
class GuralpSession(Session):
    """A session in which every stream has been received once: see :meth:`listen`."""

    hint = "check the digitizer's terminal, cable and power"

    link: Link
    sensors: Mapping[str, Sensor]
    settings: Mapping[str, GuralpSettings]
    label: str

    def __post_init__(self) -> None:
        self.patience = next(iter(self.settings.values())).patience
        self._buffered: list[DeviceItem] = []
        self._absent: set[str] = set()
        self._refused: set[str] = set()

    async def discover(self) -> None:
        """Listen until one digitizer has sent as many streams as the only sensor has channels."""
        ((name, sensor),) = self.sensors.items()
        n_channels, streams = len(sensor.channels), self.link.streams
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self.patience):
                while True:
                    found = [*await self.link.receive(), *await self.link.respond()]
                    self._buffered += [
                        replace(item, sensor=name) for item in found if isinstance(item, Event)
                    ]
                    if not streams.repeated:
                        continue
                    by_serial: defaultdict[str, list[str]] = defaultdict(list)
                    for stream in streams.unknown:
                        by_serial[serial_number(stream)].append(stream)
                    for own in by_serial.values():
                        if len(own) == n_channels:
                            self._buffered += streams.assign(name, sorted(own, key=_component))
                            return
        received = ", ".join(sorted(streams.unknown)) or "nothing"
        raise NoAnswerError(
            f"{self.label}: expected {n_channels} streams of one digitizer, received {received} in"
            f" {self.patience:g} s; set settings.streams"
        )

    async def listen(self) -> None:
        """Listen until every stream has been received, and identify each sensor.

        If only some of several sensors send, the session starts with them: the others may follow.
        """
        streams = self.link.streams
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self.patience):
                while streams.silent:
                    self._buffered += await self.link.receive()
                    self._buffered += await self.link.respond()
        information = []
        for name in self.sensors:
            silent = set(streams.stream_ids(name)).intersection(streams.silent)
            if not silent:
                information.append(self._identity(name))
                continue
            others = ", ".join(sorted(streams.unknown)) or "no other"
            trouble = (
                f"{self.label}: streams {', '.join(sorted(silent))} of {name!r} not received within"
                f" {self.patience:g} s; received {others}"
            )
            information.append(DeviceInformation(sensor=name, trouble=trouble))
            self._absent.add(name)
        if len(self._absent) == len(information):
            raise NoAnswerError(information[0].trouble)
        self.information = tuple(information)

    def _identity(self, name: str) -> DeviceInformation:
        """Return the information of a sensor; raise WrongDeviceError for another device."""
        streams, sensor = self.link.streams, self.sensors[name]
        ids, system = streams.stream_ids(name), streams.system(name)
        for what, expected, found in (
            ("serial number", sensor.serial_number, serial_number(ids[0])),
            ("system ID", self.settings[name].system_id, system),
        ):
            if expected and expected != found:
                raise WrongDeviceError(
                    f"{self.label}: expected {what} {expected!r}, got {found!r}", found=found
                )
        rate = streams.sampling_rate(name)
        if rate is not None and abs(rate / sensor.sampling_rate - 1) > 1e-9:
            raise WrongDeviceError(
                f"{self.label}: expected {sensor.sampling_rate:g} Hz, got {rate:g} Hz; set the"
                " digitizer, or sampling_rate"
            )
        return DeviceInformation(
            sensor=name,
            model="Güralp digitizer",
            serial_number=serial_number(ids[0]),
            sampling_rate=rate,
            details={"system ID": system, "streams": ", ".join(ids)},
        )

    async def read(self) -> AsyncIterator[DeviceItem]:
        """Yield blocks and events."""
        async with contextlib.aclosing(self._received()) as received:
            async for item in received:
                if isinstance(item, Block):
                    if item.sensor in self._absent:
                        yield self._identified(item)
                    if item.sensor in self._refused:
                        continue
                yield item

    async def _received(self) -> AsyncGenerator[DeviceItem]:
        buffered, self._buffered = self._buffered, []
        for item in buffered:
            yield item
        try:
            while True:
                for item in await self.link.receive():
                    yield item
                for item in await self.link.respond():
                    yield item
        except DeviceError:  # blocks behind a hole need not wait for lost ones any longer
            for item in self.link.streams.release():
                yield item
            raise

    def _identified(self, first: Block) -> Event:
        """Identify a sensor whose streams were missing at the start; exclude a wrong device."""
        self._absent.discard(first.sensor)
        try:
            self._identity(first.sensor)
        except WrongDeviceError as error:
            self._refused.add(first.sensor)
            return Event(first.sensor, EventKind.REFUSED, str(error)[:200], first.received)
        return Event(first.sensor, EventKind.CONNECTED, "its streams come now", first.received)


class GuralpDriver(Driver[GuralpSettings]):
    """See :class:`daq.devices.interface.Driver`."""

    name = "guralp"
    summary = "Güralp digitizer: GCF over a serial line, or from a Scream server (UDP, TCP)"
    settings = GuralpSettings
    of_the_port = GuralpSettings.model_fields.keys() - {"streams", "system_id"}

    def full_scale(self, sensor: Sensor) -> float | None:  # noqa: ARG002 -- interface
        """See :meth:`daq.bench.driver_rules.DriverRules.full_scale`."""
        return FULL_SCALE_COUNTS

    def check(
        self, sensors: Sequence[Sensor]
    ) -> tuple[dict[str, GuralpSettings], dict[str, tuple[str, ...]]]:
        """Return settings and stream IDs of each sensor; a single one may have none yet."""
        every = self.typed(sensors)
        require_address(sensors[0])
        return every, _stream_ids(sensors, every)

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[GuralpSession]:
        """Open the port and listen until every stream has been received."""
        first = sensors[0]
        every, ids = self.check(sensors)
        settings, label = every[first.name], port_label(sensors)
        async with open_link(first.port, settings, clock, ids, label=label) as link:
            session = GuralpSession(link, {one.name: one for one in sensors}, every, label)
            if not ids[first.name]:
                await session.discover()
            await session.listen()
            yield session


def _stream_ids(
    sensors: Sequence[Sensor], every: Mapping[str, GuralpSettings]
) -> dict[str, tuple[str, ...]]:
    """Return the stream IDs of each sensor; a single sensor may have none, to be discovered."""
    if len(sensors) == 1 and every[sensors[0].name].streams is None:
        return {sensors[0].name: ()}

    def given(sensor: Sensor, used: Collection[str]) -> Sequence[str]:
        del used
        streams = every[sensor.name].streams
        if streams is None:
            expected = (
                f"expected a stream ID for each of the sensor's {len(sensor.channels)} channels"
            )
            raise sensor.fault("settings.streams", expected)
        return streams

    return inputs_of(sensors, given, key="streams", what="a stream")


def _component(stream: str) -> tuple[int, str]:
    return COMPONENTS.find(component(stream)) % (len(COMPONENTS) + 1), stream


DRIVER = GuralpDriver()
