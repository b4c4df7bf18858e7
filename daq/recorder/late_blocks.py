"""Finds missing samples of streams without a counter, by the host's clock.

Theory of operation
-------------------
Where a host, or a server of serial ports, does not read for a while, rows are lost when its buffers
are full. Nothing counts them. Afterwards all blocks arrive late by as many samples, for good. A
host that is only busy makes up: its blocks arrive late, then on time again.

So when blocks are suddenly late against the earliest before (:mod:`daq.protocols.pace`), they are
held back until arrivals settle. If they are on time again, nothing is missing. If they remain late,
the stored rows come first, and samples are missing behind them. Number and place are estimates. The
stored rows begin an epoch of their own.

A rate that is a little off makes no sudden step. An early block makes none either: see
:class:`daq.clocks.arrival_times.HostSleep`.
"""

from __future__ import annotations

from dataclasses import replace

from daq.protocols.block import Block, BlockFlag
from daq.protocols.pace import Pace

REASON = "late for good"
"""Reason of gaps that are found here."""
MIN_LATE = 0.25
"""Seconds by which blocks must be late at least, in real time."""
SETTLE = 5.0
"""Seconds in which blocks must remain late, in real time; and no less than ``_BLOCKS`` blocks."""
MAX_HELD = 60.0
"""Seconds of arrivals that are held back at most, in real time."""
_BLOCKS = 8
_LONG = 2.0  # durations of the block before, by which one must be late at least
_SCATTERS = 6.0


class LateBlocks:
    """Passes the blocks of one session of one sensor on, with gaps that arrivals show.

    Parameters
    ----------
    sampling_rate : float
        Nominal, in Hz of the host's clock.
    speed : float
        Of the host's clock against real time.
    """

    def __init__(self, sampling_rate: float, *, speed: float = 1.0) -> None:
        self._rate = sampling_rate
        self._speed = speed
        self._pace = Pace(sampling_rate)
        self._since = 0.0  # host time of the first block, in s
        self._last, self._n_last = 0.0, 0  # lateness and length of the last block
        self._held: list[tuple[Block, float]] = []  # each with its lateness
        self._added = 0  # samples that were found missing so far

    def passed(self, block: Block) -> list[Block]:
        """Take a block; return those to record now, in order."""
        if block.device_counter is not None or block.instants_ns is not None:
            return [block]
        late = self._pace.late(block.end_sample - 1 + self._added, block.received)
        if not self._held and not self._is_sudden(block, late):
            return [self._taken(block)]
        self._held.append((block, late))
        return self._decided(late)

    def _is_sudden(self, block: Block, late: float) -> bool:
        """Return whether a block is late, and the one before was not."""
        if not self._pace.n_arrivals:
            self._since = block.received.monotonic_ns * 1e-9
        is_known = self._pace.n_arrivals >= _BLOCKS
        is_known &= self._pace.seen - self._since >= SETTLE * self._speed
        long = _LONG * self._n_last / self._rate
        least = max(MIN_LATE * self._speed, _SCATTERS * self._pace.scatter, long)
        return is_known and late >= least and late - self._last >= least / 2

    def rest(self) -> list[Block]:
        """Return the blocks that are held back: the session ended."""
        held = self._held
        if len(held) < 2 or not self._is_settled():
            return self._released(0, 0)
        return self._with_gap()

    def _decided(self, late: float) -> list[Block]:
        first = self._held[0][0].received.monotonic_ns
        waited = (self._held[-1][0].received.monotonic_ns - first) * 1e-9
        if late < MIN_LATE / 2 * self._speed or waited > MAX_HELD * self._speed:
            return self._released(0, 0)
        if waited < SETTLE * self._speed or len(self._held) < _BLOCKS or not self._is_settled():
            return []
        return self._with_gap()

    def _is_settled(self) -> bool:
        """Return whether blocks remain as late as before."""
        middle = len(self._held) // 2
        before = min(late for _, late in self._held[:middle])
        after = min(late for _, late in self._held[middle:])
        return abs(before - after) < max(2 * self._pace.scatter, MIN_LATE / 4 * self._speed)

    def _with_gap(self) -> list[Block]:
        """Return the blocks that are held back, with a gap behind the stored rows.

        The last block with stored rows also has those that were sent since the host reads again.
        """
        held, lateness = self._held, [late for _, late in self._held]
        least = min(lateness[len(lateness) // 2 :])
        near = least + MIN_LATE / 2 * self._speed
        last = next(n for n, late in enumerate(lateness) if late <= near)
        block, late = held[last]
        since_ns = block.received.monotonic_ns - held[0][0].received.monotonic_ns
        n = max(0, block.n_samples - round(since_ns * 1e-9 * self._rate))
        parts = [
            replace(block, counts=block.counts[:n]),
            replace(block, first_sample=block.first_sample + n, counts=block.counts[n:]),
        ]
        held[last : last + 1] = [(part, late) for part in parts if part.n_samples]
        return self._released(last + (n > 0), round(least * self._rate))

    def _released(self, n_stored: int, missing: int) -> list[Block]:
        """Return the blocks that are held back; ``missing`` samples lack behind ``n_stored``."""
        held, self._held = self._held, []
        found = []
        for number, (block, _) in enumerate(held):
            flags, reason = block.flags, block.reason
            if missing and number == 0:
                flags |= BlockFlag.CLOCK_RESTART
            if missing and number == n_stored:
                self._added += missing
                flags |= BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
                reason = REASON
                self._pace.restart()
            found.append(self._taken(replace(block, flags=flags, reason=reason)))
        return found

    def _taken(self, block: Block) -> Block:
        if self._added:
            block = replace(block, first_sample=block.first_sample + self._added)
        index = block.end_sample - 1
        self._last, self._n_last = self._pace.late(index, block.received), block.n_samples
        self._pace.take(index, block.received)
        return block
