"""Session sample index → recording sample index, across reconnections, resets and repetitions.

Theory of operation
-------------------
A driver counts samples from 0 at the start of each session. A recording has one index per sensor,
which counts the samples the sensor took, or should have taken, since its first. Within a session
the two differ by a constant, and a jump of the index is a gap of exactly that length (unless the
protocol itself says it is an estimate). Where a session begins, or a device restarts its sampling
(``BlockFlag.CLOCK_RESTART``), the length of the gap comes from the device's UTC where both sides of
the gap have it and the host's clock agrees within an hour (a device may send what it kept, or come
back with a date of its own), and else from the host's clock, and then says that it is an estimate;
the block after it carries ``CLOCK_RESTART``, because the phase of the sampling is new. A session
may also go on in the index of the one before, where the device counted on
(``daq.drivers.interface``, ``Resuming``): then nothing changes but the reason of the gap.

Samples that were recorded already (late or repeated blocks) are never recorded twice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from daq.protocols.block import Block, BlockFlag

if TYPE_CHECKING:
    from daq.protocols.block import HostTime

_NS = 1e9
_HOUR = 3600.0


@dataclass(frozen=True, slots=True)
class Gap:
    """Samples that were not received."""

    first_sample: int
    missing: int
    reason: str
    estimated: bool


@dataclass(frozen=True, slots=True)
class Placed:
    """A block in the recording's index, the gap before it, and how much of it was known already."""

    block: Block | None
    gap: Gap | None = None
    repeated: int = 0


class SampleIndexer:
    """Places the blocks of one sensor."""

    def __init__(self, sampling_rate: float) -> None:
        self.next_sample = 0
        """Recording index of the sample that should come next."""
        self._rate = sampling_rate
        self._offset: int | None = 0
        self._reason = ""
        self._last: Block | None = None

    def new_session(self, reason: str) -> None:
        """Say that the next block comes from a new session, and why the last one ended."""
        self._offset = None
        self._reason = reason

    def resume(self, reason: str) -> None:
        """Say that the next block comes from a new session that goes on in the index of the last.

        What is missing before it is missing for ``reason``.
        """
        self._reason = reason

    def place(self, block: Block) -> Placed:
        """Return the block where it belongs in the recording.

        Parameters
        ----------
        block : Block
            In its session's index.
        """
        restarted = bool(block.flags & BlockFlag.CLOCK_RESTART)
        going_back = self._offset is not None and block.first_sample + self._offset < (
            self.next_sample
        )
        if self._last is not None and (self._offset is None or (restarted and going_back)):
            missing, estimated = self._missing_by_time(self._last, block)
            self._offset = self.next_sample + missing - block.first_sample
            reason = self._reason or block.reason or "restart"
            self._reason = ""
            flags = block.flags | BlockFlag.CLOCK_RESTART
            if estimated and missing:
                flags |= BlockFlag.MISSING_ESTIMATED
            return self._placed(replace(block, flags=flags), reason, estimated=estimated)
        if self._offset is None:
            self._offset = -block.first_sample
        estimated = bool(block.flags & BlockFlag.MISSING_ESTIMATED)
        reason, self._reason = self._reason or block.reason or "lost", ""
        return self._placed(block, reason, estimated=estimated)

    def lost_until(self, now: HostTime, reason: str) -> Gap | None:
        """Return what is missing at the end of a recording that ends while the device is lost."""
        if self._last is None:
            return None
        elapsed = now.monotonic_ns - self._last.received.monotonic_ns
        missing = round(elapsed / _NS * self._rate)
        return Gap(self.next_sample, missing, reason, estimated=True) if missing > 0 else None

    def _placed(self, block: Block, reason: str, *, estimated: bool) -> Placed:
        first = block.first_sample + (self._offset or 0)
        missing = first - self.next_sample
        repeated = min(max(0, -missing), block.n_samples)
        if repeated == block.n_samples:
            return Placed(None, repeated=repeated)
        gap = Gap(self.next_sample, missing, reason, estimated) if missing > 0 else None
        placed = replace(
            block,
            first_sample=first + repeated,
            counts=block.counts[repeated:],
            reason=gap.reason if gap else "",
            instants_ns=None if block.instants_ns is None else block.instants_ns[repeated:],
            device_counter=None if repeated else block.device_counter,
        )
        self.next_sample = placed.end_sample
        self._last = placed
        return Placed(placed, gap, repeated)

    def _missing_by_time(self, last: Block, block: Block) -> tuple[int, bool]:
        """Return how many samples lie between two blocks by their times, and if that is a guess."""
        waited = (block.received.monotonic_ns - last.received.monotonic_ns) / _NS
        both = last.flags & block.flags & BlockFlag.DEVICE_UTC
        if both and last.device_counter is not None and block.device_counter is not None:
            elapsed = (block.device_counter - last.device_counter) / _NS
            if abs(elapsed - waited) <= _HOUR:  # negative where it sends again what is known
                return round(elapsed * self._rate) - last.n_samples, False
        return max(0, round(waited * self._rate) - block.n_samples), True
