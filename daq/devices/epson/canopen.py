"""Epson M-A552 accelerometers on a CAN bus (CANopen, CiA 301), sans-IO.

Theory of operation
-------------------
One device produces SYNC messages with the period of the sampling rate. At each SYNC every device
sends its newest sample in two messages (little-endian)::

    TPDO1, COB-ID 0x180 + node:  Ax i32, Ay i32
    TPDO2, COB-ID 0x280 + node:  Az i32, sample counter u16

So all devices of a bus have one clock, and samples of one SYNC have one index. A TPDO1 belongs to
the TPDO2 that follows before the next SYNC; otherwise one of both was lost, and the sample with it.
The counters (object 0x2100) are set to 0 before the first SYNC. The smallest first counter of all
devices is index 0. A device that joins later, or was started again, counts from 0 again: the number
of SYNC messages since index 0 is the index of its first sample.

A device that boots sends one byte 0 with COB-ID 0x700 + node, then its state as heartbeat there.

Objects are those of Epson's data sheet of the M-A552AC1x. Assumed, as for the M-A352 that is in it:
2⁻²⁴ g a count. Assumed: the counter counts the samples that are sent; a filter is used once it is
written.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime
from daq.protocols.sample_counter import SampleCounter

SYNC_COB_ID, SYNC_PERIOD = 0x1005, 0x1006
"""Objects: COB-ID of SYNC, with the bit of its producer; period in µs."""
SYNC = 0x80
PRODUCES_SYNC = 0x40000000
DEVICE_NAME, HARDWARE, SOFTWARE = 0x1008, 0x1009, 0x100A
TPDO1, TPDO2 = 0x1800, 0x1801
"""Objects of the two messages: subindex 1 is the COB-ID, 2 the transmission type."""
HEARTBEAT, BOOTED = 0x700, 0
"""COB-ID of node 0, and the state that a device states there once it has started."""
HEARTBEAT_TIME = 0x1017
"""Object: ms from one heartbeat to the next; 0 for none."""
PDO_IS_OFF = 0x80000000
EVERY_SYNC = 1
SAMPLE_COUNTER = 0x2100
TEMPERATURE = 0x9130, 4
"""Object and subindex of the temperature, i32, in the counts of an M-A352 (as Epson's own program
for a bus reads it)."""
FILTER = 0x61A1
RATES = (1000.0, 500.0, 200.0, 100.0, 50.0)
COUNTER_MODULUS = 65536
MAX_WAIT = 20
"""SYNC messages after which a device that has sent nothing is no longer waited for."""
_SENT = np.dtype([("ax", "<i4"), ("ay", "<i4"), ("az", "<i4"), ("counter", "<u2"), ("", "<u2")])
_SAMPLE = np.dtype(
    [("ax", "<i4"), ("ay", "<i4"), ("az", "<i4"), ("counter", "<u2"), ("sync", "<i8")]
)

Message = tuple[int, bytes]
"""COB-ID and content."""

TPDO_COB_IDS = (0x180, 0x280)
"""Of TPDO1 and TPDO2 of node 0."""


class CanDecoder:
    """Decodes the samples of all devices of a bus.

    Parameters
    ----------
    nodes : mapping of str to int
        Node ID of each sensor.
    sampling_rate : float
        In Hz, of SYNC.
    full_scale_counts : int
        Counts at the end of the range.
    """

    def __init__(
        self, nodes: Mapping[str, int], sampling_rate: float, *, full_scale_counts: int
    ) -> None:
        self._nodes = dict(nodes)
        self._full_scale = full_scale_counts
        self._counters = {n: SampleCounter(COUNTER_MODULUS, sampling_rate) for n in nodes}
        self._offsets: dict[str, int] = {}
        self._rest: list[Message] = []
        self._base: int | None = None
        self._n_before = self._base_sync = 0  # SYNC messages before the rest, and before index 0
        self._ends: dict[str, int] = {}
        self._started: set[str] = set()  # since index 0
        self._rate = sampling_rate

    def started(self, name: str) -> None:
        """Note that a device was started after the others: its counter begins again."""
        if self._base is not None:
            self._started.add(name)

    def receive(
        self, messages: Sequence[Message], at: HostTime, *, is_last: bool = False
    ) -> list[Block | Event]:
        """Return the blocks that the messages complete, in the order in which they arrived.

        `is_last`: no further messages will come.
        """
        waiting = [*self._rest, *messages]
        if not waiting:
            return []
        cob_ids = np.array([cob_id for cob_id, _ in waiting])
        content = b"".join(data[:8].ljust(8, b"\0") for _, data in waiting)
        rows = np.frombuffer(content, np.uint8).reshape(-1, 8)
        syncs = np.cumsum(cob_ids == SYNC)
        last_sync = int(np.flatnonzero(cob_ids == SYNC)[-1]) if syncs[-1] else 0
        if self._base is None:
            samples = {
                name: self._samples(node, cob_ids, rows, syncs)
                for name, node in self._nodes.items()
            }
            if not all(map(len, samples.values())) and syncs[-1] < MAX_WAIT and not is_last:
                self._rest = waiting
                return []
            if not any(map(len, samples.values())):
                self._rest = waiting[last_sync:]
                self._n_before += int(syncs[-1]) - 1
                return []
            firsts = [int(one["counter"][0]) for one in samples.values() if len(one)]
            self._base = min(firsts, key=lambda first: (first - firsts[0] + 0x8000) % 0x10000)
            first = next(
                one for one in samples.values() if len(one) and one["counter"][0] == self._base
            )
            self._base_sync = self._n_before + int(first["sync"][0])
        # What follows the last SYNC may lack messages that are still to come.
        is_complete = is_last or all(
            len(self._samples(node, cob_ids[last_sync:], rows[last_sync:], syncs[last_sync:]))
            for node in self._nodes.values()
        )
        whole = np.ones(len(waiting), bool) if is_complete else syncs < syncs[-1]
        self._rest = [] if is_complete else waiting[last_sync:]
        found: list[Block | Event] = []
        for name, node in self._nodes.items():
            found += self._blocks(
                name, self._samples(node, cob_ids[whole], rows[whole], syncs[whole]), at
            )
        self._n_before += int(syncs[-1]) - sum(cob_id == SYNC for cob_id, _ in self._rest)
        return found

    @staticmethod
    def _samples(
        node: int, cob_ids: NDArray[Any], rows: NDArray[np.uint8], syncs: NDArray[Any]
    ) -> NDArray[np.void]:
        """Return the samples of one device whose two messages are there."""
        first, second = (cob_ids == base + node for base in TPDO_COB_IDS)
        own = np.flatnonzero(first | second)
        is_pair = first[own[:-1]] & second[own[1:]] & (syncs[own[:-1]] == syncs[own[1:]])
        at = np.flatnonzero(is_pair)
        found = np.empty(len(at), _SAMPLE)
        both = np.concatenate((rows[own[at]], rows[own[at + 1]]), axis=1)
        sent = np.ascontiguousarray(both).view(_SENT).ravel()
        for name in ("ax", "ay", "az", "counter"):
            found[name] = sent[name]
        found["sync"] = syncs[own[at]]
        return found

    def _blocks(self, name: str, samples: NDArray[np.void], at: HostTime) -> list[Block | Event]:
        if not len(samples) or self._base is None:
            return []
        is_first = name not in self._offsets
        is_late = name in self._started
        if is_late:
            index = self._n_before + int(samples["sync"][0]) - self._base_sync
            self._counters[name] = SampleCounter(COUNTER_MODULUS, self._rate)
            self._offsets[name] = max(index, self._ends.get(name, 0))
            self._started.remove(name)
        elif is_first:
            ahead = (int(samples["counter"][0]) - self._base) % COUNTER_MODULUS
            self._offsets[name] = ahead
        offset = self._offsets[name]
        runs, n_repeated = self._counters[name].place(samples["counter"], at)
        found: list[Block | Event] = []
        if n_repeated:
            text = f"{n_repeated} samples repeated"
            found.append(Event(name, EventKind.RESYNCHRONISED, text, at))
        for run in runs:
            part = samples[run.start : run.stop]
            counts = np.stack([part["ax"], part["ay"], part["az"]], axis=1).astype(np.int32)
            flags, reason = BlockFlag.NONE, ""
            missing = run.missing
            if is_first or is_late:
                flags |= BlockFlag.CLOCK_RESTART
                missing = offset - self._ends.get(name, 0)
                if is_late and missing:
                    flags |= BlockFlag.MISSING_ESTIMATED
                is_first = is_late = False
            if missing:
                reason = f"{missing} samples not received"
            if run.restarted:
                flags |= BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
                reason = "the device restarted"
                found.append(Event(name, EventKind.RESET, reason, at))
            if counts.max() >= self._full_scale or counts.min() <= -self._full_scale:
                flags |= BlockFlag.CLIPPED
            first = run.first_sample + offset
            self._ends[name] = first + len(counts)
            found.append(Block(name, first, counts, at, run.counter, flags, reason))
        return found
