"""Sessions of libraries whose calls block: a vendor's SDK, a sound card.

Theory of operation
-------------------
:class:`BlockingSource` calls the library in a thread of its own: ``start`` once, ``read`` over and
over, ``stop`` at the end, however it ends. The thread takes the host time when a read returns and
puts the samples into a bounded queue. If the queue is full because the event loop is behind, the
samples are dropped and counted, so that they become a gap of exact length. The library's own losses
are stated by a read (:class:`Samples`), as its counter or as a number of samples.

Only a ``read`` with a time limit can be ended: it has to return None after at most a second without
samples.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.devices.interface import DeviceInformation, Session
from daq.devices.port_rules import port_label
from daq.errors import DeviceError, NotConnectedError
from daq.protocols.block import Block, BlockFlag, HostTime
from daq.protocols.sample_counter import SLACK

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence

    from numpy.typing import NDArray

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock

_LOGGER = logging.getLogger(__name__)
QUEUE = 256
"""Default number of reads that wait for the event loop."""
STOP_TIMEOUT = 3.0
"""Seconds that the thread may take to end, after which it is left to itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """What one read returned.

    Attributes
    ----------
    counts : ndarray, shape (n_samples, n_channels)
        Columns are the channels of all sensors of the port, in the order of the bench file.
    position : int or None
        Number of the first sample by the device's own counter, which does not wrap. Gaps follow
        from it; a counter that goes back, or further than host time allows, was restarted.
    missing : int
        Samples lost before these, if there is no position.
    reason : str
        Why samples are missing, as the library says.
    flags : BlockFlag
        For example ``CLIPPED``, or ``MISSING_ESTIMATED`` where ``missing`` is not exact.
    received : HostTime or None
        When the library had them; by default, when the read returned.
    """

    counts: NDArray[Any]
    position: int | None = None
    missing: int = 0
    reason: str = ""
    flags: BlockFlag = BlockFlag.NONE
    received: HostTime | None = None


class BlockingSource(Session):
    """A session (:class:`daq.devices.interface.Session`) on a library whose calls block.

    Parameters
    ----------
    sensors : sequence of Sensor
        All sensors of the port.
    clock : HostClock
        The clock given to the driver.
    read : callable
        Returns samples, or None if there were none within a second.
    start, stop : callable
        Begin and end the sampling. ``stop`` is called once, also after a failure.
    information : sequence of DeviceInformation
        One per sensor.
    queue : int
        Number of reads that may wait for the event loop; further ones become a gap.
    """

    def __init__(
        self,
        sensors: Sequence[Sensor],
        clock: HostClock,
        *,
        read: Callable[[], Samples | NDArray[Any] | None],
        start: Callable[[], object] = lambda: None,
        stop: Callable[[], object] = lambda: None,
        information: Sequence[DeviceInformation] = (),
        queue: int = QUEUE,
    ) -> None:
        self.information = tuple(information)
        self._sensors, self._clock = tuple(sensors), clock
        self._read, self._start, self._stop = read, start, stop
        self._queue: deque[tuple[Samples, HostTime]] = deque()
        self._room = queue
        self._n_dropped = 0  # samples since the last queued read
        self._has_ended = threading.Event()  # set to end the thread
        self._failure: Exception | None = None
        self._next = 0
        self._origin: int | None = None  # position of sample 0
        self._began_ns: int | None = None
        self._least_lag = 0.0  # s; of host time behind the numbers of the samples

    async def read(self) -> AsyncIterator[Block]:
        """Start the thread and yield blocks, until closed.

        Raises
        ------
        DeviceError
            As raised by the library's calls; NotConnectedError for errors that are not of huddle.
        """
        loop, arrived = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            with contextlib.suppress(RuntimeError):  # the loop was closed
                loop.call_soon_threadsafe(arrived.set)

        thread = threading.Thread(
            target=self._run, args=(wake,), name=port_label(self._sensors), daemon=True
        )
        thread.start()
        try:
            while True:
                await arrived.wait()
                arrived.clear()
                is_over = not thread.is_alive() or self._failure is not None
                while self._queue:
                    for block in self._blocks(*self._queue.popleft()):
                        yield block
                if is_over:
                    raise self._error()
        finally:
            self._has_ended.set()
            await asyncio.to_thread(thread.join, STOP_TIMEOUT)
            if thread.is_alive():
                _LOGGER.warning("%s: a call of the library does not return", thread.name)

    def _run(self, wake: Callable[[], None]) -> None:
        """Call the library; runs in the thread."""
        try:
            try:
                self._start()
                while not self._has_ended.is_set():
                    found = self._read()
                    if found is not None:
                        self._put(found if isinstance(found, Samples) else Samples(found))
                        wake()
            finally:
                self._stop()
        except Exception as error:  # noqa: BLE001 -- a library may raise anything; raised in `read`
            self._failure = error
            wake()

    def _put(self, samples: Samples) -> None:
        """Queue samples with the present time, or drop and count them."""
        at = samples.received or self._clock.now()
        if len(self._queue) >= self._room:
            self._n_dropped += samples.missing + len(samples.counts)
            return
        if self._n_dropped:
            missing, reason = self._n_dropped + samples.missing, "the computer was too slow"
            samples = replace(samples, missing=missing, reason=reason)
            self._n_dropped = 0
        self._queue.append((samples, at))

    def _blocks(self, samples: Samples, at: HostTime) -> list[Block]:
        n_samples = len(samples.counts)
        if not n_samples:
            return []
        flags, reason, first = samples.flags, samples.reason, self._next + samples.missing
        if self._began_ns is None:
            flags |= BlockFlag.CLOCK_RESTART
            self._began_ns, first, reason = at.monotonic_ns, 0, ""
            self._least_lag = self._lag(n_samples, at)
        position = samples.position
        if position is not None:
            origin = position - first if self._origin is None else self._origin
            if position - origin < self._next or self._is_early(position - origin + n_samples, at):
                elapsed = (at.monotonic_ns - self._began_ns) * 1e-9
                by_time = round(elapsed * self._sensors[0].sampling_rate) - n_samples
                first = max(self._next, by_time)
                flags |= BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
                origin, reason = position - first, "the device restarted"
            self._origin, first = origin, position - origin
        reason = reason or "samples lost by the device" if first > self._next else ""
        self._next = first + n_samples
        self._least_lag = min(self._lag(self._next, at), self._least_lag)
        blocks, column = [], 0
        for sensor in self._sensors:
            columns = slice(column, column + len(sensor.channels))
            column = columns.stop
            counts = np.ascontiguousarray(samples.counts[:, columns])
            blocks.append(Block(sensor.name, first, counts, at, position, flags, reason))
        return blocks

    def _lag(self, end: int, at: HostTime) -> float:
        return at.monotonic_ns * 1e-9 - end / self._sensors[0].sampling_rate

    def _is_early(self, end: int, at: HostTime) -> bool:
        """Whether samples up to this number cannot have been taken: the counter was restarted."""
        return self._lag(end, at) < self._least_lag - SLACK

    def _error(self) -> Exception:
        """Return the error that ended the thread."""
        error = self._failure
        if isinstance(error, DeviceError):
            return error
        lost = NotConnectedError(f"{port_label(self._sensors)}: {error or 'the thread ended'}")
        lost.__cause__ = error
        return lost
