"""What raw counts show of their limits, and which samples their devices flagged as clipped.

Stretches spread over the recording are searched (:mod:`estimator.checks.count_limits`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.protocols.block import BlockFlag
from daq.recording.interface import ReadableRecording, ReadableSensor
from estimator.checks.count_limits import CountLimits

_STRETCHES = 16
_ROWS = 2048  # of each


def limits_of(record: ReadableSensor, unused: NDArray[np.float64] | None = None) -> CountLimits:
    """Return what the counts of a sensor show of their limits, by column of the sensor.

    Blocks flagged as clipped are skipped, and samples from each first to each second of `unused`:
    the estimate excludes them.
    """
    rows = _rows(record, unused)
    if len(rows) == 0:
        return CountLimits()
    counts = np.concatenate([record.intact_counts(int(a), int(b))[0] for a, b in rows])
    used, blocks = np.ones(counts.shape, dtype=np.bool_), record.blocks
    clipped = blocks["flags"] & int(BlockFlag.CLIPPED) != 0
    if clipped.any() or len(record.absent):
        which = np.concatenate([np.arange(first, last) for first, last in rows])
        begins = np.concatenate([[0], np.cumsum(blocks["n_samples"])])[:-1]
        used[clipped[np.searchsorted(begins, which, side="right") - 1]] = False
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


def _rows(record: ReadableSensor, unused: NDArray[np.float64] | None) -> NDArray[np.int64]:
    """First and last + 1 row of every stretch, shape (n, 2), spread over what is used."""
    used = _used(record, unused)
    lengths = used[:, 1] - used[:, 0]
    ends = np.cumsum(lengths)
    if not len(used) or ends[-1] <= _STRETCHES * _ROWS:
        return used
    at = np.linspace(0, ends[-1] - _ROWS, _STRETCHES).astype(np.int64)
    span = np.searchsorted(ends, at, side="right")
    first = used[span, 0] + at - (ends - lengths)[span]
    return np.column_stack([first, np.minimum(first + _ROWS, used[span, 1])])


def _used(record: ReadableSensor, unused: NDArray[np.float64] | None) -> NDArray[np.int64]:
    """First and last + 1 row of every span of samples that are used, shape (n, 2)."""
    if not record.n_samples:
        return np.empty((0, 2), dtype=np.int64)
    begins, n_samples = record.blocks["first_sample"], record.blocks["n_samples"]
    ends = np.cumsum(n_samples)
    found, end = [], 0
    for first, last in sorted(() if unused is None else unused.tolist()):
        asked = np.ceil(np.clip([first, last], begins[0], begins[-1] + n_samples[-1]))
        block = np.searchsorted(begins, asked, side="right") - 1
        rows = ends[block] - n_samples[block] + np.minimum(asked - begins[block], n_samples[block])
        found.append((end, int(rows[0])))
        end = max(end, int(rows[1]))
    found.append((end, record.n_samples))
    return np.array([(a, b) for a, b in found if a < b], dtype=np.int64).reshape(-1, 2)
