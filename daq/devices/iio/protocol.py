"""Linux IIO over the network: contexts, scans and their layout (IIOD, protocol of libiio 0.x).

Theory of operation
-------------------
Commands are lines; most replies are a line with an integer, negative for an error (-errno)::

    PRINT                          → length, then so many bytes of XML and a newline
    READ dev [INPUT channel] attr  → length, then the value and a newline
    WRITE dev [INPUT channel] attr n, then n bytes → length
    OPEN dev n_samples mask        → 0; the mask has a bit for each enabled channel
    READBUF dev n_bytes            → length, the mask (the first time), bytes; until all are sent
    CLOSE dev                      → 0

A scan holds the enabled channels in the order of their index, each aligned to its own size, padded
to the largest. The format of a channel is ``le:s24/32>>8``: byte order, sign (capital: already
extended), bits of the value, bits stored, shift. The channel ``timestamp`` is the system's UTC in
ns; a buffer that overflows drops scans, and only these times show it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from daq.protocols.errors import RemoteProtocolError

TIMESTAMP = "timestamp"
RATE_ATTRIBUTE = "sampling_frequency"
TEMPERATURE = "temp"
"""Channel of the device's temperature, whose attributes the kernel's IIO interface defines."""
MAX_CONTEXT = 1 << 22
_FORMAT = re.compile(r"(le|be):([sSuU])(\d+)/(8|16|32|64)(?:X\d+)?(?:>>(\d+))?")


@dataclass(frozen=True, slots=True)
class ScanElement:
    """One channel of a buffer."""

    channel: str
    index: int
    byte_order: str
    is_signed: bool
    bits: int
    size: int
    """Bytes."""
    shift: int
    attributes: tuple[str, ...] = ()

    @classmethod
    def of(cls, channel: str, index: int, text: str, attributes: Sequence[str]) -> ScanElement:
        """Parse the format of a channel."""
        found = _FORMAT.fullmatch(text)
        if found is None or not 0 < int(found[3]) <= int(found[4]):
            raise RemoteProtocolError(f"channel {channel}: format {text[:40]!r} is not known")
        bits, size, shift = int(found[3]), int(found[4]) // 8, int(found[5] or 0)
        is_signed = found[2] in "sS"
        return cls(channel, index, found[1], is_signed, bits, size, shift, tuple(attributes))


@dataclass(frozen=True, slots=True)
class IioDevice:
    """One device of a context."""

    id: str
    name: str
    elements: tuple[ScanElement, ...]
    attributes: tuple[str, ...]
    of_temperature: tuple[str, ...] = ()
    """Attributes of the channel `TEMPERATURE`."""


def parse_context(text: bytes) -> list[IioDevice]:
    """Return the devices of a context.

    Raises
    ------
    RemoteProtocolError
        If this is no context.
    """
    if b"<!ENTITY" in text:
        raise RemoteProtocolError("the context defines entities")
    try:
        root = ET.fromstring(text.decode("utf-8", "replace"))  # noqa: S314 -- no entities
    except ET.ParseError as error:
        raise RemoteProtocolError(f"the context is no XML: {error}") from error
    devices = []
    for device in root.iter("device"):
        elements = []
        of_temperature: tuple[str, ...] = ()
        for channel in device.iter("channel"):
            names = tuple(one.get("name", "") for one in channel.iter("attribute"))
            scan = channel.find("scan-element")
            if channel.get("type") == "input" and channel.get("id") == TEMPERATURE:
                of_temperature = names
            if scan is not None and channel.get("type") == "input":
                index, text_ = scan.get("index", ""), scan.get("format", "")
                if not index.isdigit() or len(index) > 4:
                    raise RemoteProtocolError(f"scan index {index[:20]!r} is no number")
                elements.append(ScanElement.of(channel.get("id", ""), int(index), text_, names))
        attributes = tuple(one.get("name", "") for one in device.findall("attribute"))
        found = tuple(sorted(elements, key=lambda one: one.index))
        ids = device.get("id", ""), device.get("name", "")
        devices.append(IioDevice(*ids, found, attributes, of_temperature))
    return devices


def celsius(values: Mapping[str, float]) -> float | None:
    """Return the temperature in °C from the attributes of its channel; None if they are too few.

    They are in millidegrees: ``input``, or ``raw`` plus ``offset``, times ``scale`` (the kernel's
    ``Documentation/ABI/testing/sysfs-bus-iio``).
    """
    if "input" in values:
        return values["input"] / 1000.0
    if "raw" in values and "scale" in values:
        return (values["raw"] + values.get("offset", 0.0)) * values["scale"] / 1000.0
    return None


def mask_of(elements: Sequence[ScanElement], wanted: Sequence[str]) -> str:
    """Return the mask of channels in hexadecimal; bits count all channels of the device."""
    bits = sum(1 << k for k, one in enumerate(elements) if one.channel in wanted)
    n_words = max(1, -(-len(elements) // 32))
    return f"{bits:0{8 * n_words}x}"


class ScanLayout:
    """Where the enabled channels are in a scan."""

    def __init__(self, elements: Sequence[ScanElement]) -> None:
        self.elements = tuple(sorted(elements, key=lambda one: one.index))
        self.offsets: dict[str, int] = {}
        end = 0
        for one in self.elements:
            start = -(-end // one.size) * one.size
            self.offsets[one.channel] = start
            end = start + one.size
        largest = max(one.size for one in self.elements)
        self.size = -(-end // largest) * largest
        """Bytes of a scan."""

    def decode(self, scans: bytes, channel: str) -> NDArray[np.int64]:
        """Return the values of one channel, shape (n_scans,)."""
        one = next(one for one in self.elements if one.channel == channel)
        rows = np.frombuffer(scans, np.uint8).reshape(-1, self.size)
        start = self.offsets[channel]
        order = "<" if one.byte_order == "le" else ">"
        stored = np.ascontiguousarray(rows[:, start : start + one.size])
        values = stored.view(f"{order}u{one.size}").ravel().astype(np.uint64)
        values = values >> np.uint64(one.shift)
        unused = np.uint64(64 - one.bits)
        shifted = (values << unused).view(np.int64 if one.is_signed else np.uint64)
        return np.asarray(shifted >> (64 - one.bits if one.is_signed else unused)).astype(np.int64)

    def encode(self, values: dict[str, NDArray[Any]]) -> bytes:
        """Return scans; the simulator sends them."""
        n_scans = len(next(iter(values.values())))
        rows = np.zeros((n_scans, self.size), np.uint8)
        for one in self.elements:
            order = "<" if one.byte_order == "le" else ">"
            bits = values[one.channel].astype(np.int64).view(np.uint64)
            stored = (bits << np.uint64(one.shift)).astype(f"{order}u{one.size}")
            start = self.offsets[one.channel]
            rows[:, start : start + one.size] = stored.view(np.uint8).reshape(n_scans, one.size)
        return rows.tobytes()
