"""The recording that the Signal view shows: opened for it, or followed while it grows."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from daq.estimation.throttle import Throttle
from daq.recording.reader import Recording
from daq.results.signal import Signal

_SHARE = 0.03
"""Of the time of the thread that follows a recording."""


class SignalSource:
    """Gives the signal of one recording at a time.

    A growing recording is open once in a process: the thread that follows it calls `look`, and
    alone takes new blocks, gaps and events. Samples and extremes may be read beside it.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        """To be held while a signal is used."""
        self.is_wanted = False
        """Whether somebody looks at a growing recording."""
        self._signal: Signal | None = None
        self._opened: Recording | None = None
        self._throttle = Throttle(_SHARE)
        self.version = 0
        """Differs after each change of the signal."""

    def look(self, recording: Recording) -> None:
        """Take what a growing recording has; in the thread that follows it."""
        if not self.is_wanted or recording.closed or not self._throttle.is_due:
            return
        with self.lock, self._throttle:
            if self._signal is None or self._signal.recording is not recording:
                self._close()
                self._signal = Signal(recording)
            else:
                self._signal.refresh()
            self.version += 1

    def signal(
        self, path: Path, *, is_growing: bool, progress: Callable[[int, int], object]
    ) -> Signal | None:
        """Return the signal of a recording, with `lock` held; None of one not yet followed.

        `progress` receives how many rows of how many are read.

        Raises
        ------
        HuddleError, OSError
            If it cannot be read.
        """
        known = self._signal
        is_own = self._opened is not None
        if known is not None and known.recording.path == path and is_own != is_growing:
            return known
        if is_growing:
            return None
        self._close()
        self._opened = recording = Recording.open(path)
        total, done = sum(sensor.n_samples for sensor in recording.sensors), 0

        def read(n_rows: int) -> None:
            nonlocal done
            done += n_rows
            progress(done, total)

        self._signal = Signal(recording, read)
        self.version += 1
        return self._signal

    def close(self) -> None:
        """Close what was opened here."""
        with self.lock:
            self._close()

    def _close(self) -> None:
        if self._opened is not None:
            self._opened.close()
        self._signal = self._opened = None
