"""Files inside ``.gz``, ``.bz2``, ``.xz``, ``.zip`` and ``.tar``, unpacked into a folder.

Archives of archives are not opened. What grows beyond 32 MB and more than a hundredfold holds no
samples, and is refused before it fills the disk.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import shutil
import tarfile
import zipfile
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Protocol

from daq.errors import ImportFormatError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_SINGLE: dict[str, Callable[[Path], gzip.GzipFile | bz2.BZ2File | lzma.LZMAFile]] = {
    ".gz": gzip.GzipFile,
    ".bz2": bz2.BZ2File,
    ".xz": lzma.LZMAFile,
}
_TARS = (".tar", ".tgz", ".tar.gz", ".tar.bz2", ".tar.xz")
_MOST = 100
"""Bytes that a packed byte may become."""
_AT_LEAST = 1 << 25
"""Bytes that any packed file may become."""
_CHUNK = 1 << 20


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
    left = max(_AT_LEAST, _MOST * path.stat().st_size) if path.is_file() else 0
    try:
        for number, (name, source) in enumerate(_members(path)):
            own = folder / str(number)  # names may repeat, and lead out of the folder
            own.mkdir(parents=True)
            target = own / (PurePath(name).name or "file")
            with target.open("wb") as file:
                while chunk := source.read(_CHUNK):
                    left -= len(chunk)
                    if left < 0:
                        raise ImportFormatError(
                            f"{path}: it unpacks to more than {_MOST} times its size, and to"
                            " more than 32 MB; expected samples"
                        )
                    file.write(chunk)
            found.append(target)
    except (OSError, EOFError, tarfile.TarError, zipfile.BadZipFile, lzma.LZMAError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise ImportFormatError(f"{path}: cannot be unpacked: {error}") from error
    if not found:
        raise ImportFormatError(f"{path}: no file in it; expected files of samples")
    return found


def _members(path: Path) -> Iterator[tuple[str, _Readable]]:
    """Yield name and content of each file."""
    name = path.name.lower()
    if name.endswith(_TARS):
        with tarfile.open(path) as archive:
            for member in archive:
                source = archive.extractfile(member) if member.isfile() else None
                if source is not None:
                    yield member.name, source
    elif name.endswith(".zip"):
        with zipfile.ZipFile(path) as packed:
            for each in packed.infolist():
                if not each.is_dir():
                    with packed.open(each) as source:
                        yield each.filename, source
    else:
        with _SINGLE[path.suffix.lower()](path) as single:
            yield path.stem, single
