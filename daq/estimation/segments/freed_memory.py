"""Returns freed memory to the system.

The C library (glibc) keeps what arrays of many sizes, made by several threads, have freed, for as
long as a recording is followed. Once one array of 30 MB has been freed, it takes all later ones
from its heap, which shrinks only at its end, and it has a heap for each thread: after a day these
held 80 MB beside an estimate of nine channels. So large arrays get a mapping each, which goes back
when they are freed, and all threads share two heaps.
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
LARGE = 1 << 21
"""Size in bytes from which an array gets a mapping of its own. Mappings cost system time. Estimate
of 2 h of three triaxial sensors: 2 s without mappings, 8 s with this limit, 14 s with 128 kB; the
peaks are 237, 187 and 181 MB. Arrays of a live estimate are smaller."""
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # of malloc.h
_HEAPS = 2


class FreedMemory:
    """Freed memory of this process, of which the C library keeps less from now on."""

    def __init__(self) -> None:
        self._next = 0.0
        option = _function("mallopt", ctypes.c_int, ctypes.c_int)
        if option is not None:
            option(_M_MMAP_THRESHOLD, LARGE)
            option(_M_ARENA_MAX, _HEAPS)

    def give_back(self) -> None:
        """Return it to the system, every `INTERVAL`, where the C library can do so (glibc)."""
        trim = _function("malloc_trim", ctypes.c_size_t)
        if trim is not None and time.monotonic() >= self._next:
            self._next = time.monotonic() + INTERVAL
            trim(0)


@cache
def _function(name: str, *arguments: type[ctypes._SimpleCData[int]]) -> Callable[..., int] | None:
    """Return a function of the C library; None where it has none of this name (musl)."""
    if sys.platform != "linux":
        return None
    function = getattr(ctypes.CDLL(None), name, None)
    if function is not None:
        function.argtypes, function.restype = arguments, ctypes.c_int
    return function
