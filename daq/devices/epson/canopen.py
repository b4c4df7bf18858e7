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
devices is index 0.

Objects are those of Epson's data sheet of the M-A552AC1x. Assumed, as for the M-A352 that is in it:
2⁻²⁴ g a count. Assumed: the counter counts the samples that are sent; a filter is used once it is
written.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daq.protocols.block import Block, BlockFlag, Event, EventKind
from daq.protocols.sample_counter import SampleCounter

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daq.protocols.block import HostTime

SYNC_COB_ID, SYNC_PERIOD = 0x1005, 0x1006
"""Objects: COB-ID of SYNC, with the bit of its producer; period in µs."""
SYNC = 0x80
PRODUCES_SYNC = 0x40000000
DEVICE_NAME, HARDWARE, SOFTWARE = 0x1008, 0x1009, 0x100A
TPDO1, TPDO2 = 0x1800, 0x1801
"""Objects of the two messages: subindex 1 is the COB-ID, 2 the transmission type."""
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
_SAMPLE = np.dtype([("ax", "<i4"), ("ay", "<i4"), ("az", "<i4"), ("counter", "<u2"), ("", "<u2")])

Message = tuple[int, bytes]
"""COB-ID and content."""


def encode_sample(node: int, counts: NDArray[np.int32], counter: int) -> list[Message]:
    """Return both messages of a sample; the simulator sends them."""
    ax, ay, az = (int(count).to_bytes(4, "little", signed=True) for count in counts)
    return [
        (TPDO_COB_IDS[0] + node, ax + ay),
        (TPDO_COB_IDS[1] + node, az + (counter % COUNTER_MODULUS).to_bytes(2, "little")),
    ]


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

    def receive(self, messages: Sequence[Message], at: HostTime) -> list[Block | Event]:
        """Return the blocks that the messages complete, in the order in which they arrived."""
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
            if not all(map(len, samples.values())) and syncs[-1] < MAX_WAIT:
                self._rest = waiting
                return []
            if not any(map(len, samples.values())):
                self._rest = waiting[last_sync:]
                return []
            firsts = [int(one["counter"][0]) for one in samples.values() if len(one)]
            self._base = min(firsts, key=lambda first: (first - firsts[0] + 0x8000) % 0x10000)
        # What follows the last SYNC may lack messages that are still to come.
        is_complete = all(
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
        both = np.concatenate((rows[own[at]], rows[own[at + 1]]), axis=1)
        return np.ascontiguousarray(both).view(_SAMPLE).ravel()

    def _blocks(self, name: str, samples: NDArray[np.void], at: HostTime) -> list[Block | Event]:
        if not len(samples) or self._base is None:
            return []
        is_first = name not in self._offsets
        if is_first:
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
            if is_first:
                flags |= BlockFlag.CLOCK_RESTART
                missing, is_first = offset, False
            if missing:
                reason = f"{missing} samples not received"
            if run.restarted:
                flags |= BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
                reason = "the device restarted"
                found.append(Event(name, EventKind.RESET, reason, at))
            if counts.max() >= self._full_scale or counts.min() <= -self._full_scale:
                flags |= BlockFlag.CLIPPED
            first = run.first_sample + offset
            found.append(Block(name, first, counts, at, run.counter, flags, reason))
        return found
