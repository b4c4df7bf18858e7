"""Freed memory of this process, which the C library (glibc) keeps unless it is asked."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache

FREED_FROM = 1 << 25
"""Bytes of the matrices of all frequencies from which an estimate returns memory between stages."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Of malloc.h: free bytes at the end of the memory from which they return to the system, and size
of an array from which it gets a mapping of its own."""
_MAPPED, _RETURNED = 1 << 25, 1 << 26  # mappings of arrays cost their pages anew


@cache
def reuse() -> None:
    """Make new arrays in the memory of freed ones from now on: once in a process.

    Fresh pages take a seventh of the processor time of an estimate of hours, and a fourth with
    rejection. Its peak is 50 MB higher.
    """
    option = c_function("mallopt", ctypes.c_int, ctypes.c_int)
    if option is not None:
        option(M_MMAP_THRESHOLD, _MAPPED)
        option(M_TRIM_THRESHOLD, _RETURNED)


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
