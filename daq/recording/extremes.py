"""Least and largest sample of every channel in buckets of rows: what a waveform is drawn from.

A waveform of a day has more samples than a screen has columns. Buckets of `BUCKET` rows, and
`FACTOR` times as many in each further level, give the extremes of any column without reading its
samples: of the level that has two buckets a column at least. So an extreme may be drawn one column
beside its own, and none is missed. Closer up samples are read.

Extremes can be made again from the samples, so they are no part of a recording, its manifest and
its checksums. Those of a large recording are kept beside it, in `NAME.extremes`: its writer appends
them as it grows, and of a file without them they are made once. The file has the run in its first
line, then pieces: sensor, buckets, how many blocks the recording had and a checksum of theirs, a
checksum of the piece, extremes. Pieces of other samples, and what follows a damaged one, are not
used.
"""

from __future__ import annotations

import contextlib
import json
import stat
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.recording.file_format import SensorLayout
from daq.recording.interface import ReadableRecording, ReadableSensor, absences
from daq.whole_file import create_private, write_whole

IntArray = NDArray[np.int64]
Pair = tuple[NDArray[Any], NDArray[Any]]

BUCKET, FACTOR = 256, 16
"""Rows of a bucket of the lowest level, and buckets that one of the next level joins."""
PER_COLUMN = 2
"""Buckets of a column at least; with fewer, samples are read."""
SUFFIX = ".extremes"
KEPT_FROM = 1 << 24
"""Values (samples times channels) from which extremes are kept: what takes half a second."""
_ROWS_AT_ONCE = BUCKET << 10
WAITING = 1024
"""Buckets of all sensors that a writer appends together."""
_PIECE = struct.Struct("<5I")


class Extremes:
    """Extremes of one sensor, extended when its recording has grown.

    Parameters
    ----------
    record : ReadableSensor
    """

    def __init__(self, record: ReadableSensor) -> None:
        self._record = record
        self.dtype = record.counts(0, 0).dtype
        self._none = _none(self.dtype)
        none = np.empty((0, len(record.channels)), self.dtype)
        self._found: tuple[NDArray[Any], NDArray[Any]] = none, none
        self._levels: list[tuple[NDArray[Any], NDArray[Any]]] = []
        self.n_rows = 0
        """Rows that are in buckets."""

    def extend(self, progress: Callable[[int], object] = lambda _: None) -> None:
        """Take further rows; `progress` receives the number of rows after each piece."""
        n_whole, n_rows = self.n_rows // BUCKET, self._record.n_samples
        if n_rows == self.n_rows:
            return
        pieces = [(self._found[0][:n_whole], self._found[1][:n_whole])]
        for begin in range(n_whole * BUCKET, n_rows, _ROWS_AT_ONCE):
            end = min(begin + _ROWS_AT_ONCE, n_rows)
            pieces.append(_joined(self._samples(begin, end), BUCKET))
            progress(end - begin)
        self._set(*(np.concatenate(each) for each in zip(*pieces, strict=True)), n_rows=n_rows)

    def _set(self, least: NDArray[Any], most: NDArray[Any], *, n_rows: int) -> None:
        self._found, self._levels, self.n_rows = (least, most), [], n_rows
        level = self._found
        while True:
            self._levels.append(self._ended(*level))
            if len(level[0]) <= FACTOR:
                return
            level = _joined(level, FACTOR)

    def _ended(self, least: NDArray[Any], most: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return extremes with those of no sample after them: where a column may end."""
        return (
            np.append(least, np.full_like(least, self._none[0], shape=(1, least.shape[1])), axis=0),
            np.append(most, np.full_like(most, self._none[1], shape=(1, most.shape[1])), axis=0),
        )

    def _samples(self, begin: int, end: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return rows twice, such that damaged and absent samples are no extremes of either."""
        counts, damaged = self._record.intact_counts(begin, end)
        return _twice(counts, damaged, absences(self._record.absent, begin, end), self._none)

    def between(self, edges: IntArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the extremes of columns in counts.

        Parameters
        ----------
        edges : int64, shape (n + 1,)
            Rows at which columns begin and end, ascending, up to `n_rows`.

        Returns
        -------
        least, most : float64, shape (n, n_channels)
            NaN where a column has no sample.
        """
        first, last = int(edges[0]), int(edges[-1])
        n_columns, size, level = len(edges) - 1, 1, self._ended(*self._found)
        if last - first < PER_COLUMN * BUCKET * n_columns:
            level, begin = self._ended(*self._samples(first, last)), edges[:-1] - first
            end = edges[1:] - first
        else:
            size, number = BUCKET, 0
            while (
                number + 1 < len(self._levels)
                and last - first >= PER_COLUMN * size * FACTOR * n_columns
            ):
                size, number = size * FACTOR, number + 1
            level, begin, end = self._levels[number], edges[:-1] // size, -(-edges[1:] // size)
        places = np.column_stack([begin, end]).ravel()
        found = []
        for extreme, values in zip((np.fmin, np.fmax), level, strict=True):
            each = extreme.reduceat(values, places, axis=0)[::2].astype(np.float64)
            each[edges[:-1] == edges[1:]] = np.nan
            found.append(each)
        nothing = found[0] > found[1]
        return np.where(nothing, np.nan, found[0]), np.where(nothing, np.nan, found[1])

    @property
    def whole(self) -> Pair:
        """Extremes of the buckets that are full, each of shape (n_buckets, n_channels)."""
        n_whole = self.n_rows // BUCKET
        return self._found[0][:n_whole], self._found[1][:n_whole]

    def restore(self, least: NDArray[Any], most: NDArray[Any]) -> None:
        """Take what `whole` was of the first rows."""
        n_whole = min(len(least), self._record.n_samples // BUCKET)
        self._set(least[:n_whole], most[:n_whole], n_rows=n_whole * BUCKET)


def _none(dtype: np.dtype[Any]) -> tuple[Any, Any]:
    """Return the extremes of no sample."""
    if dtype.kind in "iu":
        return np.iinfo(dtype).max, np.iinfo(dtype).min
    return np.inf, -np.inf


def _twice(
    counts: NDArray[Any],
    damaged: Iterable[tuple[int, int]],
    absent: Iterable[tuple[int, slice]],
    none: tuple[Any, Any],
) -> Pair:
    """Return rows twice, such that damaged and absent samples are no extremes of either."""
    damaged, absent = list(damaged), list(absent)
    if not damaged and not absent:
        return counts, counts
    both = counts.copy(), counts.copy()
    for each, of_none in zip(both, none, strict=True):
        for first, last in damaged:
            each[first:last] = of_none
        for column, rows in absent:
            each[rows, column] = of_none
    return both


def _joined(values: Pair, size: int) -> Pair:
    at = np.arange(0, len(values[0]), size)
    return np.fmin.reduceat(values[0], at, axis=0), np.fmax.reduceat(values[1], at, axis=0)


class NewExtremes:
    """Extremes of one sensor whose rows are written one after the other.

    Parameters
    ----------
    layout : SensorLayout
    """

    def __init__(self, layout: SensorLayout) -> None:
        self.dtype, self.n_channels = np.dtype(layout.dtype), len(layout.channels)
        self.absent = np.empty((0, 3), np.int64) if layout.absent is None else layout.absent
        self.n_rows = 0
        """Rows that are in buckets."""
        self._rest = np.empty((0, self.n_channels), self.dtype)
        self._new: list[Pair] = []

    def add(self, rows: NDArray[Any]) -> None:
        """Take the next rows."""
        rows = np.concatenate([self._rest, rows])
        first, n_rows = self.n_rows, len(rows) // BUCKET * BUCKET
        self._rest = rows[n_rows:]
        if n_rows:
            absent = absences(self.absent, first, first + n_rows)
            found = _twice(rows[:n_rows], (), absent, _none(self.dtype))
            self._new.append(_joined(found, BUCKET))
            self.n_rows += n_rows

    def taken(self) -> Pair:
        """Return the extremes since the last call."""
        none = np.empty((0, self.n_channels), self.dtype)
        least, most = zip((none, none), *self._new, strict=True)
        self._new = []
        return np.concatenate(least), np.concatenate(most)


class GrowingFile:
    """Extremes of a recording that is written, beside it from the size on that needs them.

    Whatever is wrong with this file, the recording goes on without it.

    Parameters
    ----------
    path : Path
        Of the recording.
    run_id : str
    sensors : mapping of str to NewExtremes
    """

    def __init__(self, path: Path, run_id: str, sensors: Mapping[str, NewExtremes]) -> None:
        self.path = path.with_suffix(SUFFIX)
        self._sensors = sensors
        about = ((name, each.dtype, each.n_channels) for name, each in sensors.items())
        self._content = _head(run_id, about)
        self._n_appended = 0
        self._is_lost = False

    def append(self, recording: Path, blocks: Mapping[str, tuple[int, int]], *, last: bool) -> None:
        """Append what is new, if that is enough, or the last.

        Parameters
        ----------
        recording : Path
            Where the recording is now: who may read it may read this.
        blocks : mapping of str to (int, int)
            Number of the blocks of each sensor, and their `checksum`.
        last : bool
        """
        if self._is_lost:
            for each in self._sensors.values():
                each.taken()
            return
        size = sum(each.n_rows * each.n_channels for each in self._sensors.values())
        n_buckets = sum(each.n_rows // BUCKET for each in self._sensors.values())
        is_enough = last or n_buckets - self._n_appended >= WAITING
        if size < KEPT_FROM or not is_enough:
            return
        for number, (name, each) in enumerate(self._sensors.items()):
            self._content += _piece(number, each.taken(), *blocks[name])
        try:
            if not self._n_appended:
                self.path.unlink(missing_ok=True)
                create_private(self.path)
                self.path.chmod(stat.S_IMODE(recording.stat().st_mode))
            with self.path.open("ab") as file:
                file.write(self._content)
        except OSError:
            self._is_lost = True
        self._content, self._n_appended = b"", n_buckets


def checksum(blocks: NDArray[np.void], before: int = 0) -> int:
    """Return a checksum of the checksums of blocks, which follow those of another one."""
    return zlib.crc32(np.ascontiguousarray(blocks["crc32"], "<u4").tobytes(), before)


def _head(run_id: str, sensors: Iterable[tuple[str, np.dtype[Any], int]]) -> bytes:
    about = [[name, dtype.newbyteorder("<").str, n_channels] for name, dtype, n_channels in sensors]
    return json.dumps([BUCKET, run_id, about]).encode() + b"\n"


def _piece(number: int, found: Pair, n_blocks: int, of_blocks: int) -> bytes:
    content = b"".join(
        np.ascontiguousarray(each, each.dtype.newbyteorder("<")).tobytes() for each in found
    )
    about = number, len(found[0]), n_blocks, of_blocks, zlib.crc32(content)
    return _PIECE.pack(*about) + content


def extremes_of(
    recording: ReadableRecording, progress: Callable[[int], object] = lambda _: None
) -> tuple[Extremes, ...]:
    """Return the extremes of all sensors: those that are kept, and the rest made now.

    `progress` receives the number of rows after each piece. Those of a large closed recording are
    kept, if they were not; not where its folder cannot be written.
    """
    found = tuple(map(Extremes, recording.sensors))
    path = recording.path.with_suffix(SUFFIX)
    is_large = sum(r.n_samples * len(r.channels) for r in recording.sensors) >= KEPT_FROM
    about = (
        (record.name, each.dtype, len(record.channels))
        for record, each in zip(recording.sensors, found, strict=True)
    )
    head = _head(recording.run_id, about)
    if is_large:
        _restore(found, recording.sensors, path, head)
    is_kept = all(
        each.n_rows == record.n_samples // BUCKET * BUCKET
        for each, record in zip(found, recording.sensors, strict=True)
    )
    for each in found:
        each.extend(progress)
    if is_large and recording.closed and not is_kept:
        for number, (each, record) in enumerate(zip(found, recording.sensors, strict=True)):
            blocks = record.blocks[:]
            head += _piece(number, each.whole, len(blocks), checksum(blocks))
        with contextlib.suppress(OSError):
            write_whole(path, head, mode=stat.S_IMODE(recording.path.stat().st_mode))
    return found


def _restore(
    found: Sequence[Extremes], sensors: Sequence[ReadableSensor], path: Path, head: bytes
) -> None:
    """Take what is kept of these samples."""
    try:
        content = path.read_bytes()
    except OSError:
        return
    kept: list[list[Pair]] = [[] for _ in found]
    known, blocks = [(0, 0)] * len(found), [record.blocks[:] for record in sensors]
    at = len(head) if content.startswith(head) else len(content)
    while at + _PIECE.size <= len(content):
        number, n_buckets, n_blocks, of_blocks, of_piece = _PIECE.unpack_from(content, at)
        if number >= len(found) or n_blocks > len(blocks[number]):
            break
        n_channels, dtype = len(sensors[number].channels), found[number].dtype
        begin = at + _PIECE.size
        at = begin + 2 * n_buckets * n_channels * dtype.itemsize
        if at > len(content) or zlib.crc32(content[begin:at]) != of_piece:
            break
        values = np.frombuffer(content[begin:at], dtype.newbyteorder("<")).astype(dtype)
        least, most = values.reshape(2, n_buckets, n_channels)
        kept[number].append((least, most))
        known[number] = n_blocks, of_blocks
    for each, pieces, (n_blocks, of_blocks), own in zip(found, kept, known, blocks, strict=True):
        if pieces and checksum(own[:n_blocks]) == of_blocks:
            each.restore(*(np.concatenate(some) for some in zip(*pieces, strict=True)))
