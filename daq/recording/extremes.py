"""Least and largest sample of every channel in buckets of rows: what a waveform is drawn from.

A waveform of a day has more samples than a screen has columns. Buckets of `BUCKET` rows, and
`FACTOR` times as many in each further level, give the extremes of any column without reading its
samples: of the level that has two buckets a column at least. So an extreme may be drawn one column
beside its own, and none is missed. Closer up samples are read.

Extremes can be made again from the samples, so they are no part of a recording, its manifest and
its checksums. Those of a large closed recording are kept beside it, in `NAME.extremes`, with a
checksum of the checksums of all blocks: of other samples they are not used. Those of a growing
recording are extended in memory.
"""

from __future__ import annotations

import contextlib
import io
import json
import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.recording.interface import ReadableRecording, ReadableSensor, absences
from daq.whole_file import write_whole

IntArray = NDArray[np.int64]

BUCKET, FACTOR = 256, 16
"""Rows of a bucket of the lowest level, and buckets that one of the next level joins."""
PER_COLUMN = 2
"""Buckets of a column at least; with fewer, samples are read."""
SUFFIX = ".extremes"
KEPT_FROM = 1 << 24
"""Values (samples times channels) from which extremes are kept: what takes half a second."""
_ROWS_AT_ONCE = BUCKET << 10
_ZIP = b"PK\x03\x04"


class Extremes:
    """Extremes of one sensor, extended when its recording has grown.

    Parameters
    ----------
    record : ReadableSensor
    """

    def __init__(self, record: ReadableSensor) -> None:
        self._record = record
        dtype = record.counts(0, 0).dtype
        self._none: tuple[Any, Any] = (np.inf, -np.inf)
        if dtype.kind in "iu":
            self._none = np.iinfo(dtype).max, np.iinfo(dtype).min
        none = np.empty((0, len(record.channels)), dtype)
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
        absent = list(absences(self._record, begin, end))
        if not damaged and not absent:
            return counts, counts
        both = counts.copy(), counts.copy()
        for each, none in zip(both, self._none, strict=True):
            for first, last in damaged:
                each[first:last] = none
            for column, rows in absent:
                each[rows, column] = none
        return both

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
    def stored(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Extremes of the lowest level, each of shape (n_buckets, n_channels)."""
        return self._found

    def restore(self, least: NDArray[Any], most: NDArray[Any]) -> None:
        """Take what `stored` was of all rows.

        Raises
        ------
        ValueError
            If it is not of this sensor.
        """
        shape = -(-self._record.n_samples // BUCKET), len(self._record.channels)
        dtype = self._found[0].dtype
        if any(each.shape != shape or each.dtype != dtype for each in (least, most)):
            raise ValueError("other extremes")
        self._set(least, most, n_rows=self._record.n_samples)


def _joined(
    values: tuple[NDArray[Any], NDArray[Any]], size: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    at = np.arange(0, len(values[0]), size)
    return np.fmin.reduceat(values[0], at, axis=0), np.fmax.reduceat(values[1], at, axis=0)


def extremes_of(
    recording: ReadableRecording, progress: Callable[[int], object] = lambda _: None
) -> tuple[Extremes, ...]:
    """Return the extremes of all sensors: those that are kept, or made now.

    `progress` receives the number of rows after each piece. Made of a large closed recording, they
    are kept; not where its folder cannot be written.
    """
    found = tuple(map(Extremes, recording.sensors))
    path, about = recording.path.with_suffix(SUFFIX), ""
    size = sum(each.n_samples * len(each.channels) for each in recording.sensors)
    is_kept = recording.closed and size >= KEPT_FROM
    if is_kept:
        about = _about(recording)
        if _is_restored(found, path, about):
            return found
    for each in found:
        each.extend(progress)
    if is_kept:
        content = io.BytesIO()
        stored = [array for each in found for array in each.stored]
        np.savez(content, np.array(about), *stored)
        with contextlib.suppress(OSError):
            mode = stat.S_IMODE(recording.path.stat().st_mode)
            write_whole(path, content.getvalue(), mode=mode)
    return found


def _is_restored(found: tuple[Extremes, ...], path: Path, about: str) -> bool:
    try:
        content = path.read_bytes()
        if not content.startswith(_ZIP):
            return False
        with np.load(io.BytesIO(content), allow_pickle=False) as kept:
            arrays = [kept[f"arr_{n}"] for n in range(1 + 2 * len(found))]
        if str(arrays[0]) != about:
            return False
        for number, each in enumerate(found):
            each.restore(*arrays[1 + 2 * number : 3 + 2 * number])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return False
    return True


def _about(recording: ReadableRecording) -> str:
    """Return what the samples are: the checksums of all blocks, and which samples are absent."""
    sensors = []
    for record in recording.sensors:
        checksum = zlib.crc32(record.absent.tobytes())
        checksum = zlib.crc32(record.blocks[:]["crc32"].tobytes(), checksum)
        sensors.append([record.name, record.n_samples, checksum])
    return json.dumps([BUCKET, recording.run_id, sensors])
