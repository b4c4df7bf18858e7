"""Dots in the cells of a terminal, as Braille characters. Does not use Textual."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from estimator.types import FloatArray

DOTS = np.array([[0x01, 0x02, 0x04, 0x40], [0x08, 0x10, 0x20, 0x80]])
"""Bits of the dots of a Braille character, by column and row from the top."""
FIRST = 0x2800
"""The character without dots."""


def joined(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return dots of straight lines from each dot to the next, shape (n,) to (n_more,)."""
    if len(x) < 2:
        return x, y
    across, down = np.diff(x), np.diff(y)
    steps = np.maximum(np.maximum(np.abs(across), np.abs(down)), 1).astype(int)
    step = np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)
    share = step / np.repeat(steps, steps)
    return (
        np.append(
            np.floor(np.repeat(x[:-1], steps) + share * np.repeat(across, steps) + 0.5), x[-1]
        ),
        np.append(np.floor(np.repeat(y[:-1], steps) + share * np.repeat(down, steps) + 0.5), y[-1]),
    )


def cells(x: FloatArray, y: FloatArray, width: int, height: int) -> Iterable[tuple[int, int, str]]:
    """Return column, row and character of each cell with dots; dots outside are left out.

    Parameters
    ----------
    x, y : float64, shape (n,)
        Columns and rows of dots: two and four to a cell.
    width, height : int
        In cells.
    """
    inside = (x >= 0) & (x < 2 * width) & (y >= 0) & (y < 4 * height)
    column, row = x[inside].astype(int), y[inside].astype(int)
    bits = np.zeros((height, width), dtype=np.int64)
    np.bitwise_or.at(bits, (row // 4, column // 2), DOTS[column % 2, row % 4])
    rows, columns = bits.nonzero()
    characters = map(chr, (FIRST + bits[rows, columns]).tolist())
    return zip(columns.tolist(), rows.tolist(), characters, strict=True)
