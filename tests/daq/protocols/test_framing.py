"""Frames in a stream that holds other bytes."""

import numpy as np
from numpy.typing import NDArray

from daq.devices.epson.burst import find_frames

SIZE = 6


def valid(windows: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which windows begin with 1 and end with 2."""
    good: NDArray[np.bool_] = (windows[:, 0] == 1) & (windows[:, -1] == 2)
    return good


def scanned(stream: bytes) -> tuple[list[int], int]:
    """Return where frames begin, and the number of bytes decided: one byte after the other."""
    found, at = [], 0
    while at + SIZE <= len(stream):
        good = stream[at] == 1 and stream[at + SIZE - 1] == 2
        if good:
            found.append(at)
        at += SIZE if good else 1
    return found, at


def test_long_garbage_gives_the_frames_of_a_scan() -> None:
    random = np.random.default_rng(3)
    stream = random.integers(0, 4, 200_000, np.uint8).tobytes()

    runs, consumed = find_frames(np.frombuffer(stream, np.uint8), SIZE, valid)

    begins = [start + number * SIZE for start, count in runs for number in range(count)]
    assert (begins, consumed) == scanned(stream)
    assert len(begins) > 5000


def test_search_of_garbage_looks_at_few_windows_at_a_time() -> None:
    most = 0

    def none(windows: NDArray[np.uint8]) -> NDArray[np.bool_]:
        nonlocal most
        most = max(most, windows.size)
        return np.zeros(len(windows), dtype=np.bool_)

    garbage = np.zeros(1_000_000, np.uint8)

    runs, consumed = find_frames(garbage, SIZE, none)

    assert (runs, consumed) == ([], len(garbage) - SIZE + 1)
    assert most <= len(garbage)  # all windows have SIZE times as many bytes
