"""Finding frames of one fixed length in a byte stream, whatever else is in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Callable

OctetArray: TypeAlias = NDArray[np.uint8]
BoolArray: TypeAlias = NDArray[np.bool_]

PIECE = 65536
"""Longest stretch to search at once: bounds the work that garbage can cause."""


def find_frames(
    octets: OctetArray, size: int, valid: Callable[[OctetArray], BoolArray]
) -> tuple[list[tuple[int, int]], int]:
    """Find the frames a scan from the first byte on would find.

    The scan takes a valid frame where there is one and else goes on by one byte. It decides each
    position from the ``size`` bytes that follow, so its result does not depend on how the stream
    was cut into reads.

    Parameters
    ----------
    octets : uint8, shape (n_bytes,)
        Everything received and not yet consumed; at most ``PIECE`` and a frame at a time.
    size : int
        Length of a frame in bytes.
    valid : callable
        Given windows ``(n, size)``, which of them are frames, ``(n,)``.

    Returns
    -------
    runs : list of (offset, n_frames)
        Frames that follow one another without a byte between.
    consumed : int
        Bytes about which all is decided; fewer than ``size`` are left after them.
    """
    n_frames = octets.size // size
    good = valid(octets[: n_frames * size].reshape(n_frames, size))
    n_good = n_frames if good.all() else int(good.argmin())
    runs = [(0, n_good)] if n_good else []
    position = n_good * size
    if n_good == n_frames:
        return runs, position
    at_any = valid(sliding_window_view(octets, size))
    starts = np.flatnonzero(at_any)
    while (following := int(np.searchsorted(starts, position))) < starts.size:
        start = int(starts[following])
        chain = at_any[start::size]
        length = chain.size if chain.all() else int(chain.argmin())
        runs.append((start, length))
        position = start + length * size
    return runs, max(position, octets.size - size + 1)
