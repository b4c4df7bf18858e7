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
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import replace
from typing import TYPE_CHECKING

from daq.devices.guralp.gcf import component, serial_number
from daq.devices.guralp.links import GuralpSettings, open_link
from daq.devices.guralp.streams import FULL_SCALE_COUNTS
from daq.devices.interface import DeviceInformation, Driver, Session
from daq.devices.port_rules import inputs_of, port_label, require_address
from daq.errors import (
    ABSENT,
    BenchFileError,
    DeviceError,
    FileFault,
    NoAnswerError,
    WrongDeviceError,
)
from daq.protocols.block import Block, DeviceItem, Event, EventKind

if TYPE_CHECKING:
    from collections.abc import (
        AsyncGenerator,
        AsyncIterator,
        Callable,
        Collection,
        Mapping,
        Sequence,
    )

    from daq.bench.model import Sensor
    from daq.devices.guralp.links import Link
    from daq.devices.guralp.streams import Streams
    from daq.host_clock import HostClock

COMPONENTS = "ZNEX1234"


class GuralpSession(Session):
    """A session in which every stream has been received once."""

    hint = "check the digitizer's terminal, cable and power"

    def __init__(
        self,
        link: Link,
        *,
        patience: float,
        information: tuple[DeviceInformation, ...],
        buffered: list[DeviceItem],
        identify: Callable[[str], DeviceInformation],
    ) -> None:
        self.information = information
        self.patience = patience
        self._link = link
        self._buffered = buffered
        self._identify = identify
        self._absent = {one.sensor for one in information if one.trouble}
        self._refused: set[str] = set()

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
                for item in await self._link.receive():
                    yield item
                for item in await self._link.respond():
                    yield item
        except DeviceError:  # blocks behind a hole need not wait for lost ones any longer
            for item in self._link.streams.release():
                yield item
            raise

    def _identified(self, first: Block) -> Event:
        """Identify a sensor whose streams were missing at the start; exclude a wrong device."""
        self._absent.discard(first.sensor)
        try:
            self._identify(first.sensor)
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
            buffered: list[DeviceItem] = []
            if not ids[first.name]:
                await _discover(link, first, settings, label, buffered)
            by_name = {sensor.name: sensor for sensor in sensors}
            yield GuralpSession(
                link,
                patience=settings.patience,
                information=await _listen(link, sensors, every, label, buffered),
                buffered=buffered,
                identify=lambda name: _identity(
                    link.streams, by_name[name], every[name].system_id, label
                ),
            )


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
            raise BenchFileError(FileFault("settings.streams", expected, ABSENT, sensor.name))
        return streams

    return inputs_of(sensors, given, key="streams", what="a stream")


async def _discover(
    link: Link,
    sensor: Sensor,
    settings: GuralpSettings,
    label: str,
    buffered: list[DeviceItem],
) -> None:
    """Listen until one digitizer has sent as many streams as the sensor has channels."""
    n_channels = len(sensor.channels)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(settings.patience):
            while True:
                found = [*await link.receive(), *await link.respond()]
                buffered += [
                    replace(item, sensor=sensor.name) for item in found if isinstance(item, Event)
                ]
                if not link.streams.repeated:
                    continue
                by_serial: dict[str, list[str]] = {}
                for stream in link.streams.unknown:
                    by_serial.setdefault(serial_number(stream), []).append(stream)
                for streams in by_serial.values():
                    if len(streams) == n_channels:
                        buffered += link.streams.assign(
                            sensor.name, sorted(streams, key=_component)
                        )
                        return
    received = ", ".join(sorted(link.streams.unknown)) or "nothing"
    raise NoAnswerError(
        f"{label}: expected {n_channels} streams of one digitizer, received {received} in"
        f" {settings.patience:g} s; set settings.streams"
    )


def _component(stream: str) -> tuple[int, str]:
    return COMPONENTS.find(component(stream)) % (len(COMPONENTS) + 1), stream


async def _listen(
    link: Link,
    sensors: Sequence[Sensor],
    every: Mapping[str, GuralpSettings],
    label: str,
    buffered: list[DeviceItem],
) -> tuple[DeviceInformation, ...]:
    """Listen until every stream has been received; return the information of each sensor.

    If only some of several sensors send, the session starts with them: the others may follow.
    """
    patience = every[sensors[0].name].patience
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(patience):
            while link.streams.silent:
                buffered += await link.receive()
                buffered += await link.respond()
    information = []
    for sensor in sensors:
        silent = set(link.streams.stream_ids(sensor.name)).intersection(link.streams.silent)
        if not silent:
            wanted = every[sensor.name].system_id
            information.append(_identity(link.streams, sensor, wanted, label))
            continue
        others = ", ".join(sorted(link.streams.unknown)) or "no other"
        trouble = (
            f"{label}: streams {', '.join(sorted(silent))} of {sensor.name!r} not received within"
            f" {patience:g} s; received {others}"
        )
        information.append(DeviceInformation(sensor=sensor.name, trouble=trouble))
    if all(one.trouble for one in information):
        raise NoAnswerError(information[0].trouble)
    return tuple(information)


def _identity(streams: Streams, sensor: Sensor, system_id: str, label: str) -> DeviceInformation:
    ids = streams.stream_ids(sensor.name)
    rate = streams.sampling_rate(sensor.name)
    system = streams.system(sensor.name)
    for what, expected, found in (
        ("serial number", sensor.serial_number, serial_number(ids[0])),
        ("system ID", system_id, system),
    ):
        if expected and expected != found:
            raise WrongDeviceError(
                f"{label}: expected {what} {expected!r}, got {found!r}", found=found
            )
    if rate is not None and abs(rate / sensor.sampling_rate - 1) > 1e-9:
        raise WrongDeviceError(
            f"{label}: expected {sensor.sampling_rate:g} Hz, got {rate:g} Hz; set the digitizer, or"
            " sampling_rate"
        )
    return DeviceInformation(
        sensor=sensor.name,
        model="Güralp digitizer",
        serial_number=serial_number(ids[0]),
        sampling_rate=rate,
        details={"system ID": system, "streams": ", ".join(ids)},
    )


DRIVER = GuralpDriver()
