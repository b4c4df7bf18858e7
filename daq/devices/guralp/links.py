"""Links that transport GCF blocks: a serial line, a Scream server over TCP or UDP.

A link receives and decodes bytes, and sends what the other end needs: replies to blocks on a serial
line, requests for packets lost over UDP. The settings of the bench file are those of the link.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, Field, PositiveFloat

from daq.devices.guralp import scream
from daq.devices.guralp.decoders import ScreamDecoder, SerialDecoder
from daq.devices.guralp.gcf import BLOCK_SIZE
from daq.devices.interface import DriverSettings
from daq.errors import NotConnectedError
from daq.protocols.block import DeviceItem, Event, EventKind
from daq.transport.address import host_and_port
from daq.transport.ports import open_port
from daq.transport.udp import open_datagrams

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from daq.devices.guralp.streams import Streams
    from daq.host_clock import HostClock
    from daq.protocols.block import HostTime
    from daq.transport.byte_stream import ByteStream
    from daq.transport.udp import DatagramStream

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
