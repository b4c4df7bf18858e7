"""Files inside ``.gz``, ``.bz2``, ``.xz``, ``.zip`` and ``.tar``, unpacked into a folder.

Archives of archives are not opened. What grows beyond 32 MB and more than a hundredfold holds no
samples, and is refused before it fills disk or memory: what a tar says of itself is counted, too.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import shutil
import tarfile
import zipfile
import zlib
from copy import copy
from pathlib import Path, PurePath
from typing import IO, TYPE_CHECKING, Protocol

from daq.errors import ImportFormatError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from _typeshed import WriteableBuffer

    _Decoder = bz2.BZ2Decompressor | lzma.LZMADecompressor


class _Inflating(io.RawIOBase):
    """What a file of bzip2 or xz becomes, stream by stream.

    `bz2` and `lzma` have this, too, but take as much memory as an xz file asks for, and leave out
    what follows a stream without a word if its head is damaged.
    """

    def __init__(
        self, packed: IO[bytes], decoder: Callable[[], _Decoder], head: bytes = b""
    ) -> None:
        self._packed, self._new, self._decoder = packed, decoder, decoder()
        self._decoder.decompress(head, 0)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer) -> int:
        into = memoryview(buffer).cast("B")
        while True:
            given = b""
            if self._decoder.eof:
                given = self._decoder.unused_data or self._packed.read(_PIECE)
                while given and not (given := given.lstrip(b"\0")):  # padding
                    given = self._packed.read(_PIECE)
                if not given:
                    return 0
                self._decoder = self._new()
            elif self._decoder.needs_input and not (given := self._packed.read(_PIECE)):
                raise EOFError("it ends in the middle")
            if found := self._decoder.decompress(given, len(into)):
                into[: len(found)] = found
                return len(found)

    def close(self) -> None:
        self._packed.close()
        super().close()


class _Counted(io.RawIOBase):
    """A stream that may have so many bytes; `crc32` is that of those that were read."""

    def __init__(self, source: IO[bytes], most: int) -> None:
        self._source, self._left, self.crc32 = source, most, 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer) -> int:
        into = memoryview(buffer).cast("B")
        found = self._source.read(len(into))
        self._left -= len(found)
        if self._left < 0:
            raise _TooMuchError
        self.crc32 = zlib.crc32(found, self.crc32)
        into[: len(found)] = found
        return len(found)


class _TooMuchError(Exception):
    """It becomes more than samples can be."""


_GZIP, _BZIP2, _XZ = b"\x1f\x8b", b"BZh", b"\xfd7zXZ\0"
_STREAMS: dict[bytes, Callable[[Path], IO[bytes]]] = {
    _GZIP: gzip.GzipFile,  # type: ignore[dict-item]  # they are read as files
    _BZIP2: lambda path: _inflating(path.open("rb"), bz2.BZ2Decompressor),
    _XZ: lambda path: _inflating(path.open("rb"), _xz_decoder),
}
"""By the bytes with which they begin."""
_SINGLE = {".gz": _GZIP, ".bz2": _BZIP2, ".xz": _XZ}
_TARS = (".tar", ".tgz", ".tar.gz", ".tar.bz2", ".tar.xz")
_MOST = 100
"""Bytes that a packed byte may become."""
_AT_LEAST = 1 << 25
"""Bytes that any packed file may become."""
_CHUNK, _PIECE = 1 << 20, 1 << 16
_MEMORY = 1 << 27
"""Bytes that a decoder of xz may take; `xz -9` needs half of them."""
_FAULTS = (
    OSError, EOFError, MemoryError, RuntimeError, ValueError, tarfile.TarError,
    zipfile.BadZipFile, lzma.LZMAError, zlib.error,
)  # fmt: skip


class _Readable(Protocol):
    def read(self, size: int, /) -> bytes: ...


def is_packed(path: Path) -> bool:
    """Whether a name is that of a packed file."""
    name = path.name.lower()
    return name.endswith((*_SINGLE, *_TARS, ".zip"))


def unpacked(path: Path, folder: Path) -> list[Path]:
    """Unpack the files of an archive into a folder of their own; return them in its order.

    Raises
    ------
    ImportFormatError
        It is damaged, holds no file, or more than can be samples.
    """
    found: list[Path] = []
    try:
        left = most = max(_AT_LEAST, _MOST * path.stat().st_size)
        for number, (name, source) in enumerate(_members(path, most)):
            own = folder / str(number)  # names may repeat, and lead out of the folder
            own.mkdir(parents=True)
            target = own / (PurePath(name).name or "file")
            with target.open("wb") as file:
                while chunk := source.read(_CHUNK):
                    left -= len(chunk)
                    if left < 0:
                        raise _TooMuchError  # noqa: TRY301 - as by `_Counted`
                    file.write(chunk)
            found.append(target)
    except _TooMuchError:
        shutil.rmtree(folder, ignore_errors=True)
        raise ImportFormatError(
            f"{path}: it unpacks to more than {_MOST} times its size, and to more than 32 MB;"
            " expected samples"
        ) from None
    except _FAULTS as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise ImportFormatError(f"{path}: cannot be unpacked: {error}") from error
    if not found:
        raise ImportFormatError(f"{path}: no file in it; expected files of samples")
    return found


def _members(path: Path, most: int) -> Iterator[tuple[str, _Readable]]:
    """Yield name and content of each file."""
    name = path.name.lower()
    if name.endswith(_TARS):
        with (
            _stream(path) as whole,
            io.BufferedReader(_Counted(whole, most)) as limited,
            tarfile.open(fileobj=limited, mode="r|") as archive,
        ):
            for member in archive:
                source = archive.extractfile(member) if member.isfile() else None
                if source is not None:
                    yield member.name, source
    elif name.endswith(".zip"):
        with zipfile.ZipFile(path) as packed:
            for each in packed.infolist():
                if not each.is_dir():
                    with _member(packed, each) as source:
                        counted = _Counted(source, most)
                        yield each.filename, counted
                        if counted.crc32 != each.CRC:
                            raise zipfile.BadZipFile(f"wrong checksum of {each.filename}")
    else:
        with _STREAMS[_SINGLE[path.suffix.lower()]](path) as single:
            yield path.stem, single


def _stream(path: Path) -> IO[bytes]:
    """Open what a file becomes, whatever it is packed with; the name of a tar may not say it."""
    with path.open("rb") as file:
        head = file.read(6)
    opened = [opened for magic, opened in _STREAMS.items() if head.startswith(magic)]
    return opened[0](path) if opened else path.open("rb")


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> IO[bytes]:
    """Open a file of a zip; `zipfile` inflates all that it reads of bzip2 and LZMA."""
    if info.compress_type not in {zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA}:
        return archive.open(info)
    stored = copy(info)
    stored.compress_type, stored.file_size = zipfile.ZIP_STORED, info.compress_size
    del stored.CRC  # of what the bytes become
    packed = archive.open(stored)
    if info.compress_type == zipfile.ZIP_BZIP2:
        return _inflating(packed, bz2.BZ2Decompressor)
    # APPNOTE 5.8.8: version, size of the properties, properties; then as an .lzma file.
    ends_by_mark = info.flag_bits & 2
    size = (1 << 64) - 1 if ends_by_mark else info.file_size
    head = packed.read(9)[4:] + size.to_bytes(8, "little")
    return _inflating(packed, _xz_decoder, head)


def _inflating(packed: IO[bytes], decoder: Callable[[], _Decoder], head: bytes = b"") -> IO[bytes]:
    return io.BufferedReader(_Inflating(packed, decoder, head))


def _xz_decoder() -> lzma.LZMADecompressor:
    return lzma.LZMADecompressor(memlimit=_MEMORY)
