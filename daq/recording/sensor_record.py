"""One sensor of an open recording: its committed samples, blocks and gaps.

A long recording has millions of blocks. Rows stay in the file and are read on demand. Only the
newest rows and the clipped stretches are kept in memory, since they are needed repeatedly.

Many small chunks of a dataset are read together, also from several threads. HDF5 takes longer to
fetch a small chunk than to inflate it. So where a file is closed, its chunks are located once, and
read from the file as they are, many at a time. Checksums are of blocks, so the reader of a block
finds any damage.
"""

from __future__ import annotations

import bisect
import contextlib
import itertools
import os
import threading
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.errors import NotARecordingError, RecordingError
from daq.protocols.block import BlockFlag
from daq.recording import file_format
from daq.recording.chunks.checksums import intact_blocks
from daq.recording.storage.opening import refresh
from daq.recording.storage.packing import PIPELINE, RAW, InflationError, check_chunks, unpacked
from daq.recording.storage.refusals import check_length, dataset, number, text

IntArray = NDArray[np.int64]
Buffer = bytes | memoryview


_ROWS_PER_READ = 1 << 14  # 900 kB
_ROWS_PER_MARK = 1 << 8
_NEWEST_ROWS = 1 << 10  # 57 kB; who follows a recording asks for them again and again


class BlockTable:
    """Committed blocks, dtype :data:`daq.recording.file_format.BLOCK_DTYPE`, indexed like an array.

    A slice reads only its rows; the name of a field reads only that field.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset
        self._n_rows = 0
        self._clipped: list[IntArray] = []
        self._marks: list[int] = []
        self._newest = np.empty(0, dataset.dtype)
        self._covering: tuple[int, int, NDArray[np.void]] = (0, 0, self._newest)
        self.n_samples = 0
        """Number of rows of samples in these blocks."""

    def __len__(self) -> int:
        return self._n_rows

    def __getitem__(self, which: Any) -> NDArray[Any]:  # noqa: ANN401 - any index of an array
        if isinstance(which, str):
            return self._read(0, self._n_rows, which)
        if isinstance(which, slice) and which.step is None:
            first, last, _ = which.indices(self._n_rows)
            return self._read(first, max(first, last))
        return np.asarray(self._read(0, self._n_rows)[which])

    def __iter__(self) -> Iterator[NDArray[np.void]]:
        for first in range(0, self._n_rows, _ROWS_PER_READ):
            yield from self[first : first + _ROWS_PER_READ]

    @property
    def clipped(self) -> IntArray:
        """First sample, and the one after the last, of each clipped stretch; shape (n, 2)."""
        if len(self._clipped) > 1:
            self._clipped = [np.concatenate(self._clipped)]
        return self._clipped[0] if self._clipped else np.empty((0, 2), np.int64)

    def extend(self, n_rows: int, n_samples: int, *, closed: bool = False) -> None:
        """Add blocks up to row ``n_rows``, without those that end beyond ``n_samples``.

        A crash may leave one of the two numbers older than the other. Blocks and samples are cut to
        end together. A closed recording was completed, so it has exactly these numbers.

        Raises
        ------
        RecordingError
            If the blocks are not contiguous, or those of a closed recording have another number of
            samples.
        """
        if n_rows > self._n_rows:
            refresh(self._dataset)
        for first in range(self._n_rows, n_rows, _ROWS_PER_READ):
            blocks = self._read(first, min(first + _ROWS_PER_READ, n_rows))
            ends = blocks["first_row"] + blocks["n_samples"]
            if closed:
                self._check_contiguous(blocks)  # `ends` of damaged blocks are not in order
            n_whole = int(np.searchsorted(ends, n_samples, side="right"))
            self._check_contiguous(blocks[:n_whole])
            if n_whole:
                self._mark(blocks[:n_whole])
                self._n_rows, self.n_samples = first + n_whole, int(ends[n_whole - 1])
                self._note_clipped(blocks[:n_whole])
                self._keep_newest(blocks[:n_whole])
            if n_whole < len(blocks):
                break
        if closed and self.n_samples != n_samples:
            raise RecordingError(
                f"{self._where}: damaged: its blocks have {self.n_samples} samples; expected"
                f" {n_samples}"
            )

    def covering(self, first_row: int, last_row: int) -> NDArray[np.void]:
        """Return the blocks with rows ``first_row`` to ``last_row`` (not included) of samples."""
        marks = self._marks
        begin = (bisect.bisect_right(marks, first_row) - 1) * _ROWS_PER_MARK
        end = bisect.bisect_left(marks, last_row) * _ROWS_PER_MARK
        first, last, _ = slice(max(0, begin), end).indices(self._n_rows)
        known_first, known_last, blocks = self._covering
        if not known_first <= first <= last <= known_last:
            known_first, blocks = first, self._read(first, max(first, last))
            self._covering = first, first + len(blocks), blocks
        blocks = blocks[first - known_first : last - known_first]
        begins = blocks["first_row"]
        ends = begins + blocks["n_samples"]
        some = slice(np.searchsorted(ends, first_row, "right"), np.searchsorted(begins, last_row))
        return np.asarray(blocks[some])

    def _check_contiguous(self, blocks: NDArray[np.void]) -> None:
        """Check that each block begins at the row where the previous one ends.

        If not, ``n_samples`` becomes the number of samples whose blocks are certain.

        Raises
        ------
        RecordingError
            With the first wrong row of the table.
        """
        ends = blocks["first_row"] + blocks["n_samples"]
        expected = np.append(self.n_samples, ends[:-1]) if len(blocks) else ends
        wrong = np.flatnonzero((blocks["first_row"] != expected) | (blocks["n_samples"] <= 0))
        if len(wrong):
            at = int(wrong[0])
            # Either this row is wrong, or the number of samples of the row before.
            self.n_samples = int(expected[max(at - 1, 0)])
            raise RecordingError(
                f"{self._where}: damaged: row {self._n_rows + at} has its samples at row"
                f" {blocks['first_row'][at]}; expected {expected[at]}"
            )

    def _mark(self, blocks: NDArray[np.void]) -> None:
        """Store the first row of samples of every ``_ROWS_PER_READ``-th block."""
        first = -self._n_rows % _ROWS_PER_MARK
        self._marks += blocks["first_row"][first::_ROWS_PER_MARK].tolist()

    def _keep_newest(self, blocks: NDArray[np.void]) -> None:
        self._newest = np.concatenate([self._newest, blocks])[-_NEWEST_ROWS:].copy()

    def _note_clipped(self, blocks: NDArray[np.void]) -> None:
        blocks = blocks[(blocks["flags"] & int(BlockFlag.CLIPPED)) != 0]
        if len(blocks):
            first, end = blocks["first_sample"], blocks["first_sample"] + blocks["n_samples"]
            apart = first[1:] != end[:-1]
            begins, ends = first[np.append(True, apart)], end[np.append(apart, True)]
            self._clipped.append(np.column_stack([begins, ends]))

    def _read(self, first: int, last: int, field: str | None = None) -> NDArray[Any]:
        begin = self._n_rows - len(self._newest)
        if begin <= first < last <= self._n_rows:
            newest = self._newest[first - begin : last - begin]
            return newest if field is None else np.asarray(newest[field])
        dataset = self._dataset if field is None else self._dataset.fields(field)
        try:
            rows = np.asarray(dataset[first:last])
        except (OSError, RuntimeError) as error:
            raise RecordingError(
                f"{self._where}: damaged between rows {first} and {last}: {error}"
            ) from error
        if len(rows) < last - first:
            raise RecordingError(
                f"{self._where} has {first + len(rows)} rows where {last} were committed"
            )
        return rows

    @property
    def _where(self) -> str:
        return f"{self._dataset.file.filename}: {self._dataset.name}"


_KEPT_BYTES = 1 << 20  # of the last read: short recordings are read several times
_SPARSE = 4  # bytes of the file over those of chunks, from which each chunk is read alone
_LOCATED_FROM = 1 / 16  # share of the chunks that is fetched before all are located


class LocatedChunks:
    """Reads chunks as they are stored from the file itself.

    Parameters
    ----------
    dataset : h5py.Dataset
        Of a closed file, in chunks along its first axis only.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._file, self._length = dataset.file.id, dataset.chunks[0]
        row_bytes = dataset.dtype.itemsize * int(np.prod(dataset.chunks[1:]))
        self._n_bytes = self._length * row_bytes
        self._at, self._size, self._mask = np.full((3, -(-len(dataset) // self._length)), -1)
        """Byte of the file at which each chunk begins, its bytes and its mask; -1 if unknown."""
        file = dataset.file
        if file.driver == "sec2" and not file.userblock_size and hasattr(os, "preadv"):
            dataset.id.chunk_iter(self._note)
        is_raw = (self._mask == RAW) & (self._size == self._n_bytes)
        self._raw_at = np.where(is_raw, self._at, -1)
        self._apart = np.flatnonzero(np.diff(self._raw_at) != self._n_bytes) + 1
        """Chunks that do not follow the one before in the file."""

    def _note(self, chunk: Any) -> None:  # noqa: ANN401 - h5py names no type
        at = chunk.chunk_offset[0] // self._length
        self._at[at], self._size[at] = chunk.byte_offset, chunk.size
        self._mask[at] = chunk.filter_mask

    def stored(self, first: int, n_chunks: int) -> list[tuple[int, Buffer]] | None:
        """Return mask and bytes of chunks, from chunk `first` on; None if not all are known.

        Raises
        ------
        OSError
            If the file cannot be read.
        """
        some = slice(first, first + n_chunks)
        at, size, mask = self._at[some], self._size[some], self._mask[some]
        if len(at) < n_chunks or (at < 0).any() or (size > 2 * self._n_bytes).any():
            return None
        handle, begin, end = self._file.get_vfd_handle(), int(at.min()), int((at + size).max())
        found: list[Buffer]
        if end - begin <= _SPARSE * int(size.sum()):
            whole = memoryview(os.pread(handle, end - begin, begin))
            edges = zip((at - begin).tolist(), (at + size - begin).tolist(), strict=True)
            found = [whole[low:high] for low, high in edges]
        else:
            places = zip(at.tolist(), size.tolist(), strict=True)
            found = [os.pread(handle, n, place) for place, n in places]
        if sum(map(len, found)) < int(size.sum()):
            return None
        return list(zip(mask.tolist(), found, strict=True))

    def read(self, first: int, rows: NDArray[Any]) -> bool:
        """Put raw chunks, from chunk `first` on, into rows; return False if not all are raw.

        Raises
        ------
        OSError
            If the file cannot be read.
        """
        plain, handle = rows.view(np.uint8).reshape(-1).data, self._file.get_vfd_handle()
        last = first + len(plain) // self._n_bytes
        at = self._raw_at[first:last]
        if len(at) * self._n_bytes < len(plain) or (at < 0).any():
            return False
        low, high = np.searchsorted(self._apart, (first + 1, last)).tolist()
        cuts = (self._apart[low:high] - first).tolist()
        for begin, end in itertools.pairwise([0, *cuts, len(at)]):
            part = plain[begin * self._n_bytes : end * self._n_bytes]
            if os.preadv(handle, [part], int(at[begin])) < len(part):
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
        self._located: LocatedChunks | None = None
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

    def locate(self) -> None:
        """Look up where the chunks of a closed file are; once."""
        if self._located is None and self.is_closed and self._direct:
            self._located = LocatedChunks(self._dataset)

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
        if many:
            self.locate()
        first, n_chunks, stored = start // self._length, len(rows) // self._length, None
        if self._located is not None:
            if self._located.read(first, rows):
                return True
            stored = self._located.stored(first, n_chunks)
        if stored is None:
            fetch, end = self._dataset.id.read_direct_chunk, start + len(rows)
            stored = [fetch((row, *self._corner)) for row in range(start, end, self._length)]
        return unpacked(stored, rows)


class CommittedRows:
    """The committed rows of a table; each row is read once."""

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset
        self._parts: list[NDArray[np.void]] = []
        self.n_rows = 0

    def extend(self, n_rows: int) -> None:
        """Read further rows, up to ``n_rows`` in all."""
        if n_rows > self.n_rows:
            refresh(self._dataset)
            check_length(self._dataset)
            part = self._dataset[self.n_rows : n_rows]
            if len(part) < n_rows - self.n_rows:
                raise OSError(
                    f"{self._dataset.name} has {self.n_rows + len(part)} rows where {n_rows} were"
                    " committed"
                )
            self._parts.append(part)
            self.n_rows = n_rows

    def rows(self) -> NDArray[np.void]:
        """Return all rows."""
        if not self._parts:
            return np.zeros(0, self._dataset.dtype)
        if len(self._parts) > 1:
            self._parts = [np.concatenate(self._parts)]
        return self._parts[0]


class SensorRecord:
    """The committed data of one sensor, extended when its recording is refreshed."""

    def __init__(self, group: h5py.Group) -> None:
        attributes = group.attrs
        self._group = group
        self.name: str = group.name.rpartition("/")[2]
        self.model = text(attributes, "model")
        self.serial_number = text(attributes, "serial_number")
        self.driver = text(attributes, "driver")
        self.port = text(attributes, "port")
        self.clock = text(attributes, "clock")
        """Name of the sampling clock; sensors with one clock share the name."""
        self.sampling_rate = float(number(attributes, "sampling_rate"))
        """In Hz, as reported by the device; otherwise nominal."""
        self.firmware = text(attributes, "firmware") if "firmware" in attributes else ""
        self.temperature = (
            float(number(attributes, "temperature")) if "temperature" in attributes else None
        )
        """In °C, as the device reported at the start; None if it reported none."""
        self._samples = dataset(group, "samples", in_parts=True)
        self._instants = dataset(group, "instants", np.dtype("<i8"), in_parts=True)
        self.channels: tuple[Channel, ...] = file_format.channels_of(self._samples.attrs)
        self.absent: NDArray[np.int64] = np.array(
            self._samples.attrs.get("absent", np.empty((0, 3))), np.int64
        )
        """Rows in which a channel has no sample: its column, first row, and one after the last."""
        self.dtype: np.dtype[Any] = self._samples.dtype
        self._check_shapes()
        self._sample_rows = ChunkedRows(self._samples)
        self._instant_rows = ChunkedRows(self._instants)
        self.blocks = BlockTable(dataset(group, "blocks", file_format.BLOCK_DTYPE))
        self.gap_rows = CommittedRows(dataset(group, "gaps", file_format.GAP_DTYPE))
        self._damaged: set[int] = set()
        self.n_samples = 0
        """Number of committed rows of samples."""

    def _check_shapes(self) -> None:
        n_channels = len(self.channels)
        if self._samples.ndim != 2 or self._samples.shape[1] != n_channels:
            raise ValueError(
                f"sensor {self.name!r}: samples of shape {self._samples.shape}; expected"
                f" {n_channels} columns"
            )
        if self.absent.ndim != 2 or self.absent.shape[1] != 3:
            raise ValueError(f"sensor {self.name!r}: absent of shape {self.absent.shape}")
        if not np.isin(self.absent[:, 0], np.arange(n_channels)).all():
            raise ValueError(f"sensor {self.name!r}: absent of other columns than its own")
        if self._instants.ndim != 1 or not self._samples.chunks or not self._instants.chunks:
            raise ValueError(f"sensor {self.name!r}: samples or instants are not in chunks")
        if self.sampling_rate <= 0:
            raise ValueError(f"sensor {self.name!r}: sampling_rate {self.sampling_rate}")

    @property
    def polled(self) -> bool:
        """Whether the time of every sample is recorded; False before the first sample."""
        return bool(self.n_samples > 0 and self._instants.shape[0] >= self.n_samples)

    @property
    def n_written(self) -> int:
        """Number of rows of samples in the file, including uncommitted ones."""
        return int(self._samples.shape[0])

    @property
    def gaps(self) -> NDArray[np.void]:
        """Committed gaps, dtype :data:`daq.recording.file_format.GAP_DTYPE`."""
        return self.gap_rows.rows()

    def counts(self, first_row: int = 0, last_row: int | None = None) -> NDArray[Any]:
        """Return raw counts.

        Parameters
        ----------
        first_row, last_row : int
            Rows, without ``last_row``; default: up to ``n_samples``.

        Returns
        -------
        ndarray, shape (last_row - first_row, n_channels)

        Raises
        ------
        IndexError
            If these rows are not committed.
        RecordingError
            If the file is damaged at these rows.
        """
        return self._read(self._sample_rows, first_row, last_row)

    def locate(self) -> None:
        """Look up where all samples are in the file: all are about to be read."""
        self._sample_rows.locate()

    def intact_counts(
        self, first_row: int, last_row: int
    ) -> tuple[NDArray[Any], list[tuple[int, int]]]:
        """Return raw counts, checked against the checksums of their blocks.

        Parameters
        ----------
        first_row, last_row : int
            Rows, without ``last_row``.

        Returns
        -------
        counts : ndarray, shape (last_row - first_row, n_channels)
            Zero in damaged blocks.
        damaged : list of (int, int)
            Rows of ``counts`` (first, last + 1) that are in damaged blocks.
        """
        blocks = self.blocks.covering(first_row, last_row)
        if not len(blocks):
            return self.counts(first_row, last_row), []
        low = int(blocks["first_row"][0])
        ends = blocks["first_row"] + blocks["n_samples"]
        try:
            counts = self.counts(low, int(ends[-1]))
        except RecordingError:  # a chunk is damaged: read the blocks of other chunks one by one
            counts = self._counts_block_by_block(blocks)
        bad = np.flatnonzero(~intact_blocks(blocks, counts))
        if len(bad):
            counts = counts.copy()
        damaged = []
        for at in bad.tolist():
            begin, end = int(blocks["first_row"][at]), int(ends[at])
            counts[begin - low : end - low] = 0
            damaged.append((max(0, begin - first_row), min(last_row, end) - first_row))
            self._damaged.add(begin)
        return counts[first_row - low : last_row - low], damaged

    @property
    def n_damaged(self) -> int:
        """Number of damaged blocks that `intact_counts` has found."""
        return len(self._damaged)

    @property
    def damaged_rows(self) -> list[int]:
        """First row of each of these blocks."""
        return sorted(self._damaged)

    def _counts_block_by_block(self, blocks: NDArray[np.void]) -> NDArray[Any]:
        low = int(blocks["first_row"][0])
        n_rows = int(blocks["n_samples"].sum())
        counts = np.zeros((n_rows, len(self.channels)), self.dtype)
        for block in blocks:
            first, n = int(block["first_row"]), int(block["n_samples"])
            with contextlib.suppress(RecordingError):
                counts[first - low : first - low + n] = self.counts(first, first + n)
        return counts

    def instants_ns(self, first_row: int = 0, last_row: int | None = None) -> NDArray[np.int64]:
        """Return the host monotonic time of each sample of a polled sensor, in ns.

        Raises
        ------
        IndexError
            If these rows are not committed.
        RecordingError
            If the sensor is not polled, or the file damaged.
        """
        if not self.polled:
            raise RecordingError(f"sensor {self.name!r} has no sample times")
        return self._read(self._instant_rows, first_row, last_row)

    def _read(self, rows: ChunkedRows, first_row: int, last_row: int | None) -> NDArray[Any]:
        last_row = self.n_samples if last_row is None else last_row
        if not 0 <= first_row <= last_row <= self.n_samples:
            raise IndexError(
                f"rows {first_row} to {last_row} of sensor {self.name!r}: {self.n_samples} are"
                " committed"
            )
        try:
            return rows.read(first_row, last_row, self.n_samples)
        except (OSError, RuntimeError) as error:
            raise RecordingError(
                f"{self._samples.file.filename}: sensor {self.name!r} is damaged between rows"
                f" {first_row} and {last_row}: {error}"
            ) from error

    def extend(self, counts: NDArray[np.int64], *, closed: bool = False) -> bool:
        """Add the rows counted in a row of ``/committed``; return whether there are new ones.

        Raises
        ------
        NotARecordingError
            If a closed recording has other numbers of rows or blocks than were committed.
        RecordingError, OSError
            If rows are missing or cannot be read.
        """
        before = self.n_samples, self.gap_rows.n_rows
        n_rows = int(counts[file_format.ROWS])
        try:
            self.blocks.extend(int(counts[file_format.BLOCKS]), n_rows, closed=closed)
        except RecordingError as error:
            if not closed:
                raise
            lost = n_rows - self.blocks.n_samples
            raise NotARecordingError(
                f"{error}; sensor {self.name!r}: {lost} of {n_rows} samples are lost"
            ) from error
        self.gap_rows.extend(int(counts[file_format.GAPS]))
        if self.blocks.n_samples > self.n_samples:
            refresh(self._samples)
            if self.polled or not self.n_samples:
                refresh(self._instants)
            check_length(self._samples)
            if self._samples.shape[0] < self.blocks.n_samples:
                raise OSError(
                    f"sensor {self.name!r} has {self._samples.shape[0]} rows where"
                    f" {self.blocks.n_samples} were committed"
                )
            self.n_samples = self.blocks.n_samples
        if closed:
            self._check_lengths(counts)
            self._sample_rows.is_closed = self._instant_rows.is_closed = True
        return before != (self.n_samples, self.gap_rows.n_rows)

    def _check_lengths(self, counts: NDArray[np.int64]) -> None:
        """Check that the datasets of a closed recording end with the committed rows."""
        expected = {name: int(counts[file_format.ROWS]) for name in ("samples", "instants")}
        expected |= {"blocks": int(counts[file_format.BLOCKS])}
        for name, n_rows in expected.items():
            found = self._group[name].shape[0]
            if found != n_rows and (name != "instants" or found):
                raise NotARecordingError(
                    f"{self._samples.file.filename}: damaged: {self._group.name}/{name} has"
                    f" {found} rows; expected {n_rows}"
                )
