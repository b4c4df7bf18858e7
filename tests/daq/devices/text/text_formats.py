"""Formats of rows and packets, and what decoders make of them."""

from __future__ import annotations

from daq.devices.text.format import (
    TextFormat,
    encode_fields,
)
from daq.protocols.block import Block, DeviceItem, Event, HostTime

ROWS = TextFormat(columns=(0, 1, 2))
TIMED = TextFormat(columns=(1,), time_column=0)
COUNTED = TextFormat(columns=(1, 2), counter_column=0, counter_modulus=256, whole=True)
SHAKE = TextFormat(
    layout="channel",
    terminator="}",
    prefix="{",
    channel_names=("ENZ", "ENN", "ENE"),
    whole=True,
    device_time=True,
)


def at(seconds: float) -> HostTime:
    return HostTime(round(seconds * 1e9), 0)


def split(found: list[DeviceItem]) -> tuple[list[int], list[list[float]], list[Event]]:
    blocks = [b for b in found if isinstance(b, Block)]
    index = [i for b in blocks for i in range(b.first_sample, b.end_sample)]
    rows = [row for b in blocks for row in b.counts.tolist()]
    return index, rows, [e for e in found if isinstance(e, Event)]


def datacast(channel: str, packet: int, *, ahead: float = 0.0) -> bytes:
    first = packet * 25
    fields = [f"'{channel}'", f"{1582315130.292 + packet * 0.25 + ahead:.3f}"]
    fields += [str(1000 * SHAKE.channel_names.index(channel) + first + i) for i in range(25)]
    return encode_fields(fields, TextFormat(delimiter=", ", prefix="{", terminator="}"))
