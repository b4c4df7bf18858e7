"""What decoders make of bytes that arrive at some second."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

from daq.protocols.block import Block, Event, HostTime

T = TypeVar("T")


def at(seconds: float) -> HostTime:
    return HostTime(round(seconds * 1e9), 0)


def only(kind: type[T], found: Iterable[object]) -> T:
    """Return the one item of ``found``, which is of this kind."""
    (item,) = found
    assert isinstance(item, kind)
    return item


def blocks_of(found: Iterable[object], sensor: str | None = None) -> list[Block]:
    return [b for b in found if isinstance(b, Block) and sensor in {None, b.sensor}]


def events_of(found: Iterable[object]) -> list[Event]:
    return [item for item in found if isinstance(item, Event)]


def indices(blocks: Iterable[Block]) -> list[int]:
    return [i for b in blocks for i in range(b.first_sample, b.end_sample)]
