"""Finds channels at the end of their range that their devices have not flagged as clipped.

Where a signal is cut off, its largest or smallest count is far more frequent than the neighbouring
count. Stretches spread over the recording are searched for this, in raw counts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daq.protocols.block import BlockFlag

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from daq.bench.channel import Channel
    from daq.recording.interface import ReadableRecording, ReadableSensor

_STRETCHES = 16
_ROWS = 2048  # of each
_DISTINCT = 16  # counts: what has fewer may well have a favourite at its end
_MIN_SAMPLES = 8  # samples at an end
_TIMES = 5  # more often than the count beside it; a sine reaches 2.4


def clipped_shares(record: ReadableSensor) -> dict[str, float]:
    """Return the share of samples at the end of the range, by name of the channel.

    Only clipped channels of the huddle test. Blocks flagged as clipped are skipped: the estimate
    excludes them.
    """
    rows = _rows(record)
    if len(rows) == 0:
        return {}
    counts = np.concatenate([record.intact_counts(int(a), int(b))[0] for a, b in rows])
    which = np.concatenate([np.arange(first, last) for first, last in rows])
    blocks = record.blocks
    begins = np.concatenate([[0], np.cumsum(blocks["n_samples"])])[:-1]
    flags = blocks["flags"][np.searchsorted(begins, which, side="right") - 1]
    used = np.repeat((flags & int(BlockFlag.CLIPPED))[:, None] == 0, counts.shape[1], axis=1)
    for column, begin, end in record.absent:
        used[(which >= begin) & (which < end), column] = False
    shares = {
        channel.name: _share(counts[used[:, column], column])
        for column, channel in enumerate(record.channels)
        if not channel.auxiliary and used[:, column].any()
    }
    return {name: share for name, share in shares.items() if share}


def clipped_columns(
    recordings: Iterable[ReadableRecording], channels: Sequence[tuple[str, Channel]]
) -> dict[int, float]:
    """Return the share of samples at the end of the range, by column, of channels with any.

    Of several recordings the largest share.
    """
    columns = {(sensor, channel.name): column for column, (sensor, channel) in enumerate(channels)}
    shares: dict[int, float] = {}
    for recording in recordings:
        for record in recording.sensors:
            for channel, share in clipped_shares(record).items():
                column = columns.get((record.name, channel))
                if column is not None:
                    shares[column] = max(share, shares.get(column, 0.0))
    return shares


def in_clipped_blocks(
    records: Sequence[ReadableSensor], times: Callable[[], NDArray[np.float64]]
) -> NDArray[np.bool_] | None:
    """Return which samples lie in blocks flagged as clipped; None if no block is.

    `times` returns, for each sample and sensor, the seconds since the recording's creation.
    """
    found: NDArray[np.bool_] | None = None
    for number, record in enumerate(records):
        clipped = record.blocks.clipped
        if len(clipped) == 0:
            continue
        position = times()[:, number] * record.sampling_rate
        found = np.zeros(len(position), dtype=np.bool_) if found is None else found
        before = np.searchsorted(clipped[:, 0], position, side="right") - 1
        found |= (before >= 0) & (position < clipped[before, 1])
    return found


def _rows(record: ReadableSensor) -> NDArray[np.int64]:
    """First and last + 1 row of every stretch, shape (n, 2)."""
    n_rows = record.n_samples
    if n_rows <= _STRETCHES * _ROWS:
        return np.array([[0, n_rows]] if n_rows else np.empty((0, 2)), dtype=np.int64)
    first = np.linspace(0, n_rows - _ROWS, _STRETCHES).astype(np.int64)
    return np.column_stack([first, first + _ROWS])


def _share(counts: NDArray[np.generic]) -> float:
    if max((counts == end).sum() for end in (counts.min(), counts.max())) < _MIN_SAMPLES:
        return 0.0
    values, times = np.unique(counts, return_counts=True)
    if len(values) < _DISTINCT:
        return 0.0
    ends = ((times[0], times[1]), (times[-1], times[-2]))
    cut = [int(end) for end, beside in ends if end >= max(_MIN_SAMPLES, _TIMES * beside)]
    return sum(cut) / len(counts)
