"""Reads many small chunks of a dataset together, also from several threads.

HDF5 takes longer to fetch a small chunk than to read it. So where a file is closed, the raw chunks
are located once, and read from the file as they are, many at a time. Checksums are of blocks, so
whoever reads them finds out what is damaged.
"""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.recording.storage.packing import PIPELINE, RAW, InflationError, check_chunks, unpacked

if TYPE_CHECKING:
    import h5py
    from numpy.typing import NDArray

_KEPT_BYTES = 1 << 20  # of the last read: short recordings are read several times
_LOCATED_FROM = 1 / 16  # share of the chunks that is fetched before all are located


class RawChunks:
    """Reads chunks that went through no filter from the file itself.

    Parameters
    ----------
    dataset : h5py.Dataset
        Of a closed file, in chunks along its first axis only.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._file, self._length = dataset.file.id, dataset.chunks[0]
        row_bytes = dataset.dtype.itemsize * int(np.prod(dataset.chunks[1:]))
        self._n_bytes = self._length * row_bytes
        self._at = np.full(-(-len(dataset) // self._length), -1, np.int64)
        """Byte of the file at which each chunk begins; -1 for one that is not raw."""
        file = dataset.file
        if file.driver == "sec2" and not file.userblock_size and hasattr(os, "preadv"):
            dataset.id.chunk_iter(self._note)

    def _note(self, chunk: Any) -> None:  # noqa: ANN401 - h5py names no type
        if chunk.filter_mask == RAW and chunk.size == self._n_bytes:
            self._at[chunk.chunk_offset[0] // self._length] = chunk.byte_offset

    def read(self, first: int, rows: NDArray[Any]) -> bool:
        """Put the contents of chunks, from chunk `first` on, into rows; return False if not all.

        Raises
        ------
        OSError
            If the file cannot be read.
        """
        plain = rows.view(np.uint8).reshape(-1).data
        at = self._at[first : first + len(plain) // self._n_bytes]
        if len(at) * self._n_bytes < len(plain) or (at < 0).any():
            return False
        cuts = np.flatnonzero(np.diff(at) != self._n_bytes) + 1
        for begin, end in zip([0, *cuts.tolist()], [*cuts.tolist(), len(at)], strict=True):
            part = plain[begin * self._n_bytes : end * self._n_bytes]
            if os.preadv(self._file.get_vfd_handle(), [part], int(at[begin])) < len(part):
                return False
        return True


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
        self._checked: set[int] = set()
        """First rows of the chunks that inflate to no more than their size."""
        self._n_fetched = 0
        self._raw: RawChunks | None = None
        self.is_closed = False
        """Whether the file is closed: its chunks stay where they are."""

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
        self._check_chunks(first_row, last_row)
        return np.asarray(self._dataset[first_row:last_row])

    def _check_chunks(self, first_row: int, last_row: int) -> None:
        """Refuse chunks that HDF5 would inflate beyond their size; each is looked at once."""
        for row in range(first_row // self._length * self._length, last_row, self._length):
            if row not in self._checked:
                check_chunks(self._dataset, row, row + self._length)
                self._checked.add(row)

    def _decompressed(
        self, known: NDArray[Any], low: int, last_row: int, n_rows: int
    ) -> NDArray[Any] | None:
        """Return rows from ``low`` on, the first of which are known; None if HDF5 must read them.

        The rows after the known ones begin a chunk.
        """
        start = low + len(known)
        n_chunks = -(-(last_row - start) // self._length)
        rows = np.empty((len(known) + n_chunks * self._length, *known.shape[1:]), self._dtype)
        rows[: len(known)] = known
        try:
            if not self._filled(rows[len(known) :], start):
                return None
        except InflationError:
            raise
        except (OSError, RuntimeError):
            return None
        rows = rows[: n_rows - low]
        rows.flags.writeable = False
        # The next read begins in a chunk that is not in these rows, or in the rows that are kept.
        excess = rows.nbytes - _KEPT_BYTES
        dropped = -(-excess // (rows.nbytes // len(rows))) if excess > 0 else 0
        self._kept = low + dropped, rows[dropped:].copy() if dropped else rows
        return rows

    def _filled(self, rows: NDArray[Any], start: int) -> bool:
        """Put whole chunks, from row ``start`` of the dataset on, into rows; return if all are."""
        self._n_fetched += len(rows) // self._length
        many = self._n_fetched * self._length >= _LOCATED_FROM * len(self._dataset)
        if self._raw is None and self.is_closed and many:
            self._raw = RawChunks(self._dataset)
        if self._raw is not None and self._raw.read(start // self._length, rows):
            return True
        fetch, end = self._dataset.id.read_direct_chunk, start + len(rows)
        stored = [fetch((row, *self._corner)) for row in range(start, end, self._length)]
        return unpacked(stored, rows)
