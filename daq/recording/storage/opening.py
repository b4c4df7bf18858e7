"""Opens the HDF5 file of a recording, in bounded time for any content.

Theory of operation
-------------------
Only a file that is being written is opened as a SWMR reader. HDF5 then repeats the read of a
metadata block with a wrong checksum up to 100 times, and doubles the pause before each attempt: in
a damaged file this takes longer than an hour. So the number of attempts is limited for such files.
A file at rest is opened without SWMR, and read with one attempt; but first in a child process
(:mod:`daq.recording.storage.trial`).
"""

from __future__ import annotations

import contextlib
import ctypes
import sys
from functools import cache
from pathlib import Path
from typing import Any

import h5py

from daq.errors import NotARecordingError
from daq.recording.storage import trial
from daq.recording.storage.locking import is_being_written
from daq.recording.storage.refusals import hdf5_function
from daq.recording.storage.superblock import ClearedFile, Superblock

READ_ATTEMPTS = 30
"""Attempts to read a metadata block that its writer may be rewriting: one second in total."""
_DRIVER = "huddle-growing"
_CACHE, _SLOTS = 1 << 18, 521
"""Bytes of chunks that HDF5 keeps of each dataset, and how many places it has for them. Chunks are
read in order, and few of them again; by default it keeps 8 MB (HDF5 2.0) in 8191 places, which are
26 MB of a day of three sensors, and 16 MB of 64 sensors for the places alone."""


def open_file(path: Path, *, tried: bool = True) -> h5py.File:
    """Open a file for reading: growing, closed, or left open by a killed recorder.

    Unless `tried`, a file at rest is first opened in a child process, once.

    Raises
    ------
    NotARecordingError
        If it is no HDF5 file, truncated, or damaged at its root.
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
    if not growing and not tried:
        trial.tried(path)
    try:
        if growing:
            _register_driver()
            return h5py.File(
                path,
                "r",
                driver=_DRIVER,
                libver="latest",
                swmr=True,
                locking=False,
                rdcc_nbytes=_CACHE,
                rdcc_nslots=_SLOTS,
            )
        if not superblock.is_open:
            with contextlib.suppress(OSError):  # open in this process as a SWMR reader: see below
                return h5py.File(path, "r", locking=False, rdcc_nbytes=_CACHE, rdcc_nslots=_SLOTS)
        # As a Python file object: HDF5 would share cached metadata with other readers in this
        # process, and return zeros instead of samples if one of them has not been refreshed.
        return h5py.File(source_of(path, superblock), "r", rdcc_nbytes=_CACHE, rdcc_nslots=_SLOTS)
    except (OSError, RuntimeError) as error:
        raise NotARecordingError(f"{path}: cannot be opened as HDF5: {error}") from error


def refresh(dataset: h5py.Dataset) -> None:
    """Read the metadata of a dataset again, because a writer may have changed it.

    Files at rest are not read again: if two readers in the process have the file open, HDF5 would
    lose the chunks of the dataset, and return zeros instead of rows.
    """
    if dataset.file.swmr_mode:
        dataset.refresh()


def source_of(path: Path, superblock: Superblock) -> ClearedFile | Path:
    """Return a source that HDF5 opens as a file at rest, even if a program is writing it."""
    return ClearedFile(path, superblock) if superblock.version == 3 else path


@cache
def _register_driver() -> None:
    h5py.register_driver(_DRIVER, _set_driver)


def _set_driver(access: Any, **_: object) -> None:  # noqa: ANN401 - h5py is untyped
    """Limit the attempts in a file access list."""
    access.set_fapl_sec2()
    limit = hdf5_function("H5Pset_metadata_read_attempts", ctypes.c_int64, ctypes.c_uint)
    if limit is not None:
        limit(access.id, READ_ATTEMPTS)
