"""Refuses files with contents that recordings never have.

These are links, external storage, objects, and impossible lengths. A file must not make its reader
follow a link, open another file, load a filter, or allocate more memory than the file can fill.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np

from daq.errors import NotARecordingError, RecordingError
from daq.recording.storage.packing import PIPELINE, check_chunks

MAX_CHUNK = 1 << 28
"""Maximum size of a chunk in bytes."""
_MAX_INFLATION = 1100
"""Maximum ratio of inflated to deflated size: 1032, and a margin for headers."""
_DAMAGE = (AttributeError, IndexError, KeyError, MemoryError, OSError, RuntimeError, TypeError)


@contextlib.contextmanager
def damage_named(path: Path) -> Iterator[None]:
    """Convert errors of h5py on a damaged file to NotARecordingError."""
    try:
        yield
    except RecordingError:
        raise
    except (*_DAMAGE, ValueError, OverflowError) as error:
        reason = str(error) or type(error).__name__
        raise NotARecordingError(f"{path}: the recording is damaged: {reason}") from error


def member(group: h5py.Group, name: str) -> Any:  # noqa: ANN401 - h5py is untyped
    """Return a group or dataset stored in the file itself."""
    check_names(group)
    if "/" in name or name in {"", ".", ".."}:
        raise NotARecordingError(f"{_place(group, name)}: not a name")
    link = group.get(name, getlink=True)
    if link is None:
        raise KeyError(f"{group.name.rstrip('/')}/{name} is missing")
    if not isinstance(link, h5py.HardLink):
        raise NotARecordingError(
            f"{_place(group, name)}: a link; a recording has none, and it is not followed"
        )
    found = group[name]
    if isinstance(found, h5py.Group):
        check_names(found)
    return found


def check_names(group: h5py.Group) -> None:
    """Refuse a group whose names are packed: HDF5 inflates them however many they become.

    Raises
    ------
    NotARecordingError
    """
    count = hdf5_function("H5Pget_nfilters", ctypes.c_int64)
    created = group["/" if group.name == "/" else "."].id.get_create_plist()  # not of the file
    if count is not None and count(created.id):
        raise NotARecordingError(f"{group.file.filename}: {group.name}: its names are packed")


@cache
def hdf5_function(name: str, *arguments: Any) -> Callable[..., int] | None:  # noqa: ANN401 - of ctypes
    """Return a function of the HDF5 library loaded by h5py that h5py has not."""
    try:
        function: Any = getattr(ctypes.CDLL(h5py.h5p.__file__), name)
    except (AttributeError, OSError):  # Windows does not search a library's dependencies
        return None
    function.argtypes, function.restype = arguments, ctypes.c_int
    return cast("Callable[..., int]", function)


def _place(group: h5py.Group, name: str) -> str:
    return f"{group.file.filename}: {group.name.rstrip('/')}/{name}"


def dataset(
    group: h5py.Group, name: str, dtype: np.dtype[Any] | None = None, *, in_parts: bool = False
) -> h5py.Dataset:
    """Return a dataset of numbers stored in the file itself.

    Parameters
    ----------
    group : h5py.Group
    name : str
    dtype : dtype, optional
        Expected.
    in_parts : bool, optional
        Whether who reads it checks its chunks.

    Raises
    ------
    NotARecordingError
        If it is a link, is stored elsewhere, has other filters or another type than expected, is
        longer than the file can hold, or has chunks that inflate to more than they hold.
    """
    found = member(group, name)
    if not isinstance(found, h5py.Dataset):
        raise NotARecordingError(f"{_place(group, name)}: not a dataset")
    check_stored(found, in_parts=in_parts)
    if fault := _fault(found, dtype):
        raise NotARecordingError(f"{_place(group, name)}: {fault}")
    return found


def check_stored(found: h5py.Dataset, *, in_parts: bool = False) -> None:
    """Check how a dataset is stored, whatever its type.

    Raises
    ------
    NotARecordingError, InflationError
        As `dataset` does.
    """
    if fault := _fault_of_storage(found):
        raise NotARecordingError(f"{found.file.filename}: {found.name}: {fault}")
    check_length(found)
    if found.chunks and not in_parts:
        check_chunks(found)


def check_all(group: h5py.Group) -> None:
    """Check all that is below a group, as `dataset` does.

    Raises
    ------
    NotARecordingError, OSError
        Naming the first dataset that is none of ours.
    """
    check_names(group)
    for name in group:
        if isinstance(found := member(group, name), h5py.Group):
            check_all(found)
        else:
            dataset(group, name)


def _fault_of_storage(found: h5py.Dataset) -> str:
    created = found.id.get_create_plist()
    if created.get_external_count() or found.is_virtual:
        return "stored in other files; they are not opened"
    filters = [created.get_filter(number)[0] for number in range(created.get_nfilters())]
    if filters != [each for each in PIPELINE if each in filters]:  # deflated twice is a million
        return f"filters {filters}; expected gzip"
    if found.chunks and math.prod(found.chunks) * found.dtype.itemsize > MAX_CHUNK:
        return f"chunks of shape {found.chunks}; expected smaller ones"
    return ""


def _fault(found: h5py.Dataset, dtype: np.dtype[Any] | None) -> str:
    found_type = found.dtype
    kinds = {found_type[n].kind for n in found_type.names} if found_type.names else found_type.kind
    if found_type.hasobject or not set(kinds) <= set("iufS"):
        return f"of type {found_type}; expected numbers"
    if dtype is not None and found_type != dtype:
        return f"of type {found_type}; expected {dtype}"
    return ""


def check_length(found: h5py.Dataset) -> None:
    """Check the length of a dataset.

    Raises
    ------
    NotARecordingError
        If it is longer than its file can hold.
    """
    size, chunks = found.dtype.itemsize, found.chunks
    n_bytes = math.prod(found.shape) * size
    of_chunk = math.prod(chunks) * size if chunks else 0
    if n_bytes <= of_chunk:  # of most tables
        return
    held = _n_bytes(found.file)
    if n_bytes > held * (_MAX_INFLATION if found.compression else 1) + of_chunk:
        raise NotARecordingError(
            f"{found.file.filename}: {found.name}: {found.shape[0]} rows, more than a file of"
            f" {held} bytes can hold"
        )


def _n_bytes(file: h5py.File) -> int:
    if file.driver in {"core", "fileobj"}:
        return int(file.id.get_filesize())
    return os.fstat(file.id.get_vfd_handle()).st_size  # the current size of a growing file


def check_counts(counts: np.ndarray[Any, np.dtype[Any]], n_sensors: int) -> None:
    """Check type, shape and range of ``/committed``.

    Raises
    ------
    ValueError
        If one of them is wrong.
    """
    if counts.shape != (n_sensors + 1, 3) or counts.dtype != np.int64:
        raise ValueError(
            f"/committed is {counts.dtype} of shape {counts.shape}; expected int64 of shape"
            f" {(n_sensors + 1, 3)}"
        )
    if counts.min() < 0:
        raise ValueError(f"/committed counts {counts.min()} rows; expected none below 0")


def text(attributes: h5py.AttributeManager, name: str) -> str:
    """Return an attribute; raise TypeError if it is no text."""
    found = attributes[name]
    if isinstance(found, bytes):  # of fixed length
        found = found.decode()
    if not isinstance(found, str):
        raise TypeError(f"attribute {name} is {type(found).__name__}; expected a text")
    return found


def number(attributes: h5py.AttributeManager, name: str) -> float:
    """Return an attribute; raise TypeError if it is no finite number."""
    found = attributes[name]
    if not isinstance(found, (float, int, np.floating, np.integer)) or not np.isfinite(found):
        raise TypeError(f"attribute {name} is {found!r}; expected a number")
    return found  # type: ignore[return-value]  # integers stay exact
