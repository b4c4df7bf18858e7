"""GCF streams joined into sensors by time, for every kind of link.

Theory of operation
-------------------
A Güralp digitizer sends each component as a stream of its own (``DEMOZ2``, ``DEMON2``, ``DEMOE2``).
:class:`Streams` gives each block to its sensor, where streams are joined by time
(:mod:`daq.protocols.joined_streams`).

A sensor whose streams are not yet known starts without streams. Meanwhile, blocks of streams that
belong to no sensor are kept until :meth:`Streams.assign` assigns their streams.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from typing import TYPE_CHECKING

from daq.devices.guralp.gcf import SampleBlock, StatusBlock, serial_number
from daq.protocols.block import Block, DeviceItem, Event, EventKind, HostTime, Quantity, Reading
from daq.protocols.joined_streams import MAX_PENDING, JoinedStreams

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

MAX_KEPT = 1024
"""Maximum number of blocks kept for streams that are not assigned yet."""
_STATED = {
    Quantity.SUPPLY: re.compile(r"\bsupply\s*[:=]?\s*(\d{1,3}(?:\.\d{1,4})?)\s*V\b", re.IGNORECASE),
    Quantity.TEMPERATURE: re.compile(
        r"\btemp(?:erature)?\s*[:=]?\s*([-+]?\d{1,3}(?:\.\d{1,4})?)\s*['°]?\s*C\b", re.IGNORECASE
    ),
}
"""As in ``External supply : 13.0V Temperature 24.68'C`` (Güralp MAN-D24-0004, 7.1.1)."""
FULL_SCALE_COUNTS = (1 << 23) - 1
"""Full scale of a 24-bit digitizer, peak."""


class Streams:
    """Sorts GCF blocks by sensor and joins the streams of each.

    Parameters
    ----------
    sensors : mapping of str to sequence of str
        Stream ID of each channel, by sensor, in the order of the channels; empty if not yet known.
    """

    def __init__(self, sensors: Mapping[str, Iterable[str]]) -> None:
        ids = {name: tuple(stream_ids) for name, stream_ids in sensors.items()}
        self._sensors = {name: _joined(name, stream_ids) for name, stream_ids in ids.items()}
        self._systems: dict[str, str] = {}
        self._owner = {stream: name for name, streams in ids.items() for stream in streams}
        self._unknown: Counter[str] = Counter()
        self._kept: deque[tuple[SampleBlock, HostTime]] = deque(maxlen=MAX_KEPT)
        self._searching = not all(ids.values())
        self._name = only(ids)
        self._lost = "block missing"
        self._incomplete: set[str] = set()  # streams whose next block may follow a lost one
        self._at: HostTime | None = None  # of the last block

    @property
    def silent(self) -> tuple[str, ...]:
        """IDs of the streams without any block yet."""
        return tuple(stream for sensor in self._sensors.values() for stream in sensor.silent)

    @property
    def unknown(self) -> frozenset[str]:
        """IDs of received streams that belong to no sensor."""
        return frozenset(self._unknown)

    @property
    def repeated(self) -> bool:
        """Whether one of the `unknown` streams sent two blocks: probably each has sent one."""
        return max(self._unknown.values(), default=0) > 1

    def sampling_rate(self, sensor: str) -> float | None:
        """Return the sampling rate of a sensor in Hz, or None before its first block."""
        rate = self._sensors[sensor].sampling_rate
        return None if rate is None else float(rate)

    def stream_ids(self, sensor: str) -> tuple[str, ...]:
        """Return the stream IDs of a sensor's channels."""
        return tuple(stream for stream, owner in self._owner.items() if owner == sensor)

    def system(self, sensor: str) -> str:
        """Return the system ID in a sensor's first block."""
        return self._systems.get(sensor, "")

    def lost(self, reason: str) -> None:
        """Set the reason for gaps from now on: block numbers show that some were lost."""
        self._lost = reason
        self._incomplete = set(self._owner)

    def receive(
        self, block: SampleBlock | StatusBlock, at: HostTime, *, awaiting: bool = False
    ) -> Iterator[DeviceItem]:
        """Add one block; yield the completed blocks and events.

        ``awaiting`` is whether missing blocks may still arrive.
        """
        self._at = at
        if isinstance(block, StatusBlock):
            yield from self._status(block, at)
        elif block.stream_id in self._owner:
            owner = self._owner[block.stream_id]
            self._systems.setdefault(owner, block.system.text)
            in_turn = False if awaiting or block.stream_id in self._incomplete else None
            self._incomplete.discard(block.stream_id)
            yield from self._sensors[owner].add(block, at, in_turn=in_turn)
        elif block.stream_id in self._unknown or len(self._unknown) < MAX_PENDING:
            self._unknown[block.stream_id] += 1
            if self._searching:
                self._kept.append((block, at))
            elif self._unknown[block.stream_id] == 1:
                yield self._nobodys(block.stream_id, at)
        for sensor in self._sensors.values():
            yield from sensor.take(at, awaiting=awaiting, reason=self._lost)

    def release(self) -> Iterator[Block | Event]:
        """Yield the blocks that wait for missing ones: the connection ended, nothing comes."""
        if self._at is not None:
            for sensor in self._sensors.values():
                yield from sensor.settle(self._at)
                yield from sensor.take(self._at, awaiting=False, reason=self._lost)

    def assign(self, sensor: str, stream_ids: Iterable[str]) -> Iterator[DeviceItem]:
        """Assign streams to a sensor; yield the blocks received of them, up to the first hole."""
        ids = tuple(stream_ids)
        own = self._sensors[sensor] = _joined(sensor, ids)
        self._owner |= dict.fromkeys(ids, sensor)
        kept, self._searching = list(self._kept), False
        self._kept.clear()
        for block, at in kept:
            if block.stream_id in ids:
                self._unknown.pop(block.stream_id, None)
                self._systems.setdefault(sensor, block.system.text)
                yield from own.add(block, at)
                yield from own.take(at, awaiting=True, reason=self._lost)
        for stream_id in sorted(self._unknown):
            yield self._nobodys(stream_id, kept[-1][1])

    def _nobodys(self, stream_id: str, at: HostTime) -> Event:
        text = f"stream {stream_id} belongs to no sensor of this port"
        return Event(self._name, EventKind.REFUSED, text, at)

    def _status(self, block: StatusBlock, at: HostTime) -> Iterator[Event | Reading]:
        serial = serial_number(block.stream_id)
        owners = {n for stream, n in self._owner.items() if serial_number(stream) == serial} or {""}
        for line in block.text.splitlines():
            text = "".join(c if c.isprintable() else "?" for c in line).strip()
            if text:
                stated = [
                    (quantity, float(found[1]))
                    for quantity, pattern in _STATED.items()
                    if (found := pattern.search(text))
                ]
                for name in sorted(owners):
                    yield Event(name, EventKind.STATUS, cut(text), at)
                    for quantity, value in stated if name else ():
                        yield Reading(name, quantity, value, at)


def _joined(sensor: str, stream_ids: tuple[str, ...]) -> JoinedStreams:
    return JoinedStreams(sensor, stream_ids, full_scale=FULL_SCALE_COUNTS)


def cut(text: str) -> str:
    """Return a text, shortened to the maximum length of an event."""
    return text.encode()[:200].decode(errors="ignore")


def only(names: Iterable[str]) -> str:
    """Return the sensor name for events of the port; empty if several sensors share the port."""
    first, *others = (*names, "")
    return first if len(others) <= 1 else ""
