"""What raw counts show of their limits, and which samples their devices flagged as clipped.

Stretches spread over the recording are searched (:mod:`estimator.checks.count_limits`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daq.protocols.block import BlockFlag
from estimator.checks.count_limits import CountLimits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from daq.bench.channel import Channel
    from daq.recording.interface import ReadableRecording, ReadableSensor

_STRETCHES = 16
_ROWS = 2048  # of each


def limits_of(record: ReadableSensor, unused: NDArray[np.float64] | None = None) -> CountLimits:
    """Return what the counts of a sensor show of their limits, by column of the sensor.

    Blocks flagged as clipped are skipped, and samples from each first to each second of `unused`:
    the estimate excludes them.
    """
    rows = _rows(record)
    if len(rows) == 0:
        return CountLimits()
    counts = np.concatenate([record.intact_counts(int(a), int(b))[0] for a, b in rows])
    which = np.concatenate([np.arange(first, last) for first, last in rows])
    blocks = record.blocks
    begins = np.concatenate([[0], np.cumsum(blocks["n_samples"])])[:-1]
    block = np.searchsorted(begins, which, side="right") - 1
    kept = blocks["flags"][block] & int(BlockFlag.CLIPPED) == 0
    sample = blocks["first_sample"][block] + which - begins[block]
    for first, end in () if unused is None else unused:
        kept &= (sample < first) | (sample >= end)
    used = np.repeat(kept[:, None], counts.shape[1], axis=1)
    for column, begin, end in record.absent:
        used[(which >= begin) & (which < end), column] = False
    main = [n for n, channel in enumerate(record.channels) if not channel.auxiliary]
    return CountLimits.of(counts, {n: used[:, n] for n in main if used[:, n].any()})


def limits_by_column(
    recordings: Iterable[tuple[ReadableRecording, Mapping[str, NDArray[np.float64]]]],
    channels: Sequence[tuple[str, Channel]],
) -> CountLimits:
    """Return what the counts of all channels of an estimate show of their limits.

    The recordings come with the samples of each sensor that are not used, as in `limits_of`. Of
    several recordings the largest share, and the first wraps and codes.
    """
    columns = {(sensor, channel.name): column for column, (sensor, channel) in enumerate(channels)}
    whole = CountLimits()
    for recording, unused in recordings:
        for record in recording.sensors:
            known = {
                n: columns[record.name, channel.name]
                for n, channel in enumerate(record.channels)
                if (record.name, channel.name) in columns
            }
            whole = whole.joined(limits_of(record, unused.get(record.name)).of_columns(known))
    return whole


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
