"""Freed memory of this process, which the C library (glibc) keeps unless it is asked."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache

LARGE = 1 << 21
"""Size in bytes from which an array of a live estimate gets a mapping of its own. Mappings cost
system time. Live estimate of 2 h of three triaxial sensors: 2 s without mappings, 8 s with this
limit, 14 s with 128 kB; the peaks are 237, 187 and 181 MB. Its arrays are smaller."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h


def limit() -> None:
    """Give arrays from `LARGE` on mappings of their own, and keep little freed memory."""
    option = c_function("mallopt", ctypes.c_int, ctypes.c_int)
    if option is not None:
        option(_M_MMAP_THRESHOLD, LARGE)
        option(_M_TRIM_THRESHOLD, 1 << 17)


def give_back() -> None:
    """Return freed memory to the system, where the C library can do so.

    Between two stages of an estimate of many channels a fifth of its memory is free and not
    returned: in arrays that are smaller than those which get a mapping of their own.
    """
    trim = c_function("malloc_trim", ctypes.c_size_t)
    if trim is not None:
        trim(0)


@cache
def c_function(name: str, *arguments: type[ctypes._SimpleCData[int]]) -> Callable[..., int] | None:
    """Return a function of the C library; None where it has none of this name (musl)."""
    if sys.platform != "linux":
        return None
    function = getattr(ctypes.CDLL(None), name, None)
    if function is not None:
        function.argtypes, function.restype = arguments, ctypes.c_int
    return function
