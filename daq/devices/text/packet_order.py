"""Single-channel packets grouped by their time, in order of time.

Datagrams are lost, repeated and reordered. A group of packets with the same time is yielded as soon
as it is complete and next in time. A group that is incomplete, or follows a hole, waits until
``PATIENCE`` later groups are complete: then the missing packets count as lost.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.protocols.sample_times import LATE_NS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from daq.protocols.block import HostTime
    from daq.protocols.sample_times import SampleTimes

PATIENCE = 2
MAX_WAITING = 64
"""Maximum number of waiting groups."""


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Samples of all channels with one time; ``counts`` has shape (n_samples, n_channels)."""

    time_ns: int
    counts: NDArray[Any]
    received: HostTime
    resolution_ns: int


@dataclass(slots=True)
class _Waiting:
    """An incomplete or early group: packets with one time."""

    time_ns: int
    resolution_ns: int
    received: HostTime
    packets: dict[str, NDArray[Any]]


_TIME = attrgetter("time_ns")


class Packets:
    """Packets waiting for the others of their group.

    Parameters
    ----------
    names : sequence of str
        Names of the channels, in the order of the columns.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._waiting: list[_Waiting] = []  # in order of time
        self._last: HostTime | None = None  # arrival of the last yielded group

    def add(
        self, name: str, values: NDArray[Any], time_ns: int, at: HostTime, resolution_ns: int
    ) -> int:
        """Add a packet; return 1 if it is a repetition, else 0."""
        index = bisect_left(self._waiting, time_ns, key=_TIME)
        if index < len(self._waiting) and self._waiting[index].time_ns == time_ns:
            one = self._waiting[index]
            if name in one.packets:
                return 1
            one.packets[name] = values
            one.received = at
            return 0
        insort(self._waiting, _Waiting(time_ns, resolution_ns, at, {name: values}), key=_TIME)
        return 0

    def ready(self, times: SampleTimes) -> Iterator[Group]:
        """Yield the groups that need not wait.

        The caller must place each group with ``times`` before it requests the next one.
        """
        while self._waiting:
            first = self._waiting[0]
            in_turn = self._is_whole(first) and not times.missing(first.time_ns)
            if not in_turn and sum(map(self._is_whole, self._waiting[1:])) < PATIENCE:
                return
            del self._waiting[0]
            if self._is_whole(first):
                yield self._group(first)

    def dropped(self, at: HostTime) -> list[str]:
        """Drop groups that wait too long; return a text for each.

        This happens if a channel never arrives, or if a wrong time is never next.
        """
        texts = []
        if len(self._waiting) > MAX_WAITING:
            silent = set(self._names) - set(self._waiting.pop(0).packets)
            texts.append(f"packets dropped: no packets of {', '.join(sorted(silent))}")
        last = self._last
        if last is not None and last.monotonic_ns == at.monotonic_ns:  # others still arrive
            stale = [
                w for w in self._waiting if at.monotonic_ns - w.received.monotonic_ns > LATE_NS
            ]
            for one in stale:
                self._waiting.remove(one)
                n_packets = len(one.packets)
                texts.append(f"{n_packets} packets dropped: their time contradicts the others")
        return texts

    def _is_whole(self, one: _Waiting) -> bool:
        return len(one.packets) == len(self._names)

    def _group(self, one: _Waiting) -> Group:
        if self._last is None or one.received.monotonic_ns > self._last.monotonic_ns:
            self._last = one.received
        n_samples = min(len(values) for values in one.packets.values())
        counts = np.column_stack([one.packets[name][:n_samples] for name in self._names])
        return Group(one.time_ns, counts, self._last, one.resolution_ns)
