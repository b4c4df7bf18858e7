"""A simulated board with one IIO device, served by IIOD: an ADXL355 with a timestamp channel."""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import quoteattr

import numpy as np

from daq.devices.iio.protocol import (
    RATE_ATTRIBUTE,
    TEMPERATURE,
    TIMESTAMP,
    ScanElement,
    ScanLayout,
    mask_of,
)
from sim_devices.devices.interface import NEVER, DeviceSpec, Endpoint, Line, Samples, Source, whole

FORMAT, TIME_FORMAT = "be:s32/32>>0", "le:s64/64>>0"
VERSION = "0.25.v0.25  "
"""Clients of libiio require seven characters of a tag."""
GRAMMAR = (
    "<!ELEMENT context (device)*><!ELEMENT device (channel | attribute)*>"
    "<!ELEMENT channel (scan-element?, attribute*)><!ELEMENT attribute EMPTY>"
    "<!ELEMENT scan-element EMPTY>"
    "<!ATTLIST context name CDATA #REQUIRED description CDATA #IMPLIED>"
    "<!ATTLIST device id CDATA #REQUIRED name CDATA #IMPLIED>"
    "<!ATTLIST channel id CDATA #REQUIRED type (input|output) #REQUIRED>"
    "<!ATTLIST scan-element index CDATA #REQUIRED format CDATA #REQUIRED>"
    "<!ATTLIST attribute name CDATA #REQUIRED>"
)
"""Clients of libiio validate the context."""
OF_TEMPERATURE = ("raw", "offset", "scale")
COUNTS_AT_25, COUNTS_PER_DEGREE = 1885.0, -9.05
"""Of an ADXL355 (its data sheet)."""
EINVAL, ENOENT = -22, -2
MAX_COMMAND = 4096
BUFFER_SECONDS = 4.0
"""Seconds of scans that the board keeps; beyond, scans are lost."""
_NS = 1_000_000_000


class Iiod(Endpoint):
    """The server; an :class:`~sim_devices.devices.interface.Endpoint`."""

    def __init__(self, device: DeviceSpec, source: Source) -> None:
        (sensor,) = device.sensors
        self._source, self._sensor = source, sensor
        names = [f"accel_{c.name}" for c in device.channels[sensor] if not c.auxiliary]
        elements = [ScanElement.of(name, k, FORMAT, ()) for k, name in enumerate(names)]
        self._elements = [*elements, ScanElement.of(TIMESTAMP, len(names), TIME_FORMAT, ())]
        self._rate, self._utc_ns = device.sampling_rate, device.utc_ns
        self._name = device.model or "adxl355"
        self._samples = Samples(source, device.sensors)
        self.reset(0.0)

    def reset(self, now: float) -> None:  # noqa: ARG002 -- interface
        """Close the buffer, and forget the request."""
        self._received = b""
        self._layout: ScanLayout | None = None
        self._mask = ""
        self._wanted = 0  # scans of a READBUF that is not answered yet
        self._next = 0
        self._to_write = 0

    def disconnected(self, now: float) -> None:
        """Close the buffer."""
        self.reset(now)

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Process commands; return the replies."""
        self._received = (self._received + received)[-MAX_COMMAND:]
        answers: list[bytes] = []
        while True:
            if self._to_write:
                if len(self._received) < self._to_write:
                    break
                answers.append(f"{self._to_write}\n".encode())
                self._received, self._to_write = self._received[self._to_write :], 0
            line, found, rest = self._received.partition(b"\n")
            if not found:
                break
            self._received = rest
            words = line.decode("ascii", "replace").split()
            if words:
                answers += self._command(words, now)
        return [*answers, *self.due(now)]

    def _command(self, words: list[str], now: float) -> list[bytes]:  # noqa: PLR0911 -- a table
        match words:
            case ["PRINT"]:
                text = self._context()
                return [f"{len(text)}\n{text}\n".encode()]
            case ["VERSION"]:
                return [f"{VERSION}\n".encode()]
            case ["READ", "iio:device0", name] if name == RATE_ATTRIBUTE:
                text = f"{self._rate:.6f}"
                return [f"{len(text)}\n{text}\n".encode()]
            case ["READ", "iio:device0", "INPUT", channel, name] if (
                channel == TEMPERATURE and name in OF_TEMPERATURE
            ):
                text = self._of_temperature(now)[name]
                return [f"{len(text)}\n{text}\n".encode()]
            case ["WRITE", "iio:device0", name, size] if name == RATE_ATTRIBUTE:
                self._to_write = int(size)
                return []
            case ["OPEN", "iio:device0", _, mask, *_]:
                bits = int(mask, 16)
                chosen = [one for k, one in enumerate(self._elements) if bits >> k & 1]
                self._layout = ScanLayout(chosen) if chosen else None
                self._mask = mask_of(self._elements, [one.channel for one in chosen])
                self._next = self._samples.first_after(now)
                return [b"0\n" if chosen else f"{EINVAL}\n".encode()]
            case ["READBUF", "iio:device0", size] if self._layout is not None:
                self._wanted = int(size) // self._layout.size
                return []
            case ["CLOSE", "iio:device0"]:
                self._layout, self._wanted = None, 0
                return [b"0\n"]
            case ["TIMEOUT", _] | ["SET", _, "BUFFERS_COUNT", _]:
                return [b"0\n"]
            case ["GETTRIG", _]:
                return [f"{ENOENT}\n".encode()]
            case ["EXIT"]:
                self._layout, self._wanted = None, 0
                return []
            case _:
                return [f"{EINVAL}\n".encode()]

    def _of_temperature(self, now: float) -> dict[str, str]:
        celsius = float(self._source.temperature(self._sensor, now))
        raw = round(COUNTS_AT_25 + (celsius - 25.0) * COUNTS_PER_DEGREE)
        offset, scale = 25.0 * COUNTS_PER_DEGREE - COUNTS_AT_25, 1000.0 / COUNTS_PER_DEGREE
        return dict(zip(OF_TEMPERATURE, (f"{raw}", f"{offset:.6f}", f"{scale:.6f}"), strict=True))

    def overflow(self, until: float) -> None:
        """Lose the scans."""
        if self._layout is not None:
            self._next = max(self._next, self._samples.first_after(until))

    def due(self, now: float) -> Sequence[bytes]:
        """Return the buffer that is full."""
        if self._layout is None or not self._wanted:
            return ()
        oldest = self._samples.end_before(now, self._next) - round(BUFFER_SECONDS * self._rate)
        self._next = max(self._next, oldest)
        if self.next_due() > now:
            return ()
        first, n_scans = self._next, self._wanted
        counts = whole(self._samples.counts(first, n_scans), -(1 << 31), (1 << 31) - 1)
        times = [self._samples.time(k) for k in range(first, first + n_scans)]
        values = {one.channel: counts[:, k] for k, one in enumerate(self._elements[:-1])}
        values[TIMESTAMP] = self._utc_ns + np.rint(np.array(times) * _NS).astype(np.int64)
        scans = self._layout.encode(values)
        self._next, self._wanted = first + n_scans, 0
        return [f"{len(scans)}\n{self._mask}\n".encode() + scans]

    def next_due(self) -> float:
        """Return when the buffer is full."""
        if self._layout is None or not self._wanted:
            return NEVER
        return self._samples.time(self._next + self._wanted - 1)

    def _context(self) -> str:
        channels = "".join(
            f'<channel id="{one.channel}" type="input"><scan-element index="{one.index}"'
            f" format={quoteattr(TIME_FORMAT if one.channel == TIMESTAMP else FORMAT)} /></channel>"
            for one in self._elements
        )
        of_temperature = "".join(f'<attribute name="{name}" />' for name in OF_TEMPERATURE)
        channels += f'<channel id="{TEMPERATURE}" type="input">{of_temperature}</channel>'
        return (
            f'<?xml version="1.0" encoding="utf-8"?><!DOCTYPE context [{GRAMMAR}]>'
            '<context name="network" description="simulated">'
            f'<device id="iio:device0" name="{self._name}">{channels}'
            f'<attribute name="{RATE_ATTRIBUTE}" /></device></context>'
        )


def create(device: DeviceSpec, source: Source) -> list[Line]:
    """Return the server's one line."""
    return [Line(Iiod(device, source), "tcp", scheme="iio")]
