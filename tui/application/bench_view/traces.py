"""Traces of channels as rows of Braille characters. Does not use Textual."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tui.application.test_view.braille import DOTS, FIRST

if TYPE_CHECKING:
    from numpy.typing import NDArray


def trace(values: NDArray[np.float64], *, width: int) -> str:
    """Return one row that shows the range of the values in each of its dot columns.

    The scale is that of the values: their range is the height of the row. Constant values are a
    line in the middle.
    """
    n_columns = 2 * width
    if len(values) < 2 or width < 1:
        return " " * max(width, 0)
    edges = np.linspace(0, len(values), min(n_columns, len(values)) + 1).astype(int)
    high = np.maximum.reduceat(values, edges[:-1])
    low = np.minimum.reduceat(values, edges[:-1])
    bottom, span = float(low.min()), float(np.ptp(values))
    if span == 0:
        first = last = np.full(len(high), 2)
    else:
        first, last = (
            np.clip(np.floor((1 - (each - bottom) / span) * 4), 0, 3).astype(int)
            for each in (high, low)
        )
    column = np.arange(n_columns)
    at, row = column * len(high) // n_columns, np.arange(4)
    is_set = (row >= first[at, None]) & (row <= last[at, None])
    cells = (is_set * DOTS[column % 2]).sum(axis=1).reshape(width, 2).sum(axis=1)
    text: bytes = (FIRST + cells).astype("<u2").tobytes()
    return text.decode("utf-16-le")
