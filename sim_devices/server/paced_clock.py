"""The clock of a simulated bench: it waits for everybody who takes part.

Theory of operation
-------------------
A simulated device and the recorder that reads it are processes with deadlines: a FIFO must be read
before it is full, a reply must come before the driver's time limit. On a busy computer any of them
may not run for a second. By the system's clock a second of samples would be lost; by this clock
only time is.

The paced clock is the system's monotonic clock, except that it stands still while a participant is
behind. Participants are event loops (:class:`PacedLoop`), in any number of processes. Each time
that a loop has dealt with everything that was due, it writes down the instant until which the clock
may run before the loop has looked again: ``SHORTEST`` later, or half as long as the loop has had
nothing to do, but no more than ``LONGEST``, nor than ``SHORTEST`` beyond its next timer. So what
comes for a loop that the computer does not let run is delayed by little, measured by how often
something comes. What the clock would be beyond the earliest of those instants is left out for good.
Nothing else is agreed on: whoever reads the clock works out where it is, from a small file that all
participants map.

A participant that was killed no longer holds its lock, and is then no longer waited for.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import mmap
import os
import selectors
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

NS = 1_000_000_000
SHORTEST, LONGEST = 2_000_000, 40_000_000
"""How far the clock may run ahead of a participant, ns: less than any time limit of a driver."""
LOOKS = 2
"""How often at least a participant that has nothing to do looks at the clock in that time."""
LONGEST_PAUSE = 0.01
"""Between two looks at a clock that stands still, s of the system's clock."""
MOST_PARTICIPANTS = 1024
_FREE = 2**63 - 1
_LOOK_FOR_THE_DEAD = NS // 10
_ORIGIN, _RATE, _UTC, _LEFT_OUT, _N_SLOTS, _SLOTS = range(6)
"""Places in the file, each a signed 64-bit integer: instant of the system's clock at which both
clocks agreed, rate in 1e-6, UTC less monotonic time in ns, time left out in ns, and slots."""


class PacedClock:
    """A monotonic clock shared by processes.

    Parameters
    ----------
    path : path
        The clock's file, made by :meth:`create`. Locks of participants are files beside it.
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
        """Make a clock that shows the system's monotonic time and runs ``rate`` times as fast."""
        now = time.monotonic_ns()
        head = [now, round(rate * 1e6), utc_of(now) - now, 0, 0]
        table = memoryview(bytearray(8 * (_SLOTS + MOST_PARTICIPANTS))).cast("q")
        for place, value in enumerate(head):
            table[place] = value
        Path(path).write_bytes(table)
        return cls(path)

    def now_ns(self) -> int:
        """Return the time in ns; it never goes back."""
        table = self._table
        origin = table[_ORIGIN]
        left_out = table[_LEFT_OUT]
        while True:
            system = self._system_ns()
            before, left_out = left_out, table[_LEFT_OUT]
            if before == left_out:
                break  # else more was left out after ``system``: the time would go back
        elapsed = (system - origin) * table[_RATE] // 1_000_000
        now = origin + elapsed - left_out
        n_slots = table[_N_SLOTS]
        if not n_slots:
            return now
        earliest = min(table[_SLOTS : _SLOTS + n_slots])
        if now <= earliest:
            return now
        # Set, not added to: another process may have left out the same meanwhile. If it left out
        # more, that is undone, and left out again at the next look.
        table[_LEFT_OUT] = left_out + now - earliest
        if system > self._looked + _LOOK_FOR_THE_DEAD:
            self._looked = system
            self._forget_the_dead(earliest)
        return earliest

    def now(self) -> float:
        """Return the time in s."""
        return self.now_ns() / NS

    def utc_of(self, monotonic_ns: int) -> int:
        """Return the UTC of an instant of this clock, in ns since 1970."""
        return monotonic_ns + self._table[_UTC]

    def utc_ns(self) -> int:
        """Return the present UTC in ns since 1970."""
        return self.utc_of(self.now_ns())

    @property
    def left_out(self) -> float:
        """Seconds that the system's clock has counted and this one has not."""
        return self._table[_LEFT_OUT] / NS

    @property
    def rate(self) -> float:
        """Seconds of this clock in one of the system's, while nobody is behind."""
        return self._table[_RATE] / 1e6

    def close(self) -> None:
        """Let go of the file."""
        self._table.release()
        self._map.close()

    @contextlib.contextmanager
    def participate(self) -> Iterator[Participant]:
        """Hold the clock while behind, until the context ends."""
        slot, lock = self._take_slot()
        participant = Participant(self._table, _SLOTS + slot)
        self._table[_SLOTS + slot] = self.now_ns() + LONGEST
        try:
            yield participant
        finally:
            participant.let_run_until(_FREE)
            os.close(lock)

    def _take_slot(self) -> tuple[int, int]:
        """Return the first slot that nobody has, and the descriptor that holds its lock."""
        joining = None
        while joining is None:  # one after the other, for they all may raise the number of slots
            joining = _locked(f"{self.path}.join")
        try:
            for slot in range(MOST_PARTICIPANTS):
                lock = _locked(self._lock_path(slot))
                if lock is not None:
                    self._table[_SLOTS + slot] = _FREE
                    self._table[_N_SLOTS] = max(self._table[_N_SLOTS], slot + 1)
                    return slot, lock
        finally:
            os.close(joining)
        raise OSError(f"{self.path}: {MOST_PARTICIPANTS} participants have this clock already")

    def _lock_path(self, slot: int) -> str:
        return f"{self.path}.{slot}"

    def _forget_the_dead(self, earliest: int) -> None:
        for slot in range(self._table[_N_SLOTS]):
            if self._table[_SLOTS + slot] == earliest:
                lock = _locked(self._lock_path(slot))
                if lock is not None:  # its owner has ended without a word
                    self._table[_SLOTS + slot] = _FREE
                    os.close(lock)


@dataclass(frozen=True, slots=True)
class Participant:
    """Somebody whom a clock waits for."""

    table: memoryview[int]
    place: int

    def let_run_until(self, now_ns: int) -> None:
        """Let the clock run until an instant; an earlier one takes nothing back."""
        self.table[self.place] = max(self.table[self.place], now_ns)


def _locked(path: str) -> int | None:
    """Return a descriptor that holds the lock of a file; None if somebody else holds it."""
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

    The best of several looks at both clocks: processes agree to a few microseconds.
    """
    looks = [(time.monotonic_ns(), time.time_ns(), time.monotonic_ns()) for _ in range(20)]
    before, utc, after = min(looks, key=lambda look: look[2] - look[0])
    return monotonic_ns + utc - (before + after) // 2


class _Selector(selectors.SelectSelector):
    """Waits for I/O, lets the clock run meanwhile, and looks at it often.

    Of the system calls, ``select`` alone takes time limits of less than a millisecond.
    """

    participant: Participant | None = None

    def __init__(self, clock: PacedClock, *, only_answers: bool) -> None:
        super().__init__()
        self._clock = clock
        self._only_answers = only_answers
        self._busy = clock.now_ns()
        """Instant at which something came last, or a timer ended that an answer may follow."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return what is ready, or nothing once ``timeout`` is over by the clock."""
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
            # While somebody is behind, everybody else's looks would only take the computer's time.
            pause = min(max(2 * pause, seconds), LONGEST_PAUSE) if now == before else 0.0


class PacedLoop(asyncio.SelectorEventLoop):
    """An event loop that runs by a paced clock, and that the clock waits for while it runs.

    Parameters
    ----------
    clock : PacedClock
        The clock.
    only_answers : bool
        Whether the loop never waits for an answer to what it sends, as a device: it need not look
        at the clock between its timers.
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
