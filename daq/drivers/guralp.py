"""Driver for Güralp digitizers: GCF over a serial line, or from a Scream server.

Nothing is configured: a digitizer sends what its own terminal was told. The driver listens until
every stream has been heard, takes the sampling rate from the blocks, acknowledges them and asks
again for those that were lost. Blocks state UTC, so no clock is fitted.

============================ =====================================================================
``port``                     what is spoken
============================ =====================================================================
serial, ``socket://``        frames with block recovery (``link = "serial"``)
``socket://``                a Scream server over TCP (``link = "scream"``)
``udp://host:port``          a Scream server over UDP; lost packets over TCP (``recovery_port``)
============================ =====================================================================

One port may serve several sensors, each with its own streams.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Literal, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat

from daq.datagrams import open_datagrams
from daq.drivers.base import DeviceInformation
from daq.errors import BenchFileError, DeviceError, NoAnswerError, WrongDeviceError
from daq.protocols import scream
from daq.protocols.block import Block, Event
from daq.protocols.gcf import BLOCK_SIZE
from daq.protocols.guralp import ScreamDecoder, SerialDecoder, Streams
from daq.transport import host_and_port, open_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from daq.bench import Sensor
    from daq.clock import HostClock
    from daq.datagrams import DatagramStream
    from daq.protocols.block import HostTime
    from daq.transport import ByteStream

SEND_INTERVAL = 10.0
"""Between two requests to go on sending, s."""
MARGIN = 3.0
"""Beyond two blocks, how long nothing may come, s: streams may be in blocks of unequal length."""
RECOVERY_TIMEOUT = 2.0
COMPONENTS = "ZNEX1234"

StreamId = Annotated[str, Field(pattern="^[0-9A-Z]{1,6}$")]


class GuralpSettings(BaseModel):
    """``[sensors.settings]`` of a Güralp digitizer."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    streams: tuple[StreamId, ...] | None = None
    """Stream ID of each channel, as ``("DEMOZ2", "DEMON2", "DEMOE2")``. If not given, those of the
    one digitizer that is heard, in the order Z, N, E, X of their fifth character."""
    link: Literal["serial", "scream"] = "serial"
    """What a ``socket://`` port speaks."""
    baud_rate: Annotated[int, Field(gt=0)] = 115200
    acknowledge: bool = True
    """Whether blocks are acknowledged and lost ones asked for again (serial)."""
    recovery_port: Annotated[int, Field(ge=0, le=65535)] | None = None
    """TCP port for packets lost over UDP; that of the server if not given, 0 for none."""
    patience: PositiveFloat = 30.0
    """How long to wait until every stream has been heard, s."""
    system_id: str = ""
    """Expected system ID; any, if empty."""


class _Link(Protocol):
    """One way to blocks."""

    @property
    def streams(self) -> Streams: ...
    async def receive(self) -> list[Block | Event]: ...


class _SerialLink:
    def __init__(
        self, stream: ByteStream, ids: dict[str, tuple[str, ...]], *, replies: bool
    ) -> None:
        self._stream = stream
        self._decoder = SerialDecoder(ids, replies=replies)

    @property
    def streams(self) -> Streams:
        return self._decoder.streams

    async def receive(self) -> list[Block | Event]:
        received, at = await self._stream.read()
        found = self._decoder.receive(received, at)
        replies = self._decoder.take_replies()
        if replies:
            await self._stream.write(replies)
        return found


class _TcpLink:
    def __init__(self, stream: ByteStream, ids: dict[str, tuple[str, ...]]) -> None:
        self._stream = stream
        self._decoder = ScreamDecoder(ids)

    @property
    def streams(self) -> Streams:
        return self._decoder.streams

    async def receive(self) -> list[Block | Event]:
        received, at = await self._stream.read()
        return self._decoder.receive(received, at)


class _UdpLink:
    def __init__(
        self,
        stream: DatagramStream,
        ids: dict[str, tuple[str, ...]],
        clock: HostClock,
        recovery: tuple[str, int] | None,
    ) -> None:
        self._stream = stream
        self._clock = clock
        self._recovery = recovery
        self._name = next(iter(ids)) if len(ids) == 1 else ""
        self._decoder = ScreamDecoder(ids)

    @property
    def streams(self) -> Streams:
        return self._decoder.streams

    async def receive(self) -> list[Block | Event]:
        received, at = await self._stream.read()
        found = self._decoder.receive_datagram(received, at)
        if self._decoder.missing and self._recovery is not None:
            found += await self._recover(self._recovery, at)
        return found

    async def _recover(self, where: tuple[str, int], at: HostTime) -> list[Block | Event]:
        """Ask for missing packets over TCP."""
        found: list[Block | Event] = []
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
            self._recovery = None
            text = f"no recovery of lost packets over TCP ({str(error) or 'no answer'})"
            found.append(Event(self._name, "status", text[:200], at))
        return found


async def _packet(reader: asyncio.StreamReader) -> bytes | None:
    """Read one packet of a Scream server over TCP, None where it no longer has it."""
    start = await reader.readexactly(4)
    if start == scream.NOT_AVAILABLE:
        return None
    data = start + await reader.readexactly(BLOCK_SIZE + 1 - len(start))
    size = scream.SIZES.get(data[-1], len(data))
    return data + await reader.readexactly(size - len(data))


class GuralpSession:
    """Streams that have all been heard."""

    def __init__(
        self,
        link: _Link,
        *,
        label: str,
        information: tuple[DeviceInformation, ...],
        heard: list[Block | Event],
    ) -> None:
        self.information = information
        self._link = link
        self._label = label
        self._heard = heard

    async def read(self) -> AsyncIterator[Block | Event]:
        """Yield blocks and events."""
        rates = {i.sensor: i.sampling_rate or 1.0 for i in self.information}
        longest = 1.0  # of a block, s
        found, self._heard = self._heard, []
        while True:
            for item in found:
                if isinstance(item, Block):
                    longest = max(longest, item.n_samples / rates[item.sensor])
                yield item
            patience = 2 * longest + MARGIN
            try:
                async with asyncio.timeout(patience):
                    found = await self._link.receive()
            except TimeoutError as error:
                raise NoAnswerError(
                    f"{self._label}: nothing came for {patience:g} s;"
                    f" expected a block at least every {longest:g} s"
                ) from error


class GuralpDriver:
    """See :class:`daq.drivers.base.DriverType`."""

    name = "guralp"
    summary = "Güralp digitizer: GCF over a serial line, or from a Scream server (UDP, TCP)"
    settings = GuralpSettings
    shares_clock = False

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:  # noqa: ARG002 -- of the seam
        """Return int32."""
        return np.dtype(np.int32)

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[GuralpSession]:
        """Open the port and listen until every stream has been heard."""
        first = sensors[0]
        settings = GuralpSettings.model_validate(first.settings)
        names = ", ".join(repr(sensor.name) for sensor in sensors)
        label = f"sensor {names} on {first.port}"
        ids = _configured(sensors)
        async with contextlib.AsyncExitStack() as stack:
            connect = _Connector(first.port, settings, clock, label)
            link = await connect(stack, ids or {})
            heard: list[Block | Event] = []
            if ids is None:
                ids = {first.name: await _discover(link, first, settings, label, heard)}
                link = connect.again(ids)
            information = await _listen(link, sensors, settings, label, heard)
            yield GuralpSession(link, label=label, information=information, heard=heard)


class _Connector:
    """Opens the port once, and makes links on it."""

    def __init__(self, port: str, settings: GuralpSettings, clock: HostClock, label: str) -> None:
        self._port = port
        self._settings = settings
        self._clock = clock
        self._label = label
        self._bytes: ByteStream | None = None
        self._datagrams: DatagramStream | None = None

    async def __call__(
        self, stack: contextlib.AsyncExitStack, ids: dict[str, tuple[str, ...]]
    ) -> _Link:
        if self._port.startswith("udp://"):
            self._datagrams = await stack.enter_async_context(
                open_datagrams(self._port, self._clock, listen=False, label=self._label)
            )
            asking = asyncio.create_task(_keep_asking(self._datagrams), name=self._label)
            stack.push_async_callback(_stop_asking, asking, self._datagrams)
        else:
            self._bytes = await stack.enter_async_context(
                open_port(
                    self._port, self._clock, label=self._label, baud_rate=self._settings.baud_rate
                )
            )
            if self._settings.link == "scream":
                await self._bytes.write(scream.TCP_SEND)
        return self.again(ids)

    def again(self, ids: dict[str, tuple[str, ...]]) -> _Link:
        """Return a link that joins other streams on the same port."""
        if self._datagrams is not None:
            host, number = host_and_port(self._port)
            recovery = self._settings.recovery_port
            recovery = number if recovery is None else recovery
            where = (host, recovery) if recovery else None
            return _UdpLink(self._datagrams, ids, self._clock, where)
        if self._bytes is None:
            raise DeviceError(f"{self._label}: the port is not open")
        if self._settings.link == "scream":
            return _TcpLink(self._bytes, ids)
        return _SerialLink(self._bytes, ids, replies=self._settings.acknowledge)


async def _keep_asking(stream: DatagramStream) -> None:
    while True:
        stream.send(scream.SEND)
        await asyncio.sleep(SEND_INTERVAL)


async def _stop_asking(asking: asyncio.Task[None], stream: DatagramStream) -> None:
    asking.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await asking
    stream.send(scream.STOP)


def _configured(sensors: Sequence[Sensor]) -> dict[str, tuple[str, ...]] | None:
    """Return the streams of each sensor; None where the one sensor leaves them to be found."""
    ids: dict[str, tuple[str, ...]] = {}
    for sensor in sensors:
        settings = GuralpSettings.model_validate(sensor.settings)
        if settings.streams is None and len(sensors) == 1:
            return None
        if settings.streams is None or len(settings.streams) != len(sensor.channels):
            raise BenchFileError(
                f"sensor {sensor.name!r}: settings.streams = {settings.streams};"
                f" expected a stream ID for each of its {len(sensor.channels)} channels"
            )
        ids[sensor.name] = settings.streams
    often = [stream for stream, n in Counter(s for i in ids.values() for s in i).items() if n > 1]
    if often:
        raise BenchFileError(f"port {sensors[0].port}: streams {often} are given to two channels")
    return ids


async def _discover(
    link: _Link,
    sensor: Sensor,
    settings: GuralpSettings,
    label: str,
    heard: list[Block | Event],
) -> tuple[str, ...]:
    """Listen until one digitizer has sent as many streams as the sensor has channels."""
    n_channels = len(sensor.channels)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(settings.patience):
            while True:
                found = await link.receive()
                heard += [
                    replace(item, sensor=sensor.name)
                    for item in found
                    if isinstance(item, Event) and item.kind != "refused"
                ]
                if not link.streams.repeated:
                    continue
                by_serial: dict[str, list[str]] = {}
                for stream in link.streams.unknown:
                    by_serial.setdefault(stream[:4], []).append(stream)
                for streams in by_serial.values():
                    if len(streams) == n_channels:
                        return tuple(sorted(streams, key=_component))
    streams_heard = ", ".join(sorted(link.streams.unknown)) or "nothing"
    raise NoAnswerError(
        f"{label}: expected {n_channels} streams of one digitizer, heard {streams_heard} in"
        f" {settings.patience:g} s; say which with settings.streams"
    )


def _component(stream: str) -> tuple[int, str]:
    return COMPONENTS.find(stream[4:5]) % (len(COMPONENTS) + 1), stream


async def _listen(
    link: _Link,
    sensors: Sequence[Sensor],
    settings: GuralpSettings,
    label: str,
    heard: list[Block | Event],
) -> tuple[DeviceInformation, ...]:
    """Listen until every stream has come; return what the blocks say."""
    try:
        async with asyncio.timeout(settings.patience):
            while link.streams.silent:
                heard += await link.receive()
    except TimeoutError as error:
        others = ", ".join(sorted(link.streams.unknown)) or "no other"
        raise NoAnswerError(
            f"{label}: streams {', '.join(link.streams.silent)} did not come within"
            f" {settings.patience:g} s; heard {others}"
        ) from error
    return tuple(_identity(link.streams, sensor, label) for sensor in sensors)


def _identity(streams: Streams, sensor: Sensor, label: str) -> DeviceInformation:
    ids = streams.stream_ids(sensor.name)
    rate = streams.sampling_rate(sensor.name)
    system = streams.system(sensor.name)
    wanted = GuralpSettings.model_validate(sensor.settings).system_id
    for what, expected, found in (
        ("serial number", sensor.serial_number, ids[0][:4]),
        ("system ID", wanted, system),
    ):
        if expected and expected != found:
            raise WrongDeviceError(f"{label}: expected {what} {expected!r}, got {found!r}")
    if rate is not None and abs(rate / sensor.sampling_rate - 1) > 1e-9:
        raise WrongDeviceError(
            f"{label}: expected {sensor.sampling_rate:g} Hz, got {rate:g} Hz; set the digitizer, or"
            " sampling_rate"
        )
    return DeviceInformation(
        sensor=sensor.name,
        model="Güralp digitizer",
        serial_number=ids[0][:4],
        sampling_rate=rate,
        details={"system ID": system, "streams": ", ".join(ids)},
    )


DRIVER = GuralpDriver()
