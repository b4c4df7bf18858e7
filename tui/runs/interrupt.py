"""The first Ctrl-C while a result is being made waits for it; the second does not."""

from __future__ import annotations

import signal
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tui.output.console import notices

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType


@dataclass(slots=True)
class Interruption:
    """Whether Ctrl-C has been pressed."""

    pressed: bool = False


@contextmanager
def defer_interrupt(*, spent: bool = False) -> Iterator[Interruption]:
    """Take note of the first Ctrl-C, and be ended by the second; by the first where `spent`.

    Raises
    ------
    KeyboardInterrupt
        At the second.
    """
    found = Interruption(spent)
    before = signal.getsignal(signal.SIGINT)

    def note(_number: int, _frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, before)
        found.pressed = True
        notices().print("the result is being made; Ctrl-C once more ends without it")

    if not spent:
        signal.signal(signal.SIGINT, note)
    try:
        yield found
    finally:
        signal.signal(signal.SIGINT, before)
