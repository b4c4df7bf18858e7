"""Chunks of complete files as these hold them: compressed where that gains a third, else raw.

HDF5 holds one lock for the whole process while it runs its filters. So chunks are packed and
unpacked here, and HDF5 stores and fetches them as they are; the mask of a chunk says which filters
of its dataset were left out, so that any HDF5 program can read it.

ISA-L compresses eight times as fast as zlib, into the same kind of stream, and inflates in two
thirds of its time. Samples with much noise shrink by a quarter, and to inflate them would take
longer than the rest of an estimate: their chunks are raw.

The Adler-32 in a stream, over the bytes before compression, shows whether a chunk is intact; the
CRC-32 of its blocks shows it for every chunk. The Fletcher-32 of HDF5 adds nothing: it is not
written any more, and not checked.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

try:
    from isal import isal_zlib as deflate
except ModuleNotFoundError:  # the extra "fast" is not installed
    import zlib as deflate  # type: ignore[no-redef]  # the same interface


__all__ = ["PIPELINE", "RAW", "InflationError", "check_chunks", "deflate", "packed", "unpacked"]

PIPELINE = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32)
"""The filters of a dataset in chunks."""
RAW = 0b111
"""Mask of a chunk that went through no filter."""
_NO_FLETCHER = 0b100
_LEVEL = 1
_GAIN = 1 / 3
"""The share of its bytes that a chunk must lose to be compressed."""


class InflationError(OSError):
    """A chunk of a damaged or foreign file becomes more than its dataset says."""


def packed(chunk: NDArray[Any]) -> tuple[bytes, int]:
    """Return a whole chunk as it is stored, and the mask of its filters.

    Parameters
    ----------
    chunk : ndarray
        Contiguous, of the type of its dataset.
    """
    plain = chunk.tobytes()
    shuffled = np.frombuffer(plain, np.uint8).reshape(-1, chunk.itemsize).T.tobytes()
    stream = deflate.compress(shuffled, _LEVEL)
    if len(stream) > (1 - _GAIN) * len(plain):
        return plain, RAW
    return stream, _NO_FLETCHER


def unpacked(stored: Sequence[tuple[int, bytes | memoryview]], rows: NDArray[Any]) -> bool:
    """Put the contents of chunks into rows; return False where HDF5 must read them.

    Parameters
    ----------
    stored : sequence of (int, bytes)
        Mask and bytes of each chunk.
    rows : ndarray
        As long as the chunks together.

    Raises
    ------
    InflationError
        If a stream becomes more than its chunk: HDF5 would inflate all of it.
    """
    size = rows.itemsize
    places = rows.view(np.uint8).reshape(len(stored), -1)
    n_bytes = places.shape[1]
    shuffled: list[int] = []
    streams: list[bytes] = []
    for number, (mask, content) in enumerate(stored):
        if mask & 0b11 == 0b11:
            if len(content) < n_bytes:
                return False
            places[number] = np.frombuffer(content, np.uint8, n_bytes)
        elif mask & 0b11:
            return False
        else:
            try:
                inflate = deflate.decompressobj()
                streams.append(inflate.decompress(content, n_bytes + 1))
            except deflate.error:  # type: ignore[misc]  # a class: its stub says instance
                return False
            if len(streams[-1]) > n_bytes:
                raise InflationError(f"a chunk of {n_bytes} bytes inflates to more")
            if len(streams[-1]) != n_bytes or not inflate.eof:
                return False
            shuffled.append(number)
    if streams:
        parts = np.frombuffer(b"".join(streams), np.uint8).reshape(len(streams), size, -1)
        whole = places.reshape(len(stored), -1, size)
        which = slice(None) if len(streams) == len(stored) else shuffled
        for place in range(size):  # in turn: for few bytes a value this is the fastest
            whole[which, :, place] = parts[:, place]
    return True


def check_chunks(dataset: h5py.Dataset, first_row: int = 0, last_row: int | None = None) -> None:
    """Inflate the chunks of rows as far as their dataset says, before HDF5 inflates all of them.

    Parameters
    ----------
    dataset : h5py.Dataset
        Whose filters are some of `PIPELINE`, in this order.
    first_row, last_row : int
        Rows, without ``last_row``; default: all.

    Raises
    ------
    InflationError
        If one becomes more.
    """
    created = dataset.id.get_create_plist()
    filters = [created.get_filter(number)[0] for number in range(created.get_nfilters())]
    if h5py.h5z.FILTER_DEFLATE not in filters:
        return
    is_left_out = 1 << filters.index(h5py.h5z.FILTER_DEFLATE)
    n_bytes = math.prod(dataset.chunks) * dataset.dtype.itemsize
    (n_rows, *shape), (length, *others) = dataset.shape, dataset.chunks
    last_row = n_rows if last_row is None else min(last_row, n_rows)
    rows = range(first_row // length * length, last_row, length)
    columns = (range(0, size, step) for size, step in zip(shape, others, strict=True))
    for corner in itertools.product(rows, *columns):
        with contextlib.suppress(RuntimeError, ValueError, KeyError):  # HDF5 names it
            mask, content = dataset.id.read_direct_chunk(corner)
            if mask & is_left_out:
                continue
            with contextlib.suppress(deflate.error):  # type: ignore[arg-type]  # as above
                if len(deflate.decompressobj().decompress(content, n_bytes + 1)) > n_bytes:
                    raise InflationError(f"a chunk of {n_bytes} bytes inflates to more")
