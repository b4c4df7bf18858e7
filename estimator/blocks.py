"""Blocks of frequencies whose matrices are worked on together."""

from __future__ import annotations

from collections.abc import Iterator

BLOCK_BYTES = 1 << 20
"""Bytes of the matrices of a block: several times as much exists for a moment."""


def blocks(n_freqs: int, n_channels: int) -> Iterator[slice]:
    """Yield blocks of frequencies whose matrices take `BLOCK_BYTES`; one in most tests."""
    step = max(1, BLOCK_BYTES // (16 * max(1, n_channels) ** 2))
    for low in range(0, n_freqs, step):
        yield slice(low, min(low + step, n_freqs))
