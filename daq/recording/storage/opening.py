"""Opens the HDF5 file of a recording, in bounded time whatever the file holds.

Theory of operation
-------------------
Only a file that is being written is opened as a SWMR reader. HDF5 then reads a metadata block whose
checksum is wrong again, up to 100 times, and doubles the pause before each attempt: in a damaged
file that takes longer than an hour. So the number of attempts is limited for such files. A file at
rest is opened plainly, where one attempt is made.
"""

from __future__ import annotations

import contextlib
import ctypes
import sys
from functools import cache
from typing import TYPE_CHECKING, Any

import h5py

from daq.errors import NotARecordingError
from daq.recording.storage.locking import is_being_written
from daq.recording.storage.superblock import ClearedFile, Superblock

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

READ_ATTEMPTS = 30
"""Attempts to read a metadata block that its writer may be rewriting: one second in all."""
_DRIVER = "huddle-growing"


def open_file(path: Path) -> h5py.File:
    """Open a file for reading: growing, closed, or left open by a killed recorder.

    Raises
    ------
    NotARecordingError
        If it is no HDF5 file, truncated, or damaged where HDF5 begins to read.
    RecordingError
        If it cannot be read.
    """
    superblock = Superblock.of(path)
    growing = superblock.is_open and (sys.platform == "win32" or is_being_written(path))
    if superblock.end > superblock.n_bytes and not superblock.is_open:
        raise NotARecordingError(
            f"{path}: truncated: {superblock.n_bytes} of {superblock.end} bytes; copy the file"
            " again"
        )
    try:
        if growing:
            _register_driver()
            return h5py.File(path, "r", driver=_DRIVER, libver="latest", swmr=True, locking=False)
        if not superblock.is_open:
            with contextlib.suppress(OSError):  # open in this process as a SWMR reader: see below
                return h5py.File(path, "r", locking=False)
        # Through Python: HDF5 would share cached metadata with other readers of the file in this
        # process, and beside one that has not been refreshed, return zeros in place of samples.
        return h5py.File(source_of(path, superblock), "r")
    except (OSError, RuntimeError) as error:
        raise NotARecordingError(f"{path}: cannot be opened as HDF5: {error}") from error


def refresh(dataset: h5py.Dataset) -> None:
    """Read again what a writer may have changed of a dataset.

    At rest nothing changes, and nothing is read again: where two readers of the process have the
    file open, HDF5 would lose the chunks of the dataset, and return zeros in place of rows.
    """
    if dataset.file.swmr_mode:
        dataset.refresh()


def source_of(path: Path, superblock: Superblock) -> ClearedFile | Path:
    """Return what HDF5 opens as a file at rest, even if a program is writing it."""
    return ClearedFile(path, superblock) if superblock.version == 3 else path


@cache
def _register_driver() -> None:
    h5py.register_driver(_DRIVER, _set_driver)


def _set_driver(access: Any, **_: object) -> None:  # noqa: ANN401 - h5py is untyped
    """Make a file access list limit the attempts; h5py has no name for that."""
    access.set_fapl_sec2()
    limit = _attempts_setter()
    if limit is not None:
        limit(access.id, READ_ATTEMPTS)


@cache
def _attempts_setter() -> Callable[[int, int], int] | None:
    """Return ``H5Pset_metadata_read_attempts`` of the library that h5py has loaded."""
    try:
        function = ctypes.CDLL(h5py.h5p.__file__).H5Pset_metadata_read_attempts
    except (AttributeError, OSError):  # Windows looks for no function in a library's dependencies
        return None
    function.argtypes, function.restype = (ctypes.c_int64, ctypes.c_uint), ctypes.c_int
    return function
