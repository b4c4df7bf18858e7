"""Files of other programs: how they are told from recordings, and the command that takes them."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

SUFFIXES = frozenset(
    f".{name}"
    for name in (
        *("csv", "tsv", "txt", "lvm", "npy", "npz", "mat", "wav", "tdms", "uff", "unv"),
        *("mseed", "miniseed", "msd", "seed", "sac", "gcf", "gse", "gse2", "sg2", "sgy", "segy"),
        *("zip", "gz"),
    )
)
"""Of files that are named like a bench file by mistake."""
OWN = frozenset({".h5", ".hdf5", ".toml"})
"""Suffixes of recordings and bench files."""
_HDF5 = b"\x89HDF\r\n\x1a\n"


def is_foreign(path: Path) -> bool:
    """Whether a file is neither a recording nor a bench file, by its name and first bytes."""
    if path.suffix.lower() in OWN or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_HDF5)) != _HDF5


def import_command(paths: Sequence[Path], *options: str) -> str:
    """Return the command line that converts files of other programs into a recording."""
    words = [*map(str, paths), *options, "--out", f"{paths[0].stem}.h5"]
    return f"huddle import {shlex.join(words)}"
