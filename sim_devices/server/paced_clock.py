"""The clock of a simulated bench: it waits for all its participants.

Theory of operation
-------------------
A simulated device and the recorder that reads it are processes with deadlines: a FIFO must be read
before it is full, a reply must arrive before the driver's timeout. A busy computer may suspend any
of them for a second. With the system's clock, a second of samples would be lost. The paced clock
stops instead.

The paced clock is the system's monotonic clock, except that it stops while a participant is behind.
Participants are event loops (:class:`PacedLoop`), in any number of processes. Each time that a loop
has handled all due events, it stores a limit: the instant up to which the clock may run before the
loop reads the clock again. The limit is ``SHORTEST`` ahead, or half of the time for which the loop
has been idle, but at most ``LONGEST``, and at most ``SHORTEST`` beyond the loop's next timer. The
delay of an event for a suspended loop is therefore small against the interval between its events.
The time by which the system's clock exceeds the earliest limit is left out permanently. Every
process computes the time from a small file that all participants map; there is no other
communication.

A killed participant releases its lock, and the clock no longer waits for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import mmap
import os
import selectors
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

NS = 1_000_000_000
SHORTEST, LONGEST = 2_000_000, 40_000_000
"""Limits of the clock's lead over a participant, ns: shorter than any timeout of a driver."""
LOOKS = 2
"""Minimum number of times that an idle participant reads the clock in this lead."""
MAX_PAUSE = 0.01
"""Maximum interval between two reads of a stopped clock, s of the system's clock."""
MAX_PARTICIPANTS = 1024
_FREE = 2**63 - 1
_LOOK_FOR_THE_DEAD = NS // 10
_ORIGIN, _RATE, _UTC, _LEFT_OUT, _N_SLOTS, _SLOTS = range(6)
"""Positions in the file, each a signed 64-bit integer: instant of the system's clock at which both
clocks agreed, rate in 1e-6, UTC minus monotonic time in ns, time left out in ns, number of slots,
first slot."""


class PacedClock:
    """A monotonic clock shared by processes.

    Parameters
    ----------
    path : path
        The clock's file, made by :meth:`create`. Locks of participants are files in its folder.
    system_ns : callable
        The system's monotonic clock.
    """

    def __init__(
        self, path: str | Path, *, system_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.path = Path(path)
        self._system_ns = system_ns
        descriptor = os.open(self.path, os.O_RDWR | os.O_CLOEXEC)
        try:
            self._map = mmap.mmap(descriptor, 0)
        finally:
            os.close(descriptor)
        self._table = memoryview(self._map).cast("q")
        self._looked = system_ns()

    @classmethod
    def create(cls, path: str | Path, *, rate: float = 1.0) -> Self:
        """Create a clock that starts at the system's monotonic time and runs at ``rate``."""
        now = time.monotonic_ns()
        head = [now, round(rate * 1e6), utc_of(now) - now, 0, 0]
        table = memoryview(bytearray(8 * (_SLOTS + MAX_PARTICIPANTS))).cast("q")
        for place, value in enumerate(head):
            table[place] = value
        Path(path).write_bytes(table)
        return cls(path)

    def now_ns(self) -> int:
        """Return the time in ns, which never decreases."""
        table = self._table
        origin = table[_ORIGIN]
        left_out = table[_LEFT_OUT]
        while True:
            system = self._system_ns()
            before, left_out = left_out, table[_LEFT_OUT]
            if before == left_out:
                break  # otherwise time was left out after ``system``, and now would decrease
        elapsed = (system - origin) * table[_RATE] // 1_000_000
        now = origin + elapsed - left_out
        n_slots = table[_N_SLOTS]
        if not n_slots:
            return now
        earliest = min(table[_SLOTS : _SLOTS + n_slots])
        if now <= earliest:
            return now
        # Set, not added: another process may have left out the same time. If that process left out
        # more, this assignment undoes it, and the next read leaves it out again.
        table[_LEFT_OUT] = left_out + now - earliest
        if system > self._looked + _LOOK_FOR_THE_DEAD:
            self._looked = system
            self._forget_the_dead(earliest)
        return earliest

    def now(self) -> float:
        """Return the time in s."""
        return self.now_ns() / NS

    def utc_of(self, monotonic_ns: int) -> int:
        """Return the UTC in ns since 1970 of an instant of this clock."""
        return monotonic_ns + self._table[_UTC]

    def utc_ns(self) -> int:
        """Return the current UTC in ns since 1970."""
        return self.utc_of(self.now_ns())

    @property
    def left_out(self) -> float:
        """Total time left out, in s of the system's clock."""
        return self._table[_LEFT_OUT] / NS

    @property
    def rate(self) -> float:
        """Seconds of this clock per second of the system's clock, while it does not wait."""
        return self._table[_RATE] / 1e6

    def close(self) -> None:
        """Close the file."""
        self._table.release()
        self._map.close()

    @contextlib.contextmanager
    def participate(self) -> Iterator[Participant]:
        """Make the clock wait for this participant until the context ends."""
        slot, lock = self._take_slot()
        participant = Participant(self._table, _SLOTS + slot)
        self._table[_SLOTS + slot] = self.now_ns() + LONGEST
        try:
            yield participant
        finally:
            participant.let_run_until(_FREE)
            os.close(lock)

    def _take_slot(self) -> tuple[int, int]:
        """Return the first free slot, and the descriptor that holds its lock."""
        joining = None
        while joining is None:  # one process at a time, because each may add a slot
            joining = _locked(f"{self.path}.join")
        try:
            for slot in range(MAX_PARTICIPANTS):
                lock = _locked(self._lock_path(slot))
                if lock is not None:
                    self._table[_SLOTS + slot] = _FREE
                    self._table[_N_SLOTS] = max(self._table[_N_SLOTS], slot + 1)
                    return slot, lock
        finally:
            os.close(joining)
        raise OSError(f"{self.path}: {MAX_PARTICIPANTS} participants have this clock already")

    def _lock_path(self, slot: int) -> str:
        return f"{self.path}.{slot}"

    def _forget_the_dead(self, earliest: int) -> None:
        for slot in range(self._table[_N_SLOTS]):
            if self._table[_SLOTS + slot] == earliest:
                lock = _locked(self._lock_path(slot))
                if lock is not None:  # its owner was killed
                    self._table[_SLOTS + slot] = _FREE
                    os.close(lock)


@dataclass(frozen=True, slots=True)
class Participant:
    """An event loop that a clock waits for."""

    table: memoryview[int]
    place: int

    def let_run_until(self, now_ns: int) -> None:
        """Allow the clock to run up to an instant; an earlier limit has no effect."""
        self.table[self.place] = max(self.table[self.place], now_ns)


def _locked(path: str) -> int | None:
    """Return a descriptor that holds the lock of a file; None if another process holds it."""
    import fcntl  # noqa: PLC0415  (absent on Windows, where no device is simulated)

    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def utc_of(monotonic_ns: int) -> int:
    """Return the UTC of an instant of the system's monotonic clock, in ns since 1970.

    Uses the best of several readings of both clocks: processes agree to a few microseconds.
    """
    looks = [(time.monotonic_ns(), time.time_ns(), time.monotonic_ns()) for _ in range(20)]
    before, utc, after = min(looks, key=lambda look: look[2] - look[0])
    return monotonic_ns + utc - (before + after) // 2


class _Selector(selectors.SelectSelector):
    """Waits for I/O while the clock runs, and reads the clock often.

    Uses ``select``, the only such system call with timeouts below a millisecond.
    """

    participant: Participant | None = None

    def __init__(self, clock: PacedClock, *, only_answers: bool) -> None:
        super().__init__()
        self._clock = clock
        self._only_answers = only_answers
        self._busy = clock.now_ns()
        """Instant of the last received bytes, or of the last timer that a reply may follow."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return the ready files, or an empty list after ``timeout`` s of the clock."""
        clock, rate = self._clock, self._clock.rate
        now = clock.now_ns()
        if not self._only_answers:
            self._busy = now
        until = math.inf
        if timeout is not None:
            until = now + timeout * NS if timeout > 0 else now
        pause = 0.0
        while True:
            ahead = min(max(SHORTEST, (now - self._busy) // 2), LONGEST)
            if self.participant is not None:
                latest = max(now, until) + SHORTEST
                self.participant.let_run_until(int(min(now + ahead, latest)))
            seconds = max(0.0, min(until - now, ahead / LOOKS)) / NS / rate
            ready: list[tuple[selectors.SelectorKey, int]] = super().select(max(seconds, pause))
            before, now = now, clock.now_ns()
            if ready:
                self._busy = now
            if ready or now >= until:
                return ready
            # While the clock waits for a participant, frequent reads would only load the computer.
            pause = min(max(2 * pause, seconds), MAX_PAUSE) if now == before else 0.0


class PacedLoop(asyncio.SelectorEventLoop):
    """An event loop with the time of a paced clock, and a participant of it while running.

    Parameters
    ----------
    clock : PacedClock
        The clock.
    only_answers : bool
        Whether the loop never waits for a reply, like a device: it then need not read the clock
        between its timers.
    """

    def __init__(self, clock: PacedClock, *, only_answers: bool = False) -> None:
        self.clock = clock
        self._turns = _Selector(clock, only_answers=only_answers)
        super().__init__(self._turns)

    def time(self) -> float:
        """Return the clock's time in s."""
        return self.clock.now()

    def run_forever(self) -> None:
        """Run until stopped, as a participant of the clock."""
        with self.clock.participate() as participant:
            self._turns.participant = participant
            try:
                super().run_forever()
            finally:
                self._turns.participant = None
