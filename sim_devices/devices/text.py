"""A simulated device that sends delimited text: rows on a line, or datacast packets over UDP.

The device sends the samples of its sensor in the format of its settings
(:mod:`daq.devices.text.decoder`): one row per sample, with time, counter, tag and checksum if the
format has them, or packets of 25 samples of a channel with the time of the first, like a Raspberry
Shake. With the settings ``start`` and ``stop``, the device sends only between these commands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from daq.devices.text.format import (
    SINCE_START,
    TextFormat,
    encode_fields,
    encode_row,
    encode_time,
)
from sim_devices.devices.interface import NEVER, DeviceSpec, Endpoint, Line, Samples, Source, whole

PACKET_SAMPLES = 25
LILY_TAIL = ("194.25", "", "", "N9655")
"""Azimuth, temperature, supply, serial number."""
SUPPLY = 11.96
_NS = 1_000_000_000


class TextDevice(Endpoint):
    """One device; an :class:`~sim_devices.devices.interface.Endpoint`."""

    def __init__(self, device: DeviceSpec, source: Source) -> None:
        (sensor,) = device.sensors
        names = [channel.name for channel in device.channels[sensor] if not channel.auxiliary]
        self._format = TextFormat.of(device.settings, names)
        self._utc_ns = device.utc_ns
        self._start = str(device.settings.get("start", "")).encode()
        self._stop = str(device.settings.get("stop", "")).encode()
        self._tail = LILY_TAIL if device.settings.get("preset") == "lily" else ()
        self._source, self._sensor = source, sensor
        self._samples = Samples(source, device.sensors)
        self._received = b""
        self._sends = False
        self._next = self._counted_from = 0
        self._n_rows = PACKET_SAMPLES if self._format.layout == "channel" else 1

    def connected(self, now: float) -> Sequence[bytes]:
        """Start to send, unless a command is required."""
        self._received = b""
        if not self._start:
            self._begin(now)
        return ()

    def disconnected(self, now: float) -> None:  # noqa: ARG002 -- interface
        """Stop sending."""
        self._sends = False

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Start and stop on commands."""
        self._received = (self._received + received)[-200:]
        stop = self._received.rfind(self._stop) if self._stop else -1
        start = self._received.rfind(self._start) if self._start else -1
        if max(stop, start) >= 0:
            self._received = b""
            self._sends = self._sends and stop < start
            if stop < start:
                self._begin(now)
        return self.due(now)

    def reset(self, now: float) -> None:
        """Simulate a power failure: the counter restarts."""
        if self._sends:
            self._next = self._counted_from = self._samples.first_after(now)

    def _begin(self, now: float) -> None:
        if not self._sends:
            self._next = self._samples.first_after(now)
        self._sends = True

    def due(self, now: float) -> Sequence[bytes]:
        """Return the messages whose samples have been taken."""
        messages: list[bytes] = []
        while self._sends and self.next_due() <= now:
            messages += self._packets() if self._format.layout == "channel" else [self._row()]
            self._next += self._n_rows
        return messages

    def next_due(self) -> float:
        """Return the world time of the last sample of the next message."""
        return self._samples.time(self._next + self._n_rows - 1) if self._sends else NEVER

    def _time(self, index: int) -> str:
        since_start = self._format.time_format in SINCE_START
        start_ns = 0 if since_start else self._utc_ns
        utc_ns = start_ns + round(self._samples.time(index) * _NS)
        return encode_time(self._source.stated_ns(self._sensor, utc_ns), self._format)

    def _written(self, values: Sequence[float]) -> list[str]:
        if self._format.hexadecimal_bits is not None:
            n_bits = self._format.hexadecimal_bits
            return [f"{int(v) % (1 << n_bits):0{n_bits // 4}X}" for v in values]
        if self._format.whole:
            return [str(int(value)) for value in values]
        if self._format.decimal_comma:
            return [f"{value:.9g}".replace(".", ",") for value in values]
        return [f"{value:.9g}" for value in values]

    def _packets(self) -> list[bytes]:
        format_ = self._format
        counts = self._samples.counts(self._next, self._n_rows)
        if format_.whole:
            counts = whole(counts, -(1 << 31), (1 << 31) - 1).astype(float)
        spaced = replace(format_, delimiter=format_.delimiter + " ")
        time = self._time(self._next)
        return [
            encode_fields([f"'{name}'", time, *self._written(column)], spaced)
            for name, column in zip(format_.channel_names, counts.T.tolist(), strict=True)
        ]

    def _row(self) -> bytes:
        format_ = self._format
        counts = self._samples.counts(self._next, 1)
        if format_.whole:
            counts = whole(counts, -(1 << 31), (1 << 31) - 1).astype(float)
        filled: dict[int | str, str] = dict(
            zip(format_.channel_keys, self._written(counts[0].tolist()), strict=True)
        )
        if format_.tag:
            filled[0] = format_.tag
        if format_.time_column is not None:
            filled[format_.time_column] = self._time(self._next)
        if format_.counter_column is not None:
            filled[format_.counter_column] = str(
                (self._next - self._counted_from) % format_.counter_modulus
            )
        filled |= dict(enumerate(self._tail, 1 + max(format_.columns, default=0)))
        celsius = self._source.temperature(self._sensor, self._samples.time(self._next))
        for key, value in (
            (format_.temperature_column, float(celsius)),
            (format_.supply_column, SUPPLY),
        ):
            if key is not None:
                filled[key] = f"{value:6.2f}"
        return encode_row(filled, format_)


def create(device: DeviceSpec, source: Source) -> list[Line]:
    """Return the device's one line."""
    scheme = "udp" if device.port == "udp" else "socket"
    return [Line(TextDevice(device, source), device.port, scheme=scheme)]
