"""Reads many small chunks of a dataset together, also from several threads.

HDF5 holds one lock for the whole process while it reads and decompresses. So HDF5 only reads the
stored chunks. ISA-L decompresses them without a lock, in little more than half of zlib's time; zlib
is the fallback. Then numpy unshuffles the bytes of all chunks together.

The Adler-32 in the zlib stream, over the decompressed bytes, shows whether a chunk is intact. The
Fletcher-32 that HDF5 appends, over the compressed bytes, adds nothing and is not checked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

try:
    from isal import isal_zlib as inflater
except ModuleNotFoundError:  # the extra "fast" is not installed
    import zlib as inflater  # type: ignore[no-redef]  # the same interface

if TYPE_CHECKING:
    from numpy.typing import NDArray

_KEPT_BYTES = 1 << 20  # cache of the last read: short recordings are read several times
_PIPELINE = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32)


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
        self._n_bytes = int(np.prod(dataset.chunks)) * self._dtype.itemsize
        created = dataset.id.get_create_plist()
        filters = tuple(created.get_filter(n)[0] for n in range(created.get_nfilters()))
        self._last: tuple[int, NDArray[Any]] = (0, np.empty((0, *columns), self._dtype))
        self._direct = filters == _PIPELINE and tuple(columns) == dataset.shape[1:]

    def read(self, first_row: int, last_row: int) -> NDArray[Any]:
        """Return rows, ``last_row`` not included.

        Raises
        ------
        OSError, RuntimeError
            If the file is damaged at these rows.
        """
        # For parts of a chunk HDF5 is used, which caches the chunk.
        if self._direct and last_row - first_row >= self._length:
            kept_from, kept = self._last
            if kept_from <= first_row and last_row <= kept_from + len(kept):
                return kept[first_row - kept_from : last_row - kept_from]
            rows = self._decompressed(first_row, last_row)
            if rows is not None:
                return rows
        return np.asarray(self._dataset[first_row:last_row])

    def _decompressed(self, first_row: int, last_row: int) -> NDArray[Any] | None:
        """Return rows, or None if HDF5 must read them."""
        start = first_row // self._length * self._length
        fetch, corner, n_bytes = self._dataset.id.read_direct_chunk, self._corner, self._n_bytes
        try:
            stored = [fetch((row, *corner)) for row in range(start, last_row, self._length)]
            if any(skipped for skipped, _ in stored):  # stored without compression
                return None
            inflate, bits = inflater.decompress, inflater.MAX_WBITS
            chunks = [inflate(content, bits, n_bytes) for _, content in stored]
        except (OSError, RuntimeError, inflater.error):  # type: ignore[misc]  # a class: its stub says instance
            return None
        if any(len(chunk) != n_bytes for chunk in chunks):
            return None
        shuffled = np.frombuffer(b"".join(chunks), np.uint8)
        shuffled = shuffled.reshape(len(chunks), self._dtype.itemsize, -1)
        whole = np.empty((len(chunks), shuffled.shape[2], self._dtype.itemsize), np.uint8)
        for place in range(self._dtype.itemsize):
            whole[:, :, place] = shuffled[:, place]
        rows = whole.view(self._dtype).reshape(-1, *self._dataset.shape[1:])[: last_row - start]
        rows.flags.writeable = False
        if rows.nbytes <= _KEPT_BYTES:
            self._last = start, rows
        return rows[first_row - start :]
