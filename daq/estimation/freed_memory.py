"""Freed memory of this process, which the C library (glibc) keeps unless it is asked."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache

FREED_FROM = 1 << 25
"""Bytes of the matrices of all frequencies from which an estimate returns memory between stages."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h


def limit(*, mapped: int, returned: int) -> None:
    """Set the bytes of an array that gets a mapping of its own, and of free memory not to keep."""
    option = c_function("mallopt", ctypes.c_int, ctypes.c_int)
    if option is not None:
        option(_M_MMAP_THRESHOLD, mapped)
        option(_M_TRIM_THRESHOLD, returned)


@cache
def reuse() -> None:
    """Make new arrays in the memory of freed ones from now on: once in a process.

    Fresh pages take a seventh of the processor time of an estimate of hours, and a fourth with
    rejection. Its peak is 50 MB higher.
    """
    limit(mapped=1 << 25, returned=1 << 26)


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
