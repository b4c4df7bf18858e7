"""The journal of a growing recording, from which the recording can be rebuilt.

Theory of operation
-------------------
HDF5 rewrites its metadata in place: object headers, chunk indexes, the last chunk of a table. A
power cut can leave such a block half old and half new; its checksum is then wrong, and HDF5 refuses
the whole file. The stored chunks of samples, however, are written only once.

So each commit also appends to ``<recording>.journal``: the position of each new chunk in the
recording, the new rows of the tables, and the number of safe rows. The journal begins with the
newly created recording. :func:`rebuild` writes the recording again from the journal and the chunks
in the damaged file. A clean close removes the journal.

A journal is a line, ``huddle-journal 1``, and frames: length and CRC-32 of a payload, and the
deflated payload. Frames are only appended, each followed by an fsync; reading ends at the first
incomplete frame.
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from daq.recording import file_format
from daq.recording.storage.names import give_back
from daq.recording.storage.refusals import MAX_CHUNK
from daq.recording.storage.retries import repeated
from daq.recording.storage.superblock import Superblock
from daq.recording.storage.whole_hdf5 import WholeHdf5
from estimator.records import dataclass

_MAGIC = b"huddle-journal 1\n"
_FRAME = struct.Struct("<II")
_INFLATION, _AT_LEAST = 100, 1 << 24
"""Bytes that a packed byte may become, in the mean of a journal, and bytes that any may become.

Rows of tables and the head of a new file are packed up to fifty times; deflate itself could pack
zeros a thousand times."""
_WINDOW = 1 << 20
"""Bytes before the previous end of a recording in which HDF5 may still place a chunk."""
CHUNKED = ("samples", "instants")
TABLES = ("blocks", "gaps")
OF_RUN = ("events", "readings")
"""Tables that are not of a sensor; a journal of an earlier version has no readings."""


def journal_path(recording: Path) -> Path:
    """Return the path of a recording's journal."""
    return recording.with_name(f"{recording.name}.journal")


class Journal:
    """Appends to the journal of a recording that is being written.

    Parameters
    ----------
    path : Path
        Path of the recording, which has been created and flushed.
    file : h5py.File
        The recording.
    mode : int
        Permissions.
    """

    def __init__(self, path: Path, file: h5py.File, mode: int) -> None:
        self.path = journal_path(path)
        self._source = file.id.get_vfd_handle()
        self._searched = os.fstat(self._source).st_size
        self._n_chunks: dict[h5py.Dataset, int] = {}
        # An existing journal belongs to a recording that no longer exists.
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND
        self._handle = os.open(self.path, flags, mode)
        try:
            os.write(self._handle, _MAGIC)
            self._append(os.pread(self._source, self._searched, 0))
        except BaseException:
            self.remove()
            raise

    def commit(
        self,
        chunked: Mapping[str, Sequence[h5py.Dataset]],
        tables: Mapping[str, Sequence[bytes]],
        counts: np.ndarray[Any, np.dtype[np.int64]],
    ) -> None:
        """Append the rows that became safe since the last commit, and fsync.

        Parameters
        ----------
        chunked : mapping
            Datasets `CHUNKED` of each sensor.
        tables : mapping
            New rows of the `TABLES` of each sensor; the key ``""`` has those of `OF_RUN`.
        counts : int64, shape (n_sensors + 1, 3)
            The new ``/committed``.
        """
        stored: dict[str, list[list[list[int]]]] = {}
        contents: list[bytes] = []
        new = [
            (sensor, kind, chunk)
            for sensor, datasets in chunked.items()
            for kind, dataset in enumerate(datasets)
            for chunk in self._new_chunks(dataset)
        ]
        window = _Window(self._source, self._searched) if new else None
        for sensor, kind, (mask, content) in new:
            offset = window.find(content) if window is not None else -1
            if offset < 0:  # not found near the end: the journal holds the chunk itself
                contents.append(content)
            entry = stored.setdefault(sensor, [[] for _ in CHUNKED])
            entry[kind].append([offset, len(content), mask])
        if window is not None:
            self._searched = window.end
        lengths = {name: [len(rows) for rows in all_rows] for name, all_rows in tables.items()}
        head = json.dumps({"counts": counts.tolist(), "stored": stored, "tables": lengths})
        rows = [rows for all_rows in tables.values() for rows in all_rows]
        self._append(b"\n".join([head.encode(), b"".join([*contents, *rows])]))

    def _new_chunks(self, dataset: h5py.Dataset) -> Iterator[tuple[int, bytes]]:
        """Yield filter mask and bytes of the chunks stored since the last call."""
        first = self._n_chunks.get(dataset, 0)
        n_rows, *columns = dataset.id.shape
        if not n_rows:
            return
        length, corner = dataset.chunks[0], (0,) * len(columns)
        n_chunks = -(-n_rows // length)
        for number in range(first, n_chunks):
            mask, content = dataset.id.read_direct_chunk((number * length, *corner))
            yield int(mask), bytes(content)
        self._n_chunks[dataset] = n_chunks

    def keep_name(self) -> None:
        """Give the journal its name again, if the recording was moved with it."""
        if not os.path.lexists(self.path):
            with contextlib.suppress(OSError, NotImplementedError):
                give_back(self.path, self._handle)
                nameless, self._handle = self._handle, os.open(self.path, os.O_WRONLY | os.O_APPEND)
                os.close(nameless)

    def _append(self, payload: bytes) -> None:
        packed = zlib.compress(payload, 1)
        frame = _FRAME.pack(len(packed), zlib.crc32(packed)) + packed
        end = os.fstat(self._handle).st_size
        repeated(lambda: self._write_at_end(end, frame))
        os.fsync(self._handle)

    def _write_at_end(self, end: int, frame: bytes) -> None:
        os.ftruncate(self._handle, end)  # remove the rest of a failed write
        while frame:
            frame = frame[os.write(self._handle, frame) :]

    def close(self) -> None:
        """Close the journal without removing it; may be called again."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def remove(self) -> None:
        """Remove the journal: the recording is closed and safe."""
        self.close()
        self.path.unlink(missing_ok=True)


class _Window:
    """The end of a recording, which has the new chunks."""

    def __init__(self, handle: int, searched: int) -> None:
        self.end = os.fstat(handle).st_size
        self._first = max(0, searched - _WINDOW)
        self._content = os.pread(handle, self.end - self._first, self._first)
        self._next = 0

    def find(self, content: bytes) -> int:
        """Return the position of these bytes in the recording, or -1."""
        at = self._content.find(content, self._next)
        if at < 0:
            at = self._content.find(content)
        if at < 0:
            return -1
        self._next = at + len(content)
        return self._first + at


@dataclass(slots=True)
class JournalContents:
    """Contents of a journal.

    Attributes
    ----------
    created : bytes
        The newly created recording, as a closed file.
    counts : int64, shape (n_sensors + 1, 3)
        The last ``/committed``.
    chunks : dict
        Offset, size, filter mask of each chunk, and its bytes if the offset is negative, by
        (sensor, dataset).
    tables : dict
        All rows, by (sensor, dataset), or ("", dataset) for `OF_RUN`.
    """

    created: bytes
    counts: np.ndarray[Any, np.dtype[np.int64]] | None = None
    chunks: dict[tuple[str, str], list[tuple[int, int, int, bytes]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    tables: dict[tuple[str, str], bytearray] = field(default_factory=lambda: defaultdict(bytearray))


def read_journal(recording: Path) -> JournalContents | None:
    """Return the contents of a recording's journal; None without a usable one."""
    found: JournalContents | None = None
    for payload in _frames(journal_path(recording)):
        if found is None:
            found = JournalContents(Superblock(payload, len(payload)).cleared_file())
        else:
            try:
                _add(found, payload)
            except (
                ValueError,
                LookupError,
                TypeError,
                AttributeError,
                ArithmeticError,
                RecursionError,
            ):
                break  # not of our writer: what came before it counts
    return found


def _frames(path: Path) -> Iterator[bytes]:
    try:
        with path.open("rb") as file:
            held = os.fstat(file.fileno()).st_size
            left = max(_AT_LEAST, _INFLATION * held)
            if file.read(len(_MAGIC)) != _MAGIC:
                return
            while len(head := file.read(_FRAME.size)) == _FRAME.size:
                length, crc32 = _FRAME.unpack(head)
                packed = file.read(min(length, held))
                if len(packed) < length or zlib.crc32(packed) != crc32:
                    return
                inflate = zlib.decompressobj()
                payload = inflate.decompress(packed, left + 1)
                left -= len(payload)
                if left < 0 or not inflate.eof:
                    return
                yield payload
    except (FileNotFoundError, zlib.error):
        return


def _add(found: JournalContents, payload: bytes) -> None:
    head, _, rest = payload.partition(b"\n")
    described = json.loads(head)
    counts = np.array(described["counts"], np.int64)
    if counts.ndim != 2 or counts.shape[1] != 3 or counts.min() < 0:
        raise ValueError(f"counts of shape {counts.shape}; expected (n_sensors + 1, 3)")
    at = 0
    for sensor, kinds in described["stored"].items():
        for name, chunks in zip(CHUNKED, kinds, strict=True):
            for offset, size, mask in chunks:
                kept = b"" if offset >= 0 else rest[at : at + size]
                at += len(kept)
                found.chunks[sensor, name].append((offset, size, mask, kept))
    for sensor, lengths in described["tables"].items():
        names = TABLES if sensor else OF_RUN[: len(lengths)]
        for name, length in zip(names, lengths, strict=True):
            found.tables[sensor, name] += rest[at : at + length]
            at += length
    found.counts = counts


def rebuild(damaged: Path, contents: JournalContents, copy: Path) -> None:
    """Write a recording again from its journal and the chunks in the damaged file.

    Parameters
    ----------
    damaged : Path
        The damaged recording; not changed.
    contents : JournalContents
    copy : Path
        File to write.
    """
    copy.write_bytes(contents.created)
    counts = contents.counts
    with WholeHdf5(copy, libver=file_format.LIBVER) as hdf5, damaged.open("rb") as source:
        file = hdf5.file
        names = file_format.texts(file["committed"].attrs["sensors"])
        if counts is None:
            return
        for name, row in zip(names, counts, strict=False):
            group = file["sensors"][name]
            n_rows = int(row[file_format.ROWS])
            for kind in CHUNKED:
                stored = contents.chunks.get((name, kind), [])
                _put_chunks(group[kind], stored, n_rows, source)
            for kind, n in zip(TABLES, row[[file_format.BLOCKS, file_format.GAPS]], strict=True):
                _put_rows(group[kind], contents.tables.get((name, kind), b""), int(n))
        columns = counts[-1, [file_format.EVENTS, file_format.READINGS]]
        for kind, n in zip(OF_RUN, columns, strict=True):
            if kind in file:
                _put_rows(file[kind], contents.tables.get(("", kind), b""), int(n))
        file["committed"][...] = counts


def _put_chunks(
    dataset: h5py.Dataset,
    stored: Sequence[tuple[int, int, int, bytes]],
    n_rows: int,
    source: Any,  # noqa: ANN401 - a binary file
) -> None:
    length = dataset.chunks[0]
    corner = (0,) * (dataset.ndim - 1)
    if not stored:
        return
    dataset.resize(min(len(stored) * length, -(-n_rows // length) * length), axis=0)
    for number, (offset, size, mask, kept) in enumerate(stored):
        if number * length >= n_rows:
            break
        content = kept
        if offset >= 0:
            source.seek(offset)
            content = source.read(min(size, 2 * MAX_CHUNK))
        dataset.id.write_direct_chunk((number * length, *corner), content, mask)
    dataset.resize(min(n_rows, dataset.shape[0]), axis=0)


def _put_rows(dataset: h5py.Dataset, content: bytes | bytearray, n_rows: int) -> None:
    rows = np.frombuffer(bytes(content), dataset.dtype)[:n_rows]
    dataset.resize(len(rows), axis=0)
    if len(rows):
        dataset[...] = rows
