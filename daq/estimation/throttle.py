"""Live estimates come less often where one takes long, so that the machine stays free to record."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_CPU_SHARE = 0.1
"""Of the time, at most, that live estimates may take."""


class Throttle:
    """Says when the next estimate is due; around each one, a context that takes its time.

    Parameters
    ----------
    now : callable
        Seconds of a clock that never goes back.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._began = self._next = now()

    @property
    def due(self) -> bool:
        """Whether estimates since the first have taken no more than their share."""
        return self._now() >= self._next

    def __enter__(self) -> Self:
        self._began = self._now()
        return self

    def __exit__(self, *_: object) -> None:
        self._next = self._began + (self._now() - self._began) / MAX_CPU_SHARE
