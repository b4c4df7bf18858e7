"""Reads many small chunks of a dataset together, also from several threads."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.recording.chunks.packing import PIPELINE, unpacked

if TYPE_CHECKING:
    import h5py
    from numpy.typing import NDArray

_KEPT_BYTES = 1 << 20  # of the last read: short recordings are read several times


class ChunkedRows:
    """Reads rows of a chunked dataset.

    Parameters
    ----------
    dataset : h5py.Dataset
        Chunked along its first axis only.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset
        self._length, *columns = dataset.chunks
        self._dtype: np.dtype[Any] = dataset.dtype
        self._corner = (0,) * len(columns)
        created = dataset.id.get_create_plist()
        filters = tuple(created.get_filter(n)[0] for n in range(created.get_nfilters()))
        self._kept: tuple[int, NDArray[Any]] = (0, np.empty((0, *columns), self._dtype))
        self._lock = threading.Lock()
        self._direct = filters == PIPELINE and tuple(columns) == dataset.shape[1:]

    def read(self, first_row: int, last_row: int, n_rows: int) -> NDArray[Any]:
        """Return rows, ``last_row`` not included.

        Whoever reads forwards has each chunk decompressed once: rows of the last read, and of the
        chunk in which it ended, are kept. Threads that read neighbouring rows wait for each other.

        Parameters
        ----------
        first_row, last_row : int
        n_rows : int
            Rows of the dataset that do not change any more.

        Raises
        ------
        OSError, RuntimeError
            If the file is damaged at these rows.
        """
        if self._direct:
            with self._lock:
                begin, kept = self._kept
                if begin <= first_row and last_row <= begin + len(kept):
                    return kept[first_row - begin : last_row - begin]
                whole = (begin + len(kept)) // self._length * self._length - begin
                known, low = kept[:0], first_row // self._length * self._length
                if 0 <= first_row - begin < whole:
                    known, low = kept[first_row - begin : whole], first_row
                # For parts of a chunk HDF5 is used, which caches the chunk.
                if len(known) or last_row - first_row >= self._length:
                    rows = self._decompressed(known, low, last_row, n_rows)
                    if rows is not None:
                        return rows[first_row - low : last_row - low]
        return np.asarray(self._dataset[first_row:last_row])

    def _decompressed(
        self, known: NDArray[Any], low: int, last_row: int, n_rows: int
    ) -> NDArray[Any] | None:
        """Return rows from ``low`` on, the first of which are known; None if HDF5 must read them.

        The rows after the known ones begin a chunk.
        """
        start = low + len(known)
        fetch, corner = self._dataset.id.read_direct_chunk, self._corner
        try:
            stored = [fetch((row, *corner)) for row in range(start, last_row, self._length)]
        except (OSError, RuntimeError):
            return None
        rows = np.empty((len(known) + len(stored) * self._length, *known.shape[1:]), self._dtype)
        rows[: len(known)] = known
        if not unpacked(stored, rows[len(known) :]):
            return None
        rows = rows[: n_rows - low]
        rows.flags.writeable = False
        # The next read begins in a chunk that is not in these rows, or in the rows that are kept.
        excess = rows.nbytes - _KEPT_BYTES
        dropped = -(-excess // (rows.nbytes // len(rows))) if excess > 0 else 0
        self._kept = low + dropped, rows[dropped:].copy() if dropped else rows
        return rows
