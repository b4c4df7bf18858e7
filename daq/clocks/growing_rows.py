"""Rows of numbers that come a few at a time, for as long as a recording grows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_Number = TypeVar("_Number", bound=np.generic)


class GrowingRows(Generic[_Number]):
    """One array that is doubled when it is full: an array for each row takes ten times as much.

    Parameters
    ----------
    dtype : type
    columns : int
        Numbers in a row.
    """

    def __init__(self, dtype: type[_Number], *columns: int) -> None:
        self._rows: NDArray[_Number] = np.empty((16, *columns), dtype)
        self._n = 0

    def __len__(self) -> int:
        return self._n

    def add(self, rows: NDArray[Any]) -> None:
        """Append rows, shape (n, columns)."""
        end = self._n + len(rows)
        if end > len(self._rows):
            room = np.empty((max(end, 2 * self._n), *self._rows.shape[1:]), self._rows.dtype)
            room[: self._n] = self.values
            self._rows = room
        self._rows[self._n : end] = rows
        self._n = end

    def clear(self) -> None:
        """Drop all rows."""
        self._rows, self._n = self._rows[:16].copy(), 0

    @property
    def values(self) -> NDArray[_Number]:
        """All rows, shape (n, columns): later ones do not change them."""
        return self._rows[: self._n]
