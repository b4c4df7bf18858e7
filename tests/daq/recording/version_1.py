"""Makes recordings of version 1, whose texts are in a global heap, and damages the heap."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from daq.recording.chunks.manifest import MANIFEST, RESULTS_MANIFEST


def with_variable_strings(path: Path) -> None:
    """Give the attributes of a recording strings of variable length, as version 1 had them."""

    def change(_: str, found: h5py.Group | h5py.Dataset) -> None:
        for name, value in list(found.attrs.items()):
            if isinstance(value, bytes):
                found.attrs[name] = value.decode()
            elif isinstance(value, np.ndarray) and value.dtype.kind == "S":
                found.attrs[name] = [text.decode() for text in value]

    with h5py.File(path, "r+") as file:
        change("", file)
        file.visititems(change)


def as_version_1(path: Path) -> None:
    """Make a recording of version 1: strings of variable length, and no manifest."""
    with_variable_strings(path)
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 1
        del file[MANIFEST], file[RESULTS_MANIFEST]
        file["checksums"][-1, 0] = _description_crc32(file)


def _description_crc32(file: h5py.File) -> int:
    """Return the checksum of the file's attributes, which include the version."""
    names = ["format", "format_version", "run_id", "created", "created_utc_ns"]
    names += ["created_monotonic_ns", "software", "bench", "operator", "location"]
    values = [file.attrs[name] for name in names]
    pairs = [[n, v if isinstance(v, str) else v.item()] for n, v in zip(names, values, strict=True)]
    sensors = list(file["committed"].attrs["sensors"])
    return zlib.crc32((json.dumps(pairs) + json.dumps(sensors)).encode())


def heap_headers(content: bytes | bytearray) -> NDArray[np.bool_]:
    """Return which bytes of a file are headers of a global heap, or of an object in it.

    HDF5 file format specification, III.E: a header of 16 bytes, then objects, each with a header of
    16 bytes (index, references, reserved, size) and its contents up to a multiple of 8 bytes. The
    object with index 0 is the free space; its size includes its header.
    """
    found = np.zeros(len(content), bool)
    for at, _ in _heap_objects(content):
        found[at : at + 16] = True
    begin = content.find(b"GCOL")
    while begin >= 0:
        found[begin : begin + 16] = True
        begin = content.find(b"GCOL", begin + 4)
    return found


def _heap_objects(content: bytes | bytearray) -> Iterator[tuple[int, int]]:
    """Yield the place of each object of the global heap, and its index."""
    begin = content.find(b"GCOL")
    while begin >= 0:
        (length,) = struct.unpack_from("<Q", content, begin + 8)
        at, index = begin + 16, 1
        while index and at + 16 <= begin + length:
            index, _, _, size = struct.unpack_from("<HHIQ", content, at)
            yield at, index
            at += 16 + -(-size // 8) * 8
        begin = content.find(b"GCOL", begin + 4)


def with_heap_loop(path: Path) -> None:
    """Set the size of the free space in every collection of the global heap to zero."""
    with_variable_strings(path)
    content = bytearray(path.read_bytes())
    for at, index in list(_heap_objects(content)):
        if index == 0:
            struct.pack_into("<Q", content, at + 8, 0)
    path.write_bytes(content)
