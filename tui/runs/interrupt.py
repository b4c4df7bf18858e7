"""Ctrl-C during a run: the first ends the recording and keeps the result, the second aborts."""

from __future__ import annotations

import logging
import signal
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType


_LOGGER = logging.getLogger(__name__)


@dataclass(slots=True)
class Interruption:
    """Whether Ctrl-C has been pressed."""

    pressed: bool = False


@contextmanager
def defer_interrupt(stop: Callable[[], None]) -> Iterator[Interruption]:
    """Call `stop` at the first Ctrl-C, and raise `KeyboardInterrupt` at the second.

    Raises
    ------
    KeyboardInterrupt
        At the second.
    """
    found = Interruption()
    before = signal.getsignal(signal.SIGINT)

    def note(_number: int, _frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, before)
        found.pressed = True
        _LOGGER.warning("stopping; the result follows. Press Ctrl-C again to end without it")
        stop()

    signal.signal(signal.SIGINT, note)
    try:
        yield found
    finally:
        signal.signal(signal.SIGINT, before)
