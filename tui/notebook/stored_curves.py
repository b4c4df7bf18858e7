"""Reads netCDF and Zarr files of curves, by whomever: what they say of themselves is checked first.

The libraries inflate as far as a file goes, follow links, and allocate what it says that it holds.
"""

from __future__ import annotations

import json
import math
import struct
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from daq.errors import RecordingError
from daq.recording.storage.refusals import check_names, check_stored, member
from tui.output.extras import load

if TYPE_CHECKING:
    from pathlib import Path

    import xarray as xr

_AT_LEAST, _MOST = 1 << 28, 100
"""Bytes that any folder of Zarr may become, and each of its bytes."""
_TEXTS = 1 << 20
"""Bytes of a chunk of texts, at most."""
_BLOSC = struct.Struct("<4BIII")
"""Versions, flags, size of an element; sizes of the content, of a block, and packed."""


def loaded(path: Path) -> xr.Dataset:
    """Return what `write_dataset` wrote.

    Raises
    ------
    OSError
        The file is missing, is neither netCDF nor Zarr, or is none that `write_dataset` writes.
    """
    engine, check, options = "h5netcdf", _check_netcdf, {}
    if path.suffix == ".zarr":
        engine, check, options = "zarr", _check_zarr, {"consolidated": True, "zarr_format": 2}
    load(engine)
    try:
        check(path)
    except (RecordingError, ValueError, KeyError, TypeError) as error:
        raise OSError(f"{path}: not written by huddle, or damaged: {error}") from error
    found: xr.Dataset = load("xarray").load_dataset(path, engine=engine, **options)
    return found


def _check_netcdf(path: Path) -> None:
    with h5py.File(path, "r") as file:
        check_names(file)
        for name in file:
            if not isinstance(found := member(file, name), h5py.Dataset):
                raise ValueError(f"{name}: a group")  # noqa: TRY004 - of the file's contents
            check_stored(found)


def _check_zarr(path: Path) -> None:
    """Check the metadata of all arrays, and the heads of all chunks (Zarr 2, Blosc 1)."""
    left = max(_AT_LEAST, _MOST * sum(each.stat().st_size for each in path.rglob("*")))
    described = json.loads((path / ".zmetadata").read_text(encoding="utf-8"))["metadata"]
    for key, about in described.items():
        name, _, kind = key.rpartition("/")
        if kind != ".zarray":
            continue
        if "/" in name or name.startswith("."):
            raise ValueError(f"{name}: expected an array of the folder itself")
        is_text = about["dtype"] == "|O"
        if about["filters"] != ([{"id": "vlen-utf8"}] if is_text else None):
            raise ValueError(f"{name}: filters {about['filters']}; expected none")
        if about["compressor"]["id"] != "blosc":
            raise ValueError(f"{name}: packed by {about['compressor']}; expected blosc")
        n_values = math.prod(about["chunks"])
        most = _TEXTS if is_text else n_values * np.dtype(about["dtype"]).itemsize
        left -= max(most, math.prod(about["shape"]) * np.dtype(about["dtype"]).itemsize)
        if left < 0:
            raise ValueError(f"{name}: of shape {about['shape']}, more than its files can hold")
        for chunk in (path / name).iterdir():
            if not chunk.name.startswith("."):
                _check_chunk(chunk, most, n_values if is_text else None)


def _check_chunk(chunk: Path, most: int, n_texts: int | None) -> None:
    """Check the size of what a chunk holds, and of how many texts it says that it is."""
    content = chunk.read_bytes()
    n_bytes = _BLOSC.unpack_from(content)[4]
    if n_bytes > most:
        raise ValueError(f"{chunk}: becomes {n_bytes} bytes; expected {most}")
    if n_texts is not None:
        from numcodecs import blosc  # noqa: PLC0415 - an extra

        decoded: Any = blosc.decompress(content)
        if int.from_bytes(decoded[:4], "little") > n_texts:
            raise ValueError(f"{chunk}: more than {n_texts} texts")
