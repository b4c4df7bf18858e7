"""Converts sample indices of sessions to the sample index of the recording.

Theory of operation
-------------------
A driver counts samples from 0 at the start of each session. A recording has one index per sensor:
it counts the samples that the sensor took, or should have taken, since its first one. Within a
session the two indices differ by a constant, and a jump is a gap of exactly that length (unless the
protocol marks the length as an estimate).

When a session begins, or a device restarts its sampling (``BlockFlag.CLOCK_RESTART``), the length
of the gap comes from the device's UTC, if the blocks on both sides have it and the host's clock
agrees within an hour: a device may send stored data, or return with a wrong date. Otherwise it
comes from the host's clock and is marked as an estimate. The block after such a gap has the flag
``CLOCK_RESTART``, because the phase of the sampling is new.

A session may also continue the index of the previous session, if the device kept counting
(``daq.devices.interface.Driver.resume``). Then only the reason of the gap changes.

Samples that were recorded before (in late or repeated blocks) are not recorded again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from daq.protocols.block import Block, BlockFlag, HostTime

_NS = 1e9
_MAX_DISAGREEMENT = 3600.0
"""Seconds by which the intervals of the device's and the host's clock may differ."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Samples that were not received."""

    first_sample: int
    missing: int
    reason: str
    estimated: bool


@dataclass(frozen=True, slots=True)
class PlacedBlock:
    """A block in the index of the recording, and the gap before it."""

    block: Block | None
    """Its samples that are new; None if there are none."""
    gap: Gap | None = None
    repeated: int = 0
    """Number of samples that were recorded before."""


class SampleIndexer:
    """Converts the sample indices of one sensor's blocks."""

    def __init__(self, sampling_rate: float) -> None:
        self.next_sample = 0
        """Recording index after the last sample."""
        self._rate = sampling_rate
        self._offset: int | None = 0
        self._reason = ""
        self._last: Block | None = None

    def new_session(self, reason: str) -> None:
        """Begin a new session with the next block.

        ``reason`` is the reason for the end of the last session.
        """
        self._offset = None
        self._reason = reason

    def resume(self, reason: str) -> None:
        """Begin a session that continues the index of the last one.

        Samples missing before its first block are missing for ``reason``.
        """
        self._reason = reason

    def place(self, block: Block) -> PlacedBlock:
        """Return a block in the index of the recording.

        Parameters
        ----------
        block : Block
            In the index of its session.
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
            if estimated:  # also where none is known to be missing
                flags |= BlockFlag.MISSING_ESTIMATED
            return self._placed(replace(block, flags=flags), reason, estimated=estimated)
        if self._offset is None:
            self._offset = -block.first_sample
        estimated = bool(block.flags & BlockFlag.MISSING_ESTIMATED)
        reason, self._reason = self._reason or block.reason or "lost", ""
        return self._placed(block, reason, estimated=estimated)

    def lost_until(self, now: HostTime) -> Gap | None:
        """Return the gap at the end of a recording that ends while the device is lost."""
        if self._last is None:
            return None
        elapsed = now.monotonic_ns - self._last.received.monotonic_ns
        missing = round(elapsed / _NS * self._rate)
        if missing <= 0:
            return None
        return Gap(self.next_sample, missing, "lost at the end", estimated=True)

    def _placed(self, block: Block, reason: str, *, estimated: bool) -> PlacedBlock:
        first = block.first_sample + (self._offset or 0)
        missing = first - self.next_sample
        repeated = min(max(0, -missing), block.n_samples)
        if repeated == block.n_samples:
            return PlacedBlock(None, repeated=repeated)
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
        return PlacedBlock(placed, gap, repeated)

    def _missing_by_time(self, last: Block, block: Block) -> tuple[int, bool]:
        """Return the number of samples between two blocks, and whether it is an estimate."""
        waited = (block.received.monotonic_ns - last.received.monotonic_ns) / _NS
        both = last.flags & block.flags & BlockFlag.DEVICE_UTC
        if both and last.device_counter is not None and block.device_counter is not None:
            elapsed = (block.device_counter - last.device_counter) / _NS
            if abs(elapsed - waited) <= _MAX_DISAGREEMENT:
                # Negative if the device sends samples again.
                return round(elapsed * self._rate) - last.n_samples, False
        return max(0, round(waited * self._rate) - block.n_samples), True
