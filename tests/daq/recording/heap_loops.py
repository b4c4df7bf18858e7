"""Makes recordings of version 1 whose global heap sends HDF5 around in a circle."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import h5py
import numpy as np

if TYPE_CHECKING:
    from pathlib import Path


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


def with_heap_loop(path: Path) -> None:
    """Set the size of the free space in every collection of the global heap to zero.

    HDF5 file format specification, III.E: a header of 16 bytes, then objects, each with a header of
    16 bytes (index, references, reserved, size) and its contents up to a multiple of 8 bytes. The
    object with index 0 is the free space; its size includes its header.
    """
    with_variable_strings(path)
    content = bytearray(path.read_bytes())
    begin = content.find(b"GCOL")
    while begin >= 0:
        (length,) = struct.unpack_from("<Q", content, begin + 8)
        at = begin + 16
        while at + 16 <= begin + length:
            index, _, _, size = struct.unpack_from("<HHIQ", content, at)
            if index == 0:
                struct.pack_into("<Q", content, at + 8, 0)
                break
            at += 16 + -(-size // 8) * 8
        begin = content.find(b"GCOL", begin + 4)
    path.write_bytes(content)
