"""The superblock of a recording: end of the file, and flags of a writer.

A killed SWMR writer leaves flags in the superblock that forbid a plain open, and an end-of-file
address that may be too small or, on a full disk, too large. If only the flags are cleared, HDF5
truncates the file at that address. So flags, end-of-file address and checksum are rewritten
together. All recordings have version 3 of the superblock (HDF5 file format specification, II.A), in
the first 48 bytes.
"""

from __future__ import annotations

import io
import shlex
import stat
import struct
from pathlib import Path

from daq.errors import NotARecordingError, RecordingError
from daq.foreign_files import import_command
from estimator.records import dataclass

SIGNATURE = b"\x89HDF\r\n\x1a\n"
_FIELDS = struct.Struct("<8sBBBBQQQQ")
_VERSION, _FLAGS, _END = 1, 4, 7
_SIZE = 48
_MASK = 0xFFFFFFFF


def _way_in(path: Path) -> str:
    """Return which command takes a file that is no recording."""
    if path.suffix.lower() == ".toml":
        return f"record by a bench file: huddle run {shlex.quote(str(path))}"
    if path.is_dir() or path.suffix in {".h5", ".hdf5"}:
        return "expected an HDF5 file"
    return f"convert it: {import_command([path])}"


@dataclass(frozen=True, slots=True)
class Superblock:
    """The first bytes of a file and its length."""

    head: bytes
    n_bytes: int

    @classmethod
    def of(cls, path: Path) -> Superblock:
        """Read the superblock of a file.

        Raises
        ------
        RecordingError
            If the file cannot be read.
        NotARecordingError
            If it is no HDF5 file, or shorter than a superblock.
        """
        try:
            status = path.stat()
            is_file = stat.S_ISREG(status.st_mode)  # reading a pipe would block
            head = _first_bytes(path) if is_file else b""
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
        n_bytes = status.st_size
        if head[: len(SIGNATURE)] != SIGNATURE:
            raise NotARecordingError(f"{path}: not a huddle recording; {_way_in(path)}")
        if n_bytes < _SIZE:
            raise NotARecordingError(f"{path}: truncated to {n_bytes} bytes; copy the file again")
        return cls(head, n_bytes)

    @property
    def version(self) -> int:
        """3 for recordings; other HDF5 files may have another."""
        return self.head[8]

    @property
    def end(self) -> int:
        """Length of the file in bytes, according to the superblock; 0 in other versions."""
        return int(_FIELDS.unpack_from(self.head)[_END]) if self.version == 3 else 0

    @property
    def is_open(self) -> bool:
        """Whether the writer of the file has not closed it."""
        return self.version == 3 and _FIELDS.unpack_from(self.head)[_FLAGS] != 0

    def cleared(self) -> bytes:
        """Return the first bytes for a closed file of the actual length."""
        fields = list(_FIELDS.unpack_from(self.head))
        if fields[_VERSION] != 3:
            raise NotARecordingError(f"superblock version {fields[_VERSION]}; expected 3")
        fields[_FLAGS], fields[_END] = 0, self.n_bytes
        head = _FIELDS.pack(*fields)
        return head + struct.pack("<I", lookup3(head))

    def cleared_file(self) -> bytes:
        """Return the file as a closed one, if `head` is the complete file."""
        cleared = self.cleared()
        return cleared + self.head[len(cleared) :]


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_SIZE)


class ClearedFile(io.RawIOBase):
    """A readable file whose superblock appears closed."""

    def __init__(self, path: Path, superblock: Superblock) -> None:
        self._path = path
        self._file = path.open("rb")
        self._head = superblock.cleared()

    def __repr__(self) -> str:
        """Return the path, which h5py uses in messages."""
        return str(self._path)

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Set the position in the file; raise OSError where no file can have it."""
        try:
            return self._file.seek(offset, whence)
        except (ValueError, OverflowError) as error:  # a damaged address
            raise OSError(f"address {offset} is beyond the end of the file") from error

    def tell(self) -> int:
        """Return the position in the file."""
        return self._file.tell()

    def readinto(self, buffer: memoryview, /) -> int:  # type: ignore[override]  # HDF5 gives this
        """Read bytes into a buffer; return their number."""
        start = self._file.tell()
        n_bytes = self._file.readinto(buffer)
        if start < _SIZE and n_bytes:
            head = self._head[start : start + n_bytes]
            buffer[: len(head)] = head
        return n_bytes

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def lookup3(key: bytes) -> int:
    """Return Bob Jenkins' lookup3 checksum of a few bytes, with initial value 0 as in HDF5."""
    a: int = (0xDEADBEEF + len(key)) & _MASK
    b, c = a, a
    if not key:
        return c
    padded = key + bytes(-len(key) % 12)
    words: tuple[int, ...] = struct.unpack(f"<{len(padded) // 4}I", padded)
    *whole, last = (words[start : start + 3] for start in range(0, len(words), 3))
    for triple in whole:
        a, b, c = (a + triple[0]) & _MASK, (b + triple[1]) & _MASK, (c + triple[2]) & _MASK
        for rotation in (4, 6, 8, 16, 19, 4):
            # The roles of a, b and c rotate from round to round.
            a = ((a - c) & _MASK) ^ _rotated(c, rotation)
            a, b, c = b, (c + b) & _MASK, a
    a, b, c = (a + last[0]) & _MASK, (b + last[1]) & _MASK, (c + last[2]) & _MASK
    for rotation in (14, 11, 25, 16, 4, 14, 24):
        c = ((c ^ b) - _rotated(b, rotation)) & _MASK
        a, b, c = b, c, a
    return b


def _rotated(value: int, bits: int) -> int:
    return ((value << bits) | (value >> (32 - bits))) & _MASK
