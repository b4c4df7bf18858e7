"""The service's clock: the system's, or one that a test hands in.

Linux ends a read of a ``timerfd`` with the flag ``TFD_TIMER_CANCEL_ON_SET`` when the clock is set.
Where there is none, steps are found by comparison with a clock that is never set.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import sys
import time
from collections.abc import Callable, Iterator
from datetime import datetime

from daq.recorder.clock_trust import clock_state
from daq.recorder.schedule import utc_now

_ABSOLUTE, _CANCEL_ON_SET = 1, 2
_FAR = 2**31 - 1
"""Seconds since 1970 at which the timer would end, if the clock were never set."""


class SystemTime:
    """The system's clock, which may be set."""

    def now(self) -> datetime:
        """Return the time, in UTC."""
        return utc_now()

    def elapsed(self) -> float:
        """Return seconds of a clock that is never set, and goes on while the computer sleeps."""
        boot = getattr(time, "CLOCK_BOOTTIME", None)  # Linux
        return time.monotonic() if boot is None else time.clock_gettime(boot)

    async def sleep(self, seconds: float, wake: asyncio.Event) -> None:
        """Let seconds pass, or fewer if the event is set."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await wake.wait()

    def is_synchronised(self) -> bool | None:
        """Return whether something keeps the clock right; None if unknown."""
        state = clock_state()
        return None if state is None else state.synchronised

    @contextlib.contextmanager
    def watched(self, on_step: Callable[[], None]) -> Iterator[None]:
        """Call a function of the event loop whenever the clock was set, where the system can."""
        try:
            timer = StepTimer()
        except (OSError, AttributeError):
            yield
            return
        loop = asyncio.get_running_loop()

        def look() -> None:
            if timer.was_set():
                on_step()

        try:
            loop.add_reader(timer.descriptor, look)
            yield
        finally:
            loop.remove_reader(timer.descriptor)
            timer.close()


class StepTimer:
    """A timer that becomes readable when the system's clock is set.

    Raises
    ------
    OSError, AttributeError
        If the system has none.
    """

    def __init__(self) -> None:
        if sys.platform != "linux":
            raise OSError("timers that end when the clock is set are Linux's")
        self._libc = ctypes.CDLL(None, use_errno=True)
        flags = os.O_NONBLOCK | os.O_CLOEXEC
        self.descriptor: int = self._libc.timerfd_create(time.CLOCK_REALTIME, flags)
        if self.descriptor < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        try:
            self._arm()
        except OSError:
            self.close()
            raise

    def was_set(self) -> bool:
        """Return whether the clock was set since the last call."""
        try:
            os.read(self.descriptor, 8)
        except BlockingIOError:
            return False
        except OSError:  # ECANCELED
            self._arm()
        return True

    def close(self) -> None:
        """Free the timer."""
        os.close(self.descriptor)

    def _arm(self) -> None:
        at = (ctypes.c_long * 4)(0, 0, _FAR, 0)  # interval and end: s, ns
        flags = _ABSOLUTE | _CANCEL_ON_SET
        if self._libc.timerfd_settime(self.descriptor, flags, ctypes.byref(at), None) < 0:
            raise OSError(ctypes.get_errno(), "timerfd_settime")
