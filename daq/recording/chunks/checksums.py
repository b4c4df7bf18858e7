"""Checks the CRC-32 of many small blocks together.

Theory of operation
-------------------
The stored checksum of a block covers its counts and then its row of the table. Separate calls for
all blocks would cost twice as much as the rest of a read. So blocks of equal length are
concatenated and checksummed together, and the result is compared with the value that their stored
checksums imply. A CRC is linear: the CRC of a message followed by n bytes is the CRC of the message
followed by n zero bytes, XOR the CRC of the n bytes. Appending n zero bytes is a multiplication by
a matrix over GF(2). Neighbours are joined in pairs, then pairs of pairs, and so on.

Single blocks are checked only if the two values differ, or if they are so long that a call costs
less than to concatenate them.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.recording.file_format import BLOCK_DTYPE
from daq.recording.storage.packing import deflate

_POLYNOMIAL = 0xEDB88320  # CRC-32, reflected
_PLACES = np.arange(32, dtype=np.uint32)
_BITS = np.uint32(1) << _PLACES
_LONG = 1 << 13  # bytes of a block
_ROW_BYTES = BLOCK_DTYPE.itemsize - BLOCK_DTYPE["crc32"].itemsize


def intact_blocks(blocks: NDArray[np.void], counts: NDArray[Any]) -> NDArray[np.bool_]:
    """Return whether each block has its stored checksum.

    Parameters
    ----------
    blocks : BLOCK_DTYPE, shape (n_blocks,)
        Contiguous in the file.
    counts : ndarray, shape (n_rows, n_channels)
        Counts from the first block's first row on.

    Returns
    -------
    bool, shape (n_blocks,)
    """
    intact = np.zeros(len(blocks), bool)
    row_bytes = counts.dtype.itemsize * counts.shape[1]
    stored = np.ascontiguousarray(counts).view(f"V{row_bytes}")[:, 0]
    rows = np.ascontiguousarray(blocks).view(np.uint8).reshape(len(blocks), -1)[:, :_ROW_BYTES]
    first = blocks["first_row"] - blocks["first_row"][0]
    for length in sorted(set(blocks["n_samples"].tolist())):
        which = np.flatnonzero(blocks["n_samples"] == length)
        n_bytes = length * row_bytes
        if n_bytes >= _LONG:
            plain = stored.view(np.uint8)
            for at in which.tolist():
                begin = int(first[at]) * row_bytes
                crc = deflate.crc32(rows[at], deflate.crc32(plain[begin : begin + n_bytes]))
                intact[at] = crc == blocks["crc32"][at]
            continue
        content = np.empty((len(which), n_bytes + _ROW_BYTES), np.uint8)
        alike = len(which) == len(blocks)
        taken = stored if alike else stored[first[which, None] + np.arange(length)]
        content[:, :n_bytes] = taken.view(np.uint8).reshape(len(which), n_bytes)
        content[:, n_bytes:] = rows if alike else rows[which]
        expected = blocks["crc32"][which]
        if deflate.crc32(content.data) == _joined(expected, content.shape[1]):
            intact[which] = True
        else:
            found = np.array([deflate.crc32(each) for each in content], np.uint32)
            intact[which] = found == expected
    return intact


def _joined(crcs: NDArray[np.uint32], n_bytes: int) -> int:
    """Return the CRC-32 of concatenated messages of ``n_bytes`` each, from their CRCs."""
    crcs = crcs.astype(np.uint32)
    while len(crcs) > 1:
        if len(crcs) % 2:  # prepend an empty message, whose CRC is 0
            crcs = np.concatenate([np.zeros(1, np.uint32), crcs])
        first, second = crcs[::2], crcs[1::2]
        table = _advance(n_bytes)
        crcs = second.copy()
        for place in range(4):
            crcs ^= table[place][(first >> np.uint32(8 * place)) & np.uint32(255)]
        n_bytes *= 2
    return int(crcs[0])


@lru_cache(maxsize=512)
def _advance(n_bytes: int) -> NDArray[np.uint32]:
    """Return tables, shape (4, 256), that advance each byte of a CRC by zero bytes."""
    every_byte = np.arange(256, dtype=np.uint32) << (8 * np.arange(4, dtype=np.uint32))[:, None]
    return _applied(_power(n_bytes), every_byte)


def _power(n_bytes: int) -> NDArray[np.uint32]:
    """Return the columns of the matrix that advances a CRC by zero bytes, shape (32,)."""
    result = _BITS
    n_bits, place = 8 * n_bytes, 0
    while n_bits:
        if n_bits & 1:
            result = _applied(_doubled(place), result)
        n_bits >>= 1
        place += 1
    return result


@cache
def _doubled(place: int) -> NDArray[np.uint32]:
    """Return the columns of the matrix that advances a CRC by 2**place zero bits."""
    if place == 0:
        return np.concatenate([[np.uint32(_POLYNOMIAL)], _BITS[:-1]])
    half = _doubled(place - 1)
    return _applied(half, half)


def _applied(matrix: NDArray[np.uint32], vectors: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the product of a matrix, by its columns, with each vector of bits."""
    bits = (vectors[..., None] >> _PLACES) & np.uint32(1)
    return np.asarray(np.bitwise_xor.reduce(bits * matrix, axis=-1), np.uint32)
