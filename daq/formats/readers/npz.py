"""NumPy archives and MATLAB files: ``sampling_rate`` and one array of counts per sensor.

==================  ====================================================================
``sampling_rate``   in Hz, one number
any other name      a sensor: counts ``(n_samples, n_channels)``, or a vector for one channel
``start_time``      optional: UTC of the first sample, ISO 8601 or ``datetime64``
==================  ====================================================================

Channels are called 1, 2, 3 … unless a bench file names them. Without ``start_time`` a recording
starts at 1970-01-01T00:00:00Z. A row with NaN becomes a gap.
"""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from daq.errors import ImportFormatError, RecordingError
from daq.formats.foreign_sensor import ForeignSensor, finite_stretches
from daq.recording.storage.refusals import check_names, dataset

_LARGE = 1 << 28
_INFLATION = 100
"""Files larger than 256 MB that are packed more tightly than this hold no samples."""
RESERVED = ("sampling_rate", "start_time")
_PLAIN = {"char", "logical", "single", "double"} | {
    f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)
}
_FIRST, _LAST = np.datetime64("1678-01-01"), np.datetime64("2262-01-01")
"""Times that fit 64 bits in ns."""
_COMPRESSED = 15
"""Kind of a compressed element of a MATLAB file, miCOMPRESSED."""


def read_npz(path: Path, sampling_rate: float | None = None) -> tuple[ForeignSensor, ...]:
    """Read the sensors of a NumPy archive; ``sampling_rate`` (Hz) is used where it holds none.

    Raises
    ------
    ImportFormatError
        It is no such archive, or what it holds is not as described above.
    """
    try:
        _refuse_bombs(path)
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (ValueError, zipfile.BadZipFile, AttributeError, EOFError, MemoryError) as error:
        raise ImportFormatError(
            f"{path}: expected a NumPy archive (numpy.savez) of plain numbers; {error}"
        ) from error
    return _sensors(path, arrays, sampling_rate)


def _refuse_bombs(path: Path) -> None:
    """Refuse an archive that says more than it holds, before anything is allocated for it.

    Raises
    ------
    ValueError
        Naming the array.
    """
    total = 0
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            size = member.file_size
            total += size  # members may share their bytes
            _refuse_bomb(path, member.filename, total)
            if not member.filename.endswith(".npy"):
                raise ValueError(f"{member.filename}: not an array")
            if member.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
                raise ValueError(f"{member.filename}: packed otherwise than numpy does")
            with archive.open(member) as file:
                version = np.lib.format.read_magic(file)
                read = (
                    np.lib.format.read_array_header_1_0
                    if version == (1, 0)
                    else np.lib.format.read_array_header_2_0
                )
                shape, _, dtype = read(file)
                if not dtype.hasobject and math.prod(shape) * dtype.itemsize > size:
                    raise ValueError(
                        f"{member.filename}: an array of shape {shape} in {size} bytes"
                    )


def _refuse_bomb(path: Path, name: str, size: int) -> None:
    packed = path.stat().st_size
    if size > _LARGE and size > _INFLATION * packed:
        raise ValueError(f"{name}: {packed} bytes that become {size}")


def read_mat(path: Path, sampling_rate: float | None = None) -> tuple[ForeignSensor, ...]:
    """Read the sensors of a MATLAB file; as `read_npz`. Version 7.3 is read by h5py.

    Raises
    ------
    ImportFormatError
        It is no such file, or what it holds is not as described above.
    """
    from scipy.io import loadmat  # noqa: PLC0415 - takes long

    try:
        _refuse_mat_bombs(path)
        found = loadmat(path)
    except NotImplementedError:
        arrays = _mat73(path)
    except Exception as error:  # of any kind, on damaged files
        raise ImportFormatError(f"{path}: expected a MATLAB file; {error}") from error
    else:
        arrays = {name: np.asarray(array) for name, array in found.items() if name[:2] != "__"}
    return _sensors(path, {name: _upright(array) for name, array in arrays.items()}, sampling_rate)


def _refuse_mat_bombs(path: Path) -> None:
    """Refuse arrays that become far more than they are, or say that they are more than they hold.

    Raises
    ------
    ValueError
        Naming the array.
    """
    from scipy.io import whosmat  # noqa: PLC0415 - takes long

    held = _held(path)
    for name, shape, kind in whosmat(path, chars_as_strings=False):
        if kind not in _PLAIN:  # of a cell and others, what it says of its size is allocated
            raise ValueError(f"{name}: expected numbers, found {kind}")
        if math.prod(shape) > held:
            raise ValueError(f"{name}: an array of shape {shape} in {held} bytes")


def _held(path: Path) -> int:
    """Return how many bytes a file becomes; refuse arrays of version 5 that become far more.

    After a header of 128 bytes an element has its kind and length (MAT-File Format, "Data Element
    Format"). Its contents may lie about their size, so they are counted.

    Raises
    ------
    ValueError
        With the sizes.
    """
    total = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(128)
        order = {b"IM": "<", b"MI": ">"}.get(header[126:])
        if order is None:
            return total  # of another version
        tag = struct.Struct(f"{order}II")
        while len(head := file.read(tag.size)) == tag.size:
            kind, packed = tag.unpack(head)
            following = file.tell() + packed
            if kind == _COMPRESSED:
                total += _inflated(file, packed)
                _refuse_bomb(path, "array", total)
            file.seek(following)
    return total


def _inflated(file: BinaryIO, packed: int) -> int:
    """Return how many bytes so many bytes become; a lower bound where these are too many."""
    most = max(_LARGE, _INFLATION * packed)
    inflate, size = zlib.decompressobj(), 0
    while packed > 0 and size <= most and not inflate.eof:
        content = file.read(min(packed, 1 << 16))
        if not content:
            break
        packed -= len(content)
        size += len(inflate.decompress(content))  # 64 MB at most
    return size


def _mat73(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of numbers and the texts of version 7.3, which is HDF5."""
    import h5py  # noqa: PLC0415 - seldom needed

    arrays: dict[str, NDArray[Any]] = {}
    total = 0
    try:
        with h5py.File(path, "r") as file:
            check_names(file)
            for name in file:
                link = file.get(name, getlink=True)
                if name[0] == "#" or not isinstance(link, h5py.HardLink):  # no other file
                    continue
                found = file[name]
                kind = found.attrs.get("MATLAB_class", b"")
                if not isinstance(found, h5py.Dataset) or found.dtype.kind not in "iuf":
                    continue
                if "MATLAB_empty" not in found.attrs:
                    found = dataset(file, name)
                    total += found.size * found.dtype.itemsize
                    _refuse_bomb(path, name, total)
                    array = np.asarray(found).T  # MATLAB counts the first index fastest
                    text = kind in {b"char", "char"}
                    arrays[name] = np.array("".join(map(chr, array.ravel()))) if text else array
    except (OSError, RuntimeError, ValueError, KeyError, RecordingError) as error:
        raise ImportFormatError(
            f"{path}: expected a MATLAB file of version 7.3; {error}"
        ) from error
    return arrays


def _upright(array: NDArray[Any]) -> NDArray[Any]:
    """Return a row as a column: MATLAB has no vectors."""
    return array.T if array.ndim == 2 and array.shape[0] == 1 else array


def _sensors(
    path: Path, arrays: dict[str, NDArray[Any]], sampling_rate: float | None
) -> tuple[ForeignSensor, ...]:
    rate = float(_number(path, arrays["sampling_rate"])) if "sampling_rate" in arrays else None
    rate = rate or sampling_rate
    if rate is None or not rate > 0 or not math.isfinite(rate):
        raise ImportFormatError(
            f"{path}: expected a positive sampling_rate in Hz in it, "
            f"found {rate}; add it, or give --sampling-rate"
        )
    start_utc_ns = _instant_ns(path, arrays["start_time"]) if "start_time" in arrays else 0
    sensors = tuple(
        _sensor(path, name, array, rate, start_utc_ns)
        for name, array in arrays.items()
        if name not in RESERVED
    )
    if not sensors:
        raise ImportFormatError(f"{path}: no sensors in it; expected one array per sensor")
    return sensors


def _as_counts(array: NDArray[Any]) -> NDArray[Any]:
    """Return whole numbers as int32 where they fit; other numbers as they are.

    Scripts store counts as int64 or float64, which take longer to read and more of the disk.
    """
    if np.can_cast(array.dtype, np.int32) or array.size == 0:
        return array
    limits = np.iinfo(np.int32)
    if not (limits.min <= array.min() and array.max() <= limits.max):  # nor where one is NaN
        return array
    counts = array.astype(np.int32)
    return counts if np.array_equal(counts, array) else array


def _sensor(
    path: Path, name: str, array: NDArray[Any], rate: float, start_utc_ns: int
) -> ForeignSensor:
    if array.ndim == 1:
        array = array[:, np.newaxis]
    if array.ndim != 2 or array.shape[1] == 0 or array.dtype.kind not in "iuf":
        raise ImportFormatError(
            f"{path}: sensor {name!r}: expected numbers of shape (n_samples, n_channels), "
            f"found {array.dtype} of shape {array.shape}"
        )
    stretches = finite_stretches(_as_counts(array), start_utc_ns=start_utc_ns, sampling_rate=rate)
    if not stretches:
        raise ImportFormatError(f"{path}: sensor {name!r} holds no samples")
    channels = tuple(str(number) for number in range(1, array.shape[1] + 1))
    return ForeignSensor(name, channels, rate, stretches, str(path))


def _number(path: Path, array: NDArray[Any]) -> float:
    if array.size != 1 or array.dtype.kind not in "iuf":
        raise ImportFormatError(
            f"{path}: sampling_rate: expected one number in Hz, "
            f"found {array.dtype} of shape {array.shape}"
        )
    return float(array.reshape(()))


def _instant_ns(path: Path, array: NDArray[Any]) -> int:
    text = str(array.reshape(()).astype(str)).removesuffix("Z").removesuffix("+00:00")
    try:
        day, found = (
            np.array(each, dtype) for each, dtype in ((text[:10], "M8[D]"), (text, "M8[ns]"))
        )
    except ValueError:
        day = found = np.array("NaT", "M8[ns]")
    if text[4:5] != "-" or not _FIRST < day < _LAST:  # a number would be a year
        raise ImportFormatError(
            f"{path}: start_time: expected one UTC time as in 2026-11-21T03:00:00, found {array}"
        )
    return int(found.astype(np.int64))
