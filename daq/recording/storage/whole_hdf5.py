"""HDF5 files that are proven: what the disk has is what was in memory."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from daq.recording.storage.packing import check_chunks
from daq.whole_file import RememberingFile, wrong_content

_BYTES_PER_READ = 1 << 22


class WholeHdf5:
    """Writes an HDF5 file and compares it with what was in memory; a context manager.

    Parameters
    ----------
    part : Path or None
        A new file, or one to change. It has no name yet by which others know it. None is a file in
        memory alone.
    **options
        As `h5py.File` takes them.

    Attributes
    ----------
    file : h5py.File
    contents : dict of str to bytes
        SHA-256 of the contents of datasets by path, of arrays in memory.

    Raises
    ------
    OSError
        On leaving, if a write failed, or the disk has other contents.
    """

    def __init__(self, part: Path | None, **options: Any) -> None:  # noqa: ANN401 - untyped
        self.contents: dict[str, bytes] = {}
        self._part = part
        if part is None:
            self._disk = None
            self.file = h5py.File("memory", "w", driver="core", backing_store=False, **options)
            return
        exists = part.exists()
        self._disk = RememberingFile(part, "r+" if exists else "x+")
        try:
            self.file = h5py.File(self._disk, "r+" if exists else "w", **options)
        except BaseException:
            self._disk.close()
            raise

    def create(self, path: str, values: NDArray[Any], **options: Any) -> h5py.Dataset:  # noqa: ANN401
        """Create a dataset; options as `h5py.Group.create_dataset` takes them."""
        made = self.file.create_dataset(path, data=values, **options)
        self.expect(made, values)
        return made

    def expect(self, made: h5py.Dataset, values: NDArray[Any]) -> None:
        """State what a dataset must hold when the file is closed."""
        rows = np.asarray(values).astype(made.dtype, copy=False)
        self.contents[made.name] = hashlib.sha256(little_endian(rows)).digest()
        self.check()

    def copy(self, source: h5py.File, path: str) -> None:
        """Copy a group of another file."""

        def expect(name: str, found: h5py.Group | h5py.Dataset) -> None:
            if isinstance(found, h5py.Dataset):
                self.contents[f"/{path}/{name}"] = contents_sha256(found)

        source.copy(path, self.file, path)
        source[path].visititems(expect)
        self.check()

    def check(self) -> None:
        """Raise the failure of an earlier write, if there was one."""
        if self._disk is not None:
            self._disk.check()

    def prove(self) -> None:
        """Close the file, and compare it with what was in memory."""
        try:
            self.file.flush()
        finally:
            self.close()
            self.check()  # HDF5 may have raised what follows from it
        if self._part is None:
            return
        try:
            with h5py.File(self._part, "r", locking=False) as file:
                found = {path: contents_sha256(file[path]) for path in self.contents}
        except (OSError, RuntimeError, KeyError) as error:
            raise wrong_content(self._part) from error
        if found != self.contents:
            raise wrong_content(self._part)

    def close(self) -> None:
        """Close the file as it is."""
        with self._disk or contextlib.nullcontext():
            self.file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if error is None:
            self.prove()
            return
        with contextlib.suppress(OSError, RuntimeError):
            self.close()
        self.check()


def contents_sha256(found: h5py.Dataset, progress: Callable[[], object] = lambda: None) -> bytes:
    """Return the SHA-256 of the numbers of a dataset, `little_endian`, read in parts."""
    digest = hashlib.sha256()
    if not found.shape:
        digest.update(little_endian(np.asarray(found[()])))
        return digest.digest()
    per_row = max(1, int(np.prod(found.shape[1:])) * found.dtype.itemsize)
    length = found.chunks[0] if found.chunks else 1
    n_rows = max(1, _BYTES_PER_READ // (per_row * length)) * length
    for first in range(0, found.shape[0], n_rows):
        if found.chunks:
            check_chunks(found, first, first + n_rows)
        digest.update(little_endian(found[first : first + n_rows]))
        progress()
    return digest.digest()


def little_endian(rows: NDArray[Any]) -> bytes:
    """Return numbers as little-endian bytes in C order."""
    return rows.astype(rows.dtype.newbyteorder("<"), copy=False).tobytes()
