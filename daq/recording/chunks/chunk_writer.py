"""Buffers the rows of one sensor: writes complete chunks of samples, merges small blocks."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from h5py import h5s, h5t
from numpy.typing import NDArray

from daq.errors import RecordingError
from daq.protocols.block import Block, HostTime
from daq.recording import file_format
from daq.recording.extremes import NewExtremes, checksum
from daq.recording.file_format import SensorLayout
from daq.recording.storage.packing import RAW, packed
from daq.recording.storage.retries import repeated, report

_MERGED_SECONDS = 0.1
"""Length of merged blocks in seconds."""


class AppendedRows:
    """Rows at the end of a dataset, written by HDF5's own functions.

    Indexing a `h5py.Dataset` takes five times as long for so few rows. HDF5 takes memory as it is,
    so rows are converted to the dataset's type first.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._id = dataset.id
        self._dtype = dataset.dtype
        self._type = h5t.py_create(dataset.dtype)
        self._columns = dataset.shape[1:]
        self._corner = (0,) * len(self._columns)

    def extend(self, n_rows: int) -> None:
        """Set the number of rows."""
        self._id.set_extent((n_rows, *self._columns))

    def write(self, first: int, rows: NDArray[Any]) -> None:
        """Write `rows` from row `first` on."""
        rows = np.ascontiguousarray(rows, self._dtype)
        place = self._id.get_space()
        place.select_hyperslab((first, *self._corner), rows.shape)
        self._id.write(h5s.create_simple(rows.shape), place, rows, self._type)


class TableBuffer:
    """Appends rows to a table; the dataset is unfiltered, so that rows are written in place."""

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._rows = AppendedRows(dataset)
        self.name: str = dataset.name
        self._waiting: list[NDArray[np.void]] = []
        self.n_rows = 0
        self.written = b""
        """Rows written by the last `write`, as bytes."""
        self.sha256 = hashlib.sha256()
        """Of all written rows."""

    def add(self, row: NDArray[np.void]) -> None:
        """Buffer a row until the next `write`."""
        self._waiting.append(row)

    def write(self) -> None:
        """Write the buffered rows."""
        self.written = b""
        if not self._waiting:
            return
        # np.concatenate would look for a common type of each two rows.
        content = b"".join(row.tobytes() for row in self._waiting)
        rows = np.frombuffer(content, self._waiting[0].dtype)
        repeated(lambda: self._rows.extend(self.n_rows + len(rows)))
        repeated(lambda: self._rows.write(self.n_rows, rows))
        self.n_rows += len(rows)
        self.written = content
        self.sha256.update(self.written)
        self._waiting.clear()


class ChunkBuffer:
    """Appends rows to a dataset in complete chunks; buffers the rows of an incomplete chunk.

    Parameters
    ----------
    dataset : h5py.Dataset
    packs : bool
        Pack chunks as in `daq.recording.storage.packing`. Not in a file that may be left open: when
        HDF5 2.0 shrinks a dataset to what was acknowledged, it filters the last chunk without
        regard to the chunk's mask, and destroys it.
    wrote : callable, optional
        Takes all rows once they are written.
    """

    def __init__(
        self,
        dataset: h5py.Dataset,
        *,
        packs: bool = False,
        wrote: Callable[[NDArray[Any]], None] = lambda _: None,
    ) -> None:
        self.dataset = dataset
        self._packs, self._wrote = packs, wrote
        self._rows = AppendedRows(dataset)
        self._buffer = np.empty(dataset.chunks, dataset.dtype)
        self._filled = 0
        self._unsafe: list[tuple[int, NDArray[Any]]] = []
        self.n_written = 0
        self.sha256 = hashlib.sha256()
        """Of all written rows."""

    def write_again(self) -> None:
        """Write the chunks that are not yet safe again, without HDF5's cache.

        HDF5 loses a chunk that it could not write, or keeps a wrong one. This method writes chunks
        directly, without filters, and reads them back.

        Raises
        ------
        OSError, RuntimeError
            If the disk refuses again.
        """
        length, *columns = self.dataset.chunks
        corner = (0,) * len(columns)
        for begin, rows in self._unsafe:
            for first in range(0, len(rows), length):
                chunk = np.zeros(self.dataset.chunks, self.dataset.dtype)
                part = rows[first : first + length]
                chunk[: len(part)] = part
                place = (begin + first, *corner)
                self.dataset.id.write_direct_chunk(place, chunk.tobytes(), RAW)
                if bytes(self.dataset.id.read_direct_chunk(place)[1]) != chunk.tobytes():
                    raise OSError(f"{self.dataset.name}: a chunk was not stored as written")

    def are_safe(self) -> None:
        """Drop the written chunks: the file has been flushed."""
        self._unsafe.clear()

    def add(self, rows: NDArray[Any]) -> None:
        """Add rows, and write the complete chunks."""
        length = len(self._buffer)
        taken = min(len(rows), length - self._filled) if self._filled else 0
        if taken:
            self._buffer[self._filled : self._filled + taken] = rows[:taken]
            self._filled += taken
            if self._filled == length:
                self._filled = 0
                self._write(self._buffer)
        whole = taken + (len(rows) - taken) // length * length
        if whole > taken:
            self._write(rows[taken:whole])
        rest = rows[whole:]
        if len(rest):
            self._buffer[: len(rest)] = rest
            self._filled = len(rest)

    def finish(self) -> None:
        """Write the buffered rows as a last, partial chunk."""
        rest, self._filled = self._filled, 0
        if rest:
            self._write(self._buffer[:rest])

    def _write(self, rows: NDArray[Any]) -> None:
        repeated(lambda: self._rows.extend(self.n_written + len(rows)))
        self._unsafe.append((self.n_written, rows.copy()))
        try:
            if self._packs:
                self._store(rows)
            else:
                self._rows.write(self.n_written, rows)
        except (OSError, RuntimeError) as error:
            report(error)
            repeated(self.write_again)
        self.n_written += len(rows)
        self._wrote(rows)
        self.sha256.update(np.ascontiguousarray(rows, self._buffer.dtype).data)

    def _store(self, rows: NDArray[Any]) -> None:
        """Write rows as chunks, which HDF5 takes as they are; the last is filled up with zeros."""
        length, *columns = self.dataset.chunks
        rows = np.ascontiguousarray(rows, self.dataset.dtype)
        for first in range(0, len(rows), length):
            chunk = rows[first : first + length]
            if len(chunk) < length:
                chunk = np.concatenate(
                    [chunk, np.zeros((length - len(chunk), *columns), chunk.dtype)]
                )
            content, mask = packed(chunk)
            place = (self.n_written + first, *(0 for _ in columns))
            self.dataset.id.write_direct_chunk(place, content, mask)


@dataclass(slots=True)
class _OpenBlock:
    """A block to which further samples may be added."""

    first_sample: int
    first_row: int
    n_samples: int
    received: HostTime
    device_counter: int
    flags: int

    def array(self) -> NDArray[np.void]:
        """Return the block's row without its checksum."""
        at = self.received.monotonic_ns, self.received.utc_ns
        begin = self.first_sample, self.first_row, self.n_samples
        return np.array(
            [(*begin, *at, self.device_counter, self.flags, 0)], file_format.BLOCK_DTYPE
        )


class SensorRows:
    """Buffers samples, blocks and gaps of one sensor.

    Small contiguous blocks are merged into one row of ``blocks`` of up to 0.1 s: at 200 Hz a serial
    port delivers three or four samples per read, which take less space than a row.
    """

    def __init__(self, group: h5py.Group, sensor: SensorLayout, *, packs: bool = False) -> None:
        self.extremes, self.of_blocks = NewExtremes(sensor), 0
        self.samples = ChunkBuffer(group["samples"], packs=packs, wrote=self.extremes.add)
        self.instants = ChunkBuffer(group["instants"], packs=packs)
        self._polled: bool | None = None
        self.blocks = TableBuffer(group["blocks"])
        self.gaps = TableBuffer(group["gaps"])
        self._layout = sensor
        self._merged_length = max(1, round(sensor.sampling_rate * _MERGED_SECONDS))
        self._current: _OpenBlock | None = None
        self._crc32 = 0
        self._finished: list[NDArray[np.void]] = []
        self._n_rows = 0

    def append(self, block: Block) -> None:
        """Add a block.

        Raises
        ------
        RecordingError
            If its shape or type differs from that of the sensor.
        """
        counts = self._converted(block)
        if self._polled is None:
            self._polled = block.instants_ns is not None
        elif self._polled != (block.instants_ns is not None):
            raise RecordingError(
                f"sensor {block.sensor!r}: some blocks have sample times, others do not"
            )
        merged = self._merge(block)
        self._crc32 = zlib.crc32(counts.data, self._crc32 if merged else 0)
        self._n_rows += block.n_samples
        self.samples.add(counts)
        if block.instants_ns is not None:
            self.instants.add(block.instants_ns)

    def collect(self) -> None:
        """Add the blocks with completely written samples to the table of blocks."""
        written = self.samples.n_written
        if self._polled:
            written = min(written, self.instants.n_written)
        if self._n_rows == written:
            self._end_current()
        done = 0
        for row in self._finished:
            if row["first_row"][0] + row["n_samples"][0] > written:
                break
            self.blocks.add(row)
            self.of_blocks = checksum(row, self.of_blocks)
            done += 1
        del self._finished[:done]

    def write_again(self) -> None:
        """Write the samples that are not yet safe again."""
        self.samples.write_again()
        self.instants.write_again()

    def are_safe(self) -> None:
        """Drop the written samples: they are safe."""
        self.samples.are_safe()
        self.instants.are_safe()

    def finish(self) -> None:
        """End the current block and write all buffered samples."""
        self._end_current()
        self.samples.finish()
        self.instants.finish()

    def contents_sha256(self) -> dict[str, bytes]:
        """Return the SHA-256 of all written rows of each dataset, by its path."""
        return {
            **{b.dataset.name: b.sha256.digest() for b in (self.samples, self.instants)},
            **{t.name: t.sha256.digest() for t in (self.blocks, self.gaps)},
        }

    @property
    def committable_rows(self) -> int:
        """Number of rows of samples in the blocks of the table."""
        if self._finished:
            return int(self._finished[0]["first_row"][0])
        return self._n_rows if self._current is None else self._current.first_row

    def _merge(self, block: Block) -> bool:
        """Merge a block into the current one; return False if it begins a new one."""
        current = self._current
        if (
            current is not None
            and block.first_sample == current.first_sample + current.n_samples
            and int(block.flags) == current.flags
            and not block.reason
            and current.n_samples + block.n_samples <= self._merged_length
        ):
            current.n_samples += block.n_samples
            current.received = block.received
            return True
        self._end_current()
        counter = file_format.NO_COUNTER if block.device_counter is None else block.device_counter
        self._current = _OpenBlock(
            block.first_sample,
            self._n_rows,
            block.n_samples,
            block.received,
            counter,
            int(block.flags),
        )
        return False

    def _end_current(self) -> None:
        if self._current is not None:
            row = self._current.array()
            row["crc32"] = file_format.block_crc32(row, self._crc32)
            self._finished.append(row)
            self._current = None

    def _converted(self, block: Block) -> NDArray[Any]:
        expected = len(self._layout.channels)
        if block.counts.ndim != 2 or block.counts.shape[1] != expected:
            raise RecordingError(
                f"sensor {block.sensor!r}: a block of shape {block.counts.shape};"
                f" expected (n_samples, {expected})"
            )
        counts: NDArray[Any] = np.ascontiguousarray(block.counts, self._layout.dtype)
        safe = np.can_cast(block.counts.dtype, self._layout.dtype, "safe")
        if not safe and not np.array_equal(counts, block.counts):
            raise RecordingError(
                f"sensor {block.sensor!r}: counts of type {block.counts.dtype} do not fit"
                f" {self._layout.dtype}"
            )
        return counts
