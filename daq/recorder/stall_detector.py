"""Detects overdue blocks of the sensors on a port: first late, then stalled.

Theory of operation
-------------------
The *block period* of a sensor is the duration of its blocks' samples: the longest of recent blocks.
A sensor is **late** when its next block has not arrived two block periods after the last one, and
not before ``MIN_LATE_AFTER``. A timer reports this at that instant. One lost block makes a sensor
late, so lateness alone has no consequence. The sensor is **stalled** after the time that the
session states (``daq.devices.interface.Session``), and never sooner than two of the
longest recent intervals between blocks and a margin. Then, if no other sensor on the port delivers,
the task that waits for the port is interrupted; otherwise the stall is only reported.

If reopening the port does not end a stall, the connection is sound and the device sends blocks less
often than expected. The interval therefore counts across sessions if the last one ended by a stall,
and the longest interval is passed from session to session (:class:`BlockInterval`).

Blocks are not overdue while the event loop is blocked, or while no task waits for blocks because
writing lags. A device that reports its recovery from a buffer overflow is late, but not stalled,
for up to ``MAX_RECOVERY``.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from types import TracebackType
from typing import Literal, Self, TypeAlias

from daq.devices.interface import DEFAULT_PATIENCE
from daq.protocols.block import Block
from daq.recording.sensor_state import SensorState

FIRST_BLOCK_TIMEOUT = 10.0
"""Seconds to wait for a short first block of a session; drivers have tighter limits."""
MAX_FIRST_BLOCK_SAMPLES = 1100
"""Number of samples in the longest first block: a GCF block holds up to 1000."""
LATE_PERIODS = 2
"""Block periods after the last block after which the next one is late."""
MIN_LATE_AFTER = 0.1
STALL_MARGIN = 0.25
"""Additional time for a late block, in s: one lost block must not count as a stall."""
MAX_LEARNED = 60.0
"""Longest interval between blocks, in seconds, that is learned across a stall."""
MEMORY = 8.0
"""Time over which the longest interval decays, in units of this interval."""
MAX_RECOVERY = 10.0
"""Maximum duration of a device's recovery without blocks, in s."""
BUSY_HOST_DELAY = 0.2
"""A timer that fires this many seconds late shows that the event loop was blocked."""
_MIN_TIMER_INTERVAL = 0.02
_DECAY = 0.98

OverdueState: TypeAlias = Literal[SensorState.LATE, SensorState.STALLED]


class BlockInterval:
    """Allowed time until the next block, learned from earlier blocks; seconds of one clock.

    Parameters
    ----------
    now
        Start of the session.
    first_block_timeout
        Allowed time until the first block.
    patience
        Minimum allowed time until any other block.
    before
        The interval of the port's last session, if there was one.
    """

    def __init__(
        self,
        now: float,
        first_block_timeout: float,
        *,
        patience: float,
        before: BlockInterval | None = None,
    ) -> None:
        self.last = now
        """Arrival of the last block; before the first block, start of the session."""
        self._first_block_timeout = max(first_block_timeout, patience)
        self._patience = patience
        self._has_blocks = False
        self._period = 0.0
        self.longest: float = before.longest if before else 0.0
        """Longest recent interval between blocks."""
        self._stalled_since = before.stalled_since if before else None
        self.reported: set[OverdueState] = set()
        """States reported since the last block."""

    @property
    def late_after(self) -> float:
        """Seconds after the last block when the next is late; infinite before the first block."""
        return max(MIN_LATE_AFTER, LATE_PERIODS * self._period) if self._has_blocks else math.inf

    @property
    def stalled_after(self) -> float:
        """Seconds after the last block when the sensor is stalled."""
        if not self._has_blocks:
            return self._first_block_timeout
        return max(self._patience, LATE_PERIODS * self.longest + STALL_MARGIN)

    @property
    def stalled_since(self) -> float | None:
        """Arrival of the last block before a stall that has not ended; None without one."""
        if SensorState.STALLED not in self.reported:
            return None
        return self.last if self._has_blocks else self._stalled_since

    def block_received(self, now: float, duration: float) -> None:
        """Learn from a block and the duration of its samples; long intervals decay slowly."""
        interval = now - self.last if self._has_blocks else 0.0
        if self._stalled_since is not None:
            interval = min(now - self._stalled_since, MAX_LEARNED)
            self._stalled_since = None
        self._period = max(_DECAY * self._period, duration)
        if self.longest:
            self.longest *= math.exp(-(now - self.last) / (MEMORY * self.longest))
        self.longest = max(self.longest, interval, duration)
        self._has_blocks, self.last = True, now
        self.reported.clear()

    def postpone(self, now: float) -> None:
        """Allow at least another half of the time until the next block is overdue."""
        self.last = max(self.last, now - min(self.late_after, self.stalled_after) / 2)


class StallDetector:
    """Reports overdue blocks; interrupts the task that waits for a stalled port.

    Parameters
    ----------
    sampling_rates : mapping of str to float
        Sampling rate of each sensor, in Hz of the event loop's clock.
    report : callable of sensor, state and seconds since its last block
        Called once for each state; returns whether it accepted the report, and is called again if
        not.
    patience : float
        Patience of the session, in s of the event loop's clock.
    before : StallDetector, optional
        Detector of the port's last session.
    is_recovering : callable
        Returns whether the device has reported its recovery from an overflow.
    """

    def __init__(
        self,
        sampling_rates: Mapping[str, float],
        report: Callable[[str, OverdueState, float], bool],
        *,
        patience: float = DEFAULT_PATIENCE,
        before: StallDetector | None = None,
        is_recovering: Callable[[], bool] = lambda: False,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._rates = sampling_rates
        self._report = report
        self._is_recovering = is_recovering
        now = self._loop.time()
        timeout = FIRST_BLOCK_TIMEOUT + MAX_FIRST_BLOCK_SAMPLES / min(sampling_rates.values())

        def interval(earlier: BlockInterval | None) -> BlockInterval:
            return BlockInterval(now, timeout, patience=patience, before=earlier)

        self.port: BlockInterval = interval(before.port if before else None)
        """Interval between blocks of any sensor."""
        self.sensors: dict[str, BlockInterval] = {
            name: interval(before.sensors[name] if before else None) for name in sampling_rates
        }
        """Interval between blocks of each sensor."""
        self._timeout = asyncio.timeout(None)
        self._is_waiting = False
        self._due = now
        self._timer: asyncio.TimerHandle | None = None

    @property
    def seconds(self) -> float:
        """Seconds since the last block of any sensor."""
        return self._loop.time() - self.port.last

    async def __aenter__(self) -> Self:
        await self._timeout.__aenter__()
        self._set_timer(self._loop.time())
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
        """Detect overdue blocks, and interrupt the current task, only within this context."""
        self._is_waiting = True
        try:
            yield
        finally:
            self._is_waiting = False

    def block_received(self, block: Block) -> None:
        """Record the arrival of a block."""
        now = self._loop.time()
        duration = block.n_samples / self._rates[block.sensor]
        self.port.block_received(now, duration)
        interval = self.sensors[block.sensor]
        interval.block_received(now, duration)
        if now + interval.late_after < self._due and self._timer is not None:
            self._timer.cancel()  # the first block, or blocks became shorter
            self._set_timer(now)

    def _on_timer(self) -> None:
        now = self._loop.time()
        if now - self._due > BUSY_HOST_DELAY or not self._is_waiting:
            for interval in (self.port, *self.sensors.values()):
                interval.postpone(now)
        else:
            self._report_overdue(now, SensorState.LATE)
            if now >= self.port.last + MAX_RECOVERY or not self._is_recovering():
                if now >= self.port.last + self.port.stalled_after:
                    for interval in (self.port, *self.sensors.values()):
                        interval.reported.add(SensorState.STALLED)
                    self._timeout.reschedule(now)
                    return
                self._report_overdue(now, SensorState.STALLED)
        self._set_timer(now)

    def _report_overdue(self, now: float, state: OverdueState) -> None:
        for name, interval in self.sensors.items():
            after = interval.late_after if state is SensorState.LATE else interval.stalled_after
            overdue = state not in interval.reported and now >= interval.last + after
            if overdue and self._report(name, state, now - interval.last):
                interval.reported.add(state)

    def _set_timer(self, now: float) -> None:
        """Set the timer to the next time at which a block can be overdue."""
        due = self.port.last + self.port.stalled_after
        for interval in self.sensors.values():
            if SensorState.LATE not in interval.reported:
                due = min(due, interval.last + interval.late_after)
            if SensorState.STALLED not in interval.reported:
                due = min(due, interval.last + interval.stalled_after)
        self._due = max(due, now + _MIN_TIMER_INTERVAL)
        self._timer = self._loop.call_at(self._due, self._on_timer)
