"""Driver for devices that send delimited text over a serial line, TCP or UDP.

``preset`` selects the format of a known device; other settings override it.
:mod:`daq.devices.text.decoder` describes formats. Ports: serial, ``socket://host:port``, and
``udp://address:port`` to listen on (``udp://0.0.0.0:8888`` for any interface).

Some devices send only after a command: the driver sends ``start`` at the start and ``stop`` at the
end. LILY tiltmeters need ``*9900XYC2`` and ``*9900XYC-OFF``.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from ipaddress import ip_address
from typing import TYPE_CHECKING, Annotated, Literal, cast

from pydantic import Field, PositiveFloat, PositiveInt, Strict, field_validator

from daq.devices import interface
from daq.devices.port_rules import only, port_label
from daq.devices.text.decoder import TextDecoder
from daq.devices.text.format import SINCE_START, TextFormat, is_readable
from daq.devices.text.guess import guess_settings
from daq.errors import DeviceError, toml_value
from daq.protocols.block import Block, DeviceItem, Event, EventKind
from daq.transport.ports import open_port
from daq.transport.udp import open_datagrams

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    import numpy as np

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock
    from daq.protocols.block import HostTime
    from daq.transport.byte_stream import ByteStream
    from daq.transport.udp import DatagramStream


class TextSettings(interface.DriverSettings, strict=True):
    """``[sensors.settings]`` of a device that sends text."""

    preset: Literal["none", "raspberry-shake", "lily"] = "none"
    layout: Literal["row", "labelled", "json", "channel"] | None = None
    """"row": one line per sample of every channel. "labelled": likewise, as ``X:1 Y:2``. "json":
    likewise, as a JSON object. "channel": name, time, samples of one channel."""
    delimiter: str | None = None
    terminator: Annotated[str, Field(min_length=1)] | None = None
    prefix: str | None = None
    suffix: str | None = None
    tag: str | None = None
    """Required value of the first field of a row."""
    columns: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Strict(strict=False)] | None = None
    """Field of each channel, counted from 0 (layout "row"); default: the first fields."""
    channel_names: Annotated[tuple[str, ...], Strict(strict=False)] | None = None
    """Name of each channel in the messages (not in layout "row"); default: the channels' names. In
    layout "json", ``acc.0`` is the first entry of the list ``acc``."""
    time_column: Annotated[int, Field(ge=0)] | str | None = None
    """Field of the time: its number (layout "row") or name."""
    time_format: str | None = None
    """"epoch" (seconds since 1970), a format of Python's strptime (UTC), or "millis" or "micros"
    since the start of the device."""
    counter_column: Annotated[int, Field(ge=0)] | str | None = None
    counter_modulus: PositiveInt | None = None
    temperature_column: Annotated[int, Field(ge=0)] | str | None = None
    """Field of the device's temperature in °C, recorded once a minute (not in layout "channel")."""
    supply_column: Annotated[int, Field(ge=0)] | str | None = None
    """Field of the supply voltage in V, likewise."""
    nmea_checksum: bool | None = None
    whole: bool | None = None
    """Whether samples are integers."""
    decimal_comma: bool | None = None
    """Whether numbers are written ``1,5``."""
    hexadecimal_bits: Annotated[int, Field(ge=4, le=32)] | None = None
    """Bits of samples written in hexadecimal, two's complement."""
    device_time: bool | None = None
    """Whether the device's time is used as clock, instead of the arrival."""
    from_: str | None = Field(
        None,
        alias="from",
        description="IP address of the device, for a port udp://…; default: the host of the first"
        " packet that can be read.",
    )
    start: str = ""
    """Command that starts the device."""
    stop: str = ""
    """Command that stops the device."""
    baud_rate: PositiveInt = 19200
    parity: Literal["N", "E", "O"] = "N"
    patience: PositiveFloat = interface.DEFAULT_PATIENCE
    """Seconds without samples after which the device is lost and reconnected. If the device sends
    less often than every minute, set at least twice its interval."""

    @field_validator("time_format")
    @classmethod
    def _readable(cls, value: str | None) -> str | None:
        known = value is None or value == "epoch" or value in SINCE_START
        if not known and not is_readable(value or ""):
            raise ValueError(
                'expected "epoch", "millis", "micros", or date and time in a format of Python\'s'
                ' strptime, such as "%Y-%m-%d %H:%M:%S.%f"'
            )
        return value

    @field_validator("from_")
    @classmethod
    def _is_address(cls, value: str | None) -> str | None:
        if value is not None:
            try:
                ip_address(value)
            except ValueError:
                raise ValueError('expected an IP address, such as "192.168.1.20"') from None
        return value

    def format_for(self, sensor: Sensor) -> TextFormat:
        """Return the format of these settings.

        Raises
        ------
        BenchFileError
            If the number of columns or names differs from the number of channels, or the settings
            contradict each other.
        """
        n_channels = len(sensor.channels)
        format_ = TextFormat.of(self.model_dump(), [channel.name for channel in sensor.channels])
        places = format_.channel_keys
        if len(places) != n_channels:
            what = "columns" if format_.layout == "row" else "channel_names"
            expected = f"expected one for each of the sensor's {n_channels} channels"
            raise sensor.fault(f"settings.{what}", expected, list(places))
        if format_.terminator in format_.delimiter:
            expected = (
                f"is in settings.delimiter = {toml_value(format_.delimiter)}; expected one that"
                " ends a message, not a field"
            )
            raise sensor.fault("settings.terminator", expected, format_.terminator)
        _check_format(format_, sensor)
        return format_


def _check_format(format_: TextFormat, sensor: Sensor) -> None:
    """Raise BenchFileError for settings that contradict each other."""
    if format_.device_time and format_.layout != "channel" and format_.time_column is None:
        expected = "expected settings.time_column with it"
        raise sensor.fault("settings.device_time", expected, True)
    if format_.device_time and format_.time_format in SINCE_START:
        expected = f"a time in {format_.time_format} is no UTC: leave it out"
        raise sensor.fault("settings.device_time", expected, True)
    if format_.decimal_comma and "," in format_.delimiter and format_.layout == "row":
        expected = "expected another settings.delimiter than a comma with it"
        raise sensor.fault("settings.decimal_comma", expected, True)
    for key in ("time_column", "counter_column"):
        value = getattr(format_, key)
        if value is not None and isinstance(value, int) != (format_.layout == "row"):
            what = "the number" if format_.layout == "row" else "the name"
            expected = f'expected {what} of a field, for layout "{format_.layout}"'
            raise sensor.fault(f"settings.{key}", expected, value)


@dataclass(eq=False)
class TextSession(interface.Session):
    """An open port; the device sends by itself or after the start command."""

    stream: ByteStream | DatagramStream
    sensor: Sensor
    settings: TextSettings
    information: tuple[interface.DeviceInformation, ...]
    decoder: TextDecoder

    def __post_init__(self) -> None:
        self.patience = self.settings.patience
        self._told: set[str] = set()

    @property
    def hint(self) -> str:
        """Advice if no block arrives: on the format, if rows arrive but none is readable."""
        rows = self.decoder.first_rows
        if not rows:
            return (
                "check that the device sends to this computer and port, and that no firewall blocks"
                " it"
                if _is_udp(self.sensor)
                else "check cable, power, settings.baud_rate and settings.start"
            )
        shown = ", ".join(repr(row[:60].decode("ascii", "replace")) for row in rows[:2])
        guess = guess_settings(rows)
        if guess is None:
            return f"received rows that settings do not match: {shown}; check settings.baud_rate"
        would = ", ".join(f"{key} = {toml_value(value)}" for key, value in guess.items())
        return f"received rows that settings do not match: {shown}; these would: {would}"

    async def read(self) -> AsyncIterator[DeviceItem]:
        """Start the device and yield blocks and events."""
        self.stream.discard()
        if self.settings.start:
            await self.stream.write(self.settings.start.encode())
        receive = self._datagram if _is_udp(self.sensor) else self.decoder.receive
        try:
            while True:
                for item in receive(*await self.stream.read()):
                    yield item
        except DeviceError:
            for item in self.decoder.flush():
                yield item
            raise

    def _datagram(self, received: bytes, at: HostTime) -> list[DeviceItem]:
        stream = cast("DatagramStream", self.stream)
        found = self.decoder.receive_datagram(received, at)
        if any(isinstance(item, Block) for item in found):
            stream.bind()
        for host in sorted(stream.strangers - self._told):
            self._told.add(host)
            text = f"datagrams from {host} are ignored: another device sends to this port"
            found.append(Event(self.sensor.name, EventKind.STATUS, text, at))
        return found


class TextDriver(interface.Driver[TextSettings]):
    """See :class:`daq.devices.interface.Driver`."""

    name = "text"
    summary = "Delimited text over serial, TCP or UDP (Raspberry Shake, LILY, any format)"
    settings = TextSettings

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:
        """Return int32 for integers, else float64."""
        return self.typed([sensor])[sensor.name].format_for(sensor).dtype

    def check(self, sensors: Sequence[Sensor]) -> tuple[Sensor, TextSettings, TextFormat]:
        """Return the sensor, its settings and format; raise BenchFileError if they are invalid."""
        sensor = only(sensors, "text comes from one")
        settings = self.typed(sensors)[sensor.name]
        _check_port(sensor, settings)
        return sensor, settings, settings.format_for(sensor)

    @contextlib.asynccontextmanager
    async def open(self, sensors: Sequence[Sensor], clock: HostClock) -> AsyncIterator[TextSession]:
        """Open the port."""
        sensor, settings, format_ = self.check(sensors)
        decoder = TextDecoder(
            sensor.name, format_, sampling_rate=sensor.sampling_rate, joins=not settings.start
        )
        information = interface.DeviceInformation(
            sensor=sensor.name,
            model=sensor.model,
            details={"format": settings.preset if settings.preset != "none" else format_.layout},
        )
        async with _opened(sensor, clock, settings) as stream:
            try:
                yield TextSession(stream, sensor, settings, (information,), decoder)
            finally:
                if settings.stop:
                    with contextlib.suppress(DeviceError):
                        await stream.write(settings.stop.encode())


def _check_port(sensor: Sensor, settings: TextSettings) -> None:
    """Raise BenchFileError for settings that do not apply to the port."""
    if settings.from_ is not None and not _is_udp(sensor):
        expected = f"is for ports udp://…, not {sensor.port}: leave it out"
        raise sensor.fault("settings.from", expected, settings.from_)
    for key in ("start", "stop"):
        if _is_udp(sensor) and (value := getattr(settings, key)):
            expected = f"nothing can be sent to {sensor.port}: leave it out"
            raise sensor.fault(f"settings.{key}", expected, value)


def _is_udp(sensor: Sensor) -> bool:
    return sensor.port.startswith("udp://")


def _opened(
    sensor: Sensor, clock: HostClock, settings: TextSettings
) -> contextlib.AbstractAsyncContextManager[ByteStream | DatagramStream]:
    port, label = sensor.port, port_label([sensor])
    if _is_udp(sensor):
        return open_datagrams(port, clock, listen=True, label=label, sender=settings.from_)
    rate, parity = settings.baud_rate, settings.parity
    return open_port(port, clock, label=label, baud_rate=rate, parity=parity)


DRIVER = TextDriver()
