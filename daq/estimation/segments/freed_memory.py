"""Returns freed memory to the system.

The C library keeps what arrays of many sizes, made by several threads, have freed: up to 35 MB
beside an estimate of nine channels, for as long as it is followed.
"""

from __future__ import annotations

import ctypes
import sys
import time
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

INTERVAL = 20.0
"""Seconds between returns, at least."""


class FreedMemory:
    """Freed memory of this process."""

    def __init__(self) -> None:
        self._next = 0.0

    def give_back(self) -> None:
        """Return it to the system, every `INTERVAL`, where the C library can do so (glibc)."""
        trim = _trim()
        if trim is not None and time.monotonic() >= self._next:
            self._next = time.monotonic() + INTERVAL
            trim(0)


@cache
def _trim() -> Callable[[int], int] | None:
    if sys.platform != "linux":
        return None
    function = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
    if function is not None:
        function.argtypes, function.restype = (ctypes.c_size_t,), ctypes.c_int
    return function
