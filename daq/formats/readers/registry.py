"""Which reader reads a file: by its suffix, or else by what it begins with."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, TypeAlias

from daq.formats.readers.delimited.reader import read_delimited
from daq.formats.readers.miniseed import is_miniseed, miniseed_parts
from daq.formats.readers.npz import read_mat, read_npz
from daq.formats.readers.tdms import tdms_parts
from daq.formats.readers.vibration import read_uff, read_wav
from daq.formats.readers.waveforms import waveform_parts
from daq.formats.traces import FilePart, traces_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from daq.formats.foreign_sensor import ForeignSensor
    from daq.formats.traces import Part, Trace

    WholeFile: TypeAlias = Callable[[Path, float | None], Sequence[ForeignSensor]]

_UNIVERSAL = frozenset({".uff", ".unv", ".uf58", ".58"})
_BY_SUFFIX: dict[str, WholeFile] = {
    ".wav": read_wav,
    ".npz": read_npz,
    ".mat": read_mat,
    ".csv": read_delimited,
    ".tsv": read_delimited,
    ".txt": read_delimited,
    ".lvm": read_delimited,
}


def parts_of(path: Path, sampling_rate: float | None = None) -> Iterator[Part]:
    """Yield the parts of a file; ``sampling_rate`` (Hz) is used where the file has none.

    Raises
    ------
    ImportFormatError
        It cannot be read.
    """
    whole = _BY_SUFFIX.get(path.suffix.lower())
    if whole is not None:
        yield FilePart(path, partial(_load, whole, sampling_rate))
    elif path.suffix.lower() in _UNIVERSAL:
        yield FilePart(path, read_uff)
    elif path.suffix.lower() == ".tdms":
        yield from tdms_parts(path, sampling_rate)
    elif is_miniseed(path):
        yield from miniseed_parts(path)
    else:
        yield from waveform_parts(path)


def _load(read: WholeFile, sampling_rate: float | None, path: Path) -> list[Trace]:
    return traces_of(read(path, sampling_rate))
