"""Frames of one fixed length in a byte stream that may hold other bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Callable

OctetArray: TypeAlias = NDArray[np.uint8]
BoolArray: TypeAlias = NDArray[np.bool_]

_WINDOWS_AT_ONCE = 1 << 14
"""Bounds the memory that a search of garbage takes."""


def find_frames(
    octets: OctetArray, size: int, valid: Callable[[OctetArray], BoolArray]
) -> tuple[list[tuple[int, int]], int]:
    """Return the frames that a scan from the first byte finds.

    At each position the scan takes a valid frame if there is one, else advances by one byte. Each
    decision uses only the next ``size`` bytes, so the result does not depend on how the stream was
    cut into reads.

    Parameters
    ----------
    octets : uint8, shape (n_bytes,)
        All bytes received and not yet consumed.
    size : int
        Length of a frame in bytes.
    valid : callable
        Maps windows, shape (n, size), to whether each is a frame, shape (n,).

    Returns
    -------
    runs : list of (offset, n_frames)
        Runs of adjacent frames.
    consumed : int
        Number of decided bytes; fewer than ``size`` bytes remain after them.
    """
    n_frames = octets.size // size
    good = valid(octets[: n_frames * size].reshape(n_frames, size))
    n_good = n_frames if good.all() else int(good.argmin())
    runs = [(0, n_good)] if n_good else []
    position = n_good * size
    if n_good == n_frames:
        return runs, position
    windows = sliding_window_view(octets, size)
    pieces = range(0, len(windows), _WINDOWS_AT_ONCE)
    at_any = np.concatenate([valid(windows[at : at + _WINDOWS_AT_ONCE]) for at in pieces])
    starts = np.flatnonzero(at_any)
    while (following := int(np.searchsorted(starts, position))) < starts.size:
        start = int(starts[following])
        chain = at_any[start::size]
        length = chain.size if chain.all() else int(chain.argmin())
        runs.append((start, length))
        position = start + length * size
    return runs, max(position, octets.size - size + 1)
