"""Formats of rows and packets, and what decoders make of them."""

from __future__ import annotations

from daq.devices.text.format import TextFormat, encode_fields
from daq.protocols.block import DeviceItem, Event
from tests.daq.devices.found import blocks_of, events_of, indices

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


def split(found: list[DeviceItem]) -> tuple[list[int], list[list[float]], list[Event]]:
    blocks = blocks_of(found)
    rows = [row for b in blocks for row in b.counts.tolist()]
    return indices(blocks), rows, events_of(found)


def datacast(channel: str, packet: int) -> bytes:
    first = packet * 25
    fields = [f"'{channel}'", f"{1582315130.292 + packet * 0.25:.3f}"]
    fields += [str(1000 * SHAKE.channel_names.index(channel) + first + i) for i in range(25)]
    return encode_fields(fields, TextFormat(delimiter=", ", prefix="{", terminator="}"))
