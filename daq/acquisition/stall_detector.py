"""When the blocks of a port's sensors are overdue: late first, then lost.

Theory of operation
-------------------
A *block period* is the time the samples of a block take; as blocks may differ, the longest of late.
A sensor whose next block has not come two periods after its last (and no less than ``LEAST_LATE``)
is **late**. That is noticed by a timer at that very instant, and costs nothing but a word, for one
block that is lost whole makes the next come just then. After further patience (``LATENESS``; more,
if blocks came less evenly) it is **lost**: the one who waits for the port is interrupted, or, where
others on the port go on, only told.

When the event loop was held up, or nobody waits because writing lags, no device is to blame. Nor is
one that says it recovers, from an overflow of its buffer: for as long as ``LONGEST_RECOVERY`` it is
late, and not lost.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import TYPE_CHECKING, Literal, Self

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from types import TracebackType

    from daq.protocols.block import Block

FIRST_PATIENCE = 10.0
"""How long to wait for the first block of a session, in s, if it is short; drivers know better."""
LONGEST_FIRST_BLOCK = 1100
"""Samples a first block may have: one block of GCF holds up to a thousand."""
PERIODS = 2
"""How many block periods after the last block the next is late."""
LEAST_LATE = 0.1
LEAST_PATIENCE = 0.5
LATENESS = 0.25
"""What a late block may still come after, s: one that is lost whole must not look like a stall."""
LONGEST_RECOVERY = 10.0
"""How long no block may come from a device that says it recovers, s."""
HELD_UP = 0.2
"""A timer that comes so late, s, tells of a busy host."""
_LEAST_INTERVAL = 0.02
_FORGETTING = 0.98

Stage = Literal["late", "lost"]


class BlockInterval:
    """How long the next block may take, by those that came so far; times in s of one clock."""

    def __init__(self, now: float, first: float) -> None:
        self.last = now
        self._first = first
        self._begun = False
        self._period = 0.0
        self._longest = 0.0
        self.said: set[Stage] = set()
        """Of what is overdue, since the last block."""

    @property
    def late_after(self) -> float:
        """Seconds after the last block; never, before the first."""
        return max(LEAST_LATE, PERIODS * self._period) if self._begun else math.inf

    @property
    def lost_after(self) -> float:
        """Seconds after the last block."""
        if not self._begun:
            return self._first
        return max(LEAST_PATIENCE, PERIODS * self._longest + LATENESS)

    def block_came(self, now: float, duration: float) -> None:
        """Learn from a block and the time its samples took; what was long is forgotten slowly."""
        interval = now - self.last if self._begun else 0.0
        self._period = max(_FORGETTING * self._period, duration)
        self._longest = max(_FORGETTING * self._longest, interval, duration)
        self._begun, self.last = True, now
        self.said.clear()

    def excuse(self, now: float) -> None:
        """Take it that half the time is left."""
        self.last = max(self.last, now - min(self.late_after, self.lost_after) / 2)


class StallDetector:
    """Tells of overdue blocks, and interrupts who waits for a port that is lost.

    Parameters
    ----------
    sampling_rates : mapping of str to float
        Of each sensor, in samples per second of the event loop's clock.
    say : callable of sensor, stage and seconds since its last block
        Called once a stage; returns whether it could be said, and is asked again if not.
    recovers : callable
        Whether the device has said that it lives, though it sends no samples for now.
    """

    def __init__(
        self,
        sampling_rates: Mapping[str, float],
        say: Callable[[str, Stage, float], bool],
        *,
        recovers: Callable[[], bool] = lambda: False,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._rates = sampling_rates
        self._say = say
        self._recovers = recovers
        now = self._loop.time()
        first = FIRST_PATIENCE + LONGEST_FIRST_BLOCK / min(sampling_rates.values())
        self._port = BlockInterval(now, first)
        self._each = {name: BlockInterval(now, first) for name in sampling_rates}
        self._timeout = asyncio.timeout(None)
        self._is_waiting = False
        self._due = now
        self._timer: asyncio.TimerHandle | None = None

    @property
    def seconds(self) -> float:
        """Since the last block."""
        return self._loop.time() - self._port.last

    async def __aenter__(self) -> Self:
        await self._timeout.__aenter__()
        self._arm(self._loop.time())
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._timer is not None:
            self._timer.cancel()
        await self._timeout.__aexit__(kind, error, trace)

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Interrupt only what happens within."""
        self._is_waiting = True
        try:
            yield
        finally:
            self._is_waiting = False

    def block_came(self, block: Block) -> None:
        """Take note of a block."""
        now = self._loop.time()
        duration = block.n_samples / self._rates[block.sensor]
        self._port.block_came(now, duration)
        patience = self._each[block.sensor]
        patience.block_came(now, duration)
        if now + patience.late_after < self._due and self._timer is not None:
            self._timer.cancel()  # the first block, or blocks become shorter
            self._arm(now)

    def _look(self) -> None:
        now = self._loop.time()
        if now - self._due > HELD_UP or not self._is_waiting:
            for patience in (self._port, *self._each.values()):
                patience.excuse(now)
        else:
            self._tell(now, "late")
            if now >= self._port.last + LONGEST_RECOVERY or not self._recovers():
                if now >= self._port.last + self._port.lost_after:
                    self._timeout.reschedule(now)
                    return
                self._tell(now, "lost")
        self._arm(now)

    def _tell(self, now: float, stage: Stage) -> None:
        for name, patience in self._each.items():
            after = patience.late_after if stage == "late" else patience.lost_after
            overdue = stage not in patience.said and now >= patience.last + after
            if overdue and self._say(name, stage, now - patience.last):
                patience.said.add(stage)

    def _arm(self, now: float) -> None:
        """Come back when the next could be overdue: blocks that come meanwhile cost nothing."""
        due = self._port.last + self._port.lost_after
        for patience in self._each.values():
            if "late" not in patience.said:
                due = min(due, patience.last + patience.late_after)
            if "lost" not in patience.said:
                due = min(due, patience.last + patience.lost_after)
        self._due = max(due, now + _LEAST_INTERVAL)
        self._timer = self._loop.call_at(self._due, self._look)
