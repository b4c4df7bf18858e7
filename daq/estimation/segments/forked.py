"""Work on pieces of a recording by forks of this process, handed back in the order of the pieces.

Theory of operation
-------------------
A fork has the clocks, the filters and the open file of this process, and imports nothing. Files are
read at given places (`pread`), so that processes share no position. Piece n belongs to fork n
modulo their number. Each fork writes what it found into one of two rooms of memory that both
processes see, and then one byte to a pipe; it takes a room again once a byte from a second pipe
says that the room is free. Whoever takes the pieces in order adds the same numbers in the same
order as one process.

A fork ignores Ctrl-C, which reaches all processes of a terminal: this process ends its forks. Where
this process is killed, their pipes end, and so do they.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import signal
import sys
import warnings
from collections.abc import Callable, Generator, Sequence
from itertools import cycle
from typing import Any, Generic, Never, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from daq.errors import EndedProcessError

IS_POSSIBLE = sys.platform == "linux"
"""Whether this system's libraries survive a fork: those of macOS do not, Windows has none."""
ROOMS = 2
"""Rooms of each fork: one is filled while the other one is emptied."""
_Piece = TypeVar("_Piece")
_Room = TypeVar("_Room")


def shared(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return zeros in memory that forks made later share with this process."""
    n_values = math.prod(shape)
    memory = mmap.mmap(-1, max(1, n_values * np.dtype(dtype).itemsize))
    return np.frombuffer(memory, dtype, n_values).reshape(shape)


def worked_out(
    work: Callable[[_Piece, _Room], bool],
    pieces: Sequence[_Piece],
    rooms: Sequence[Sequence[_Room]],
) -> Generator[_Room | None]:
    """Yield the room of each piece in order; None where `work` put nothing there, or failed.

    Parameters
    ----------
    work : callable
        Puts a piece into a room, in a fork; returns whether it did.
    pieces : sequence
    rooms : sequence of sequences
        `ROOMS` of each fork. A room is valid until the next one is asked for.

    Raises
    ------
    EndedProcessError
        If a fork ends early.
    """
    forks: list[_Fork[_Room]] = []
    try:
        for number, own in enumerate(rooms):
            forks.append(_Fork(work, pieces[number :: len(rooms)], own))
        for number in range(len(pieces)):
            fork = forks[number % len(forks)]
            yield fork.receive()
            fork.release()
    finally:
        for fork in forks:
            fork.end()


class _Fork(Generic[_Room]):
    """A fork, and this process's ends of its pipes."""

    def __init__(
        self,
        work: Callable[[_Piece, _Room], bool],
        pieces: Sequence[_Piece],
        rooms: Sequence[_Room],
    ) -> None:
        self._rooms = cycle(rooms)
        self._filled, filled = os.pipe()
        emptied, self._emptied = os.pipe()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            with warnings.catch_warnings():  # of threads, none of which this work needs
                warnings.simplefilter("ignore", DeprecationWarning)
                self._pid = os.fork()
            if not self._pid:
                os.close(self._filled)
                os.close(self._emptied)
                _work_through(work, pieces, self._rooms, filled, emptied)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        os.close(filled)
        os.close(emptied)

    def receive(self) -> _Room | None:
        """Wait for the next piece."""
        found = os.read(self._filled, 1)
        if not found:
            pid, self._pid = self._pid, 0
            code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            raise EndedProcessError(
                f"a process of the estimate was ended ({_described(code)}), perhaps for lack of"
                " memory; run again, or with --jobs 1"
            )
        room = next(self._rooms)
        return room if found == _FILLED else None

    def release(self) -> None:
        """Let the fork fill the room again."""
        with contextlib.suppress(BrokenPipeError):  # it had no more pieces
            os.write(self._emptied, _FILLED)

    def end(self) -> None:
        """End the fork, whatever it does."""
        os.close(self._filled)
        os.close(self._emptied)
        if self._pid:
            os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)


_FILLED, _NOT_FILLED = b"+", b"-"


def _work_through(
    work: Callable[[_Piece, _Room], bool],
    pieces: Sequence[_Piece],
    rooms: cycle[_Room],
    filled: int,
    emptied: int,
) -> Never:
    """Work out the pieces of this fork, and end it without the exit of the other process."""
    code = 1
    try:
        for number, piece in enumerate(pieces):
            if number >= ROOMS and not os.read(emptied, 1):
                break  # nobody is left who takes it
            is_filled = False
            with contextlib.suppress(Exception):  # the other process meets it again, and says it
                is_filled = work(piece, next(rooms))
            os.write(filled, _FILLED if is_filled else _NOT_FILLED)
        code = 0
    finally:
        os._exit(code)


def _described(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
