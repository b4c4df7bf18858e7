"""Curves and samples in files of other programs: CSV, Parquet, netCDF, Zarr, MAT, NumPy, UFF 58.

A tidy table has one row for each method, channel and frequency. All densities are one-sided, in
unit²/Hz; the unit is in a column, an attribute or a variable of every file. What made the estimate
(program, settings, span of time, recordings with their SHA-256) is in every file too, for CSV in
the file of metadata that CSV on the Web puts beside it.
"""

from __future__ import annotations

import errno
import io
import json
import math
import os
import shutil
import struct
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import h5py
import numpy as np

from daq.errors import RecordingError
from daq.recording.reader import Recording
from daq.recording.storage.refusals import check_names, check_stored, member
from daq.results.band_summary import known_range
from daq.whole_file import replaced, write_whole, wrong_content
from tui.notebook.tables import to_frame, to_xarray
from tui.output.csv_text import csv_text, write_metadata
from tui.output.curves import CURVES
from tui.output.extras import load

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import xarray as xr

    from daq.estimation.snapshot import Snapshot
    from daq.formats.miniseed_export import Exported

    Said: TypeAlias = dict[str, str]


MINISEED = "mseed"
_COLUMNS = (*(curve.name for curve in CURVES), "flags")
_FIELDS = (*(curve.field for curve in CURVES), "flags")
_PSD = 9
_DOUBLE = 4
_DIRECTIONS = {"X": 1, "Y": 2, "Z": 3, "E": 1, "N": 2, "1": 1, "2": 2, "3": 3}


def _csv(snapshot: Snapshot, said: Said) -> bytes:
    del said  # in the metadata beside it
    header = ("method", "sensor", "channel", "unit", "frequency_hz", "data_psd", *_COLUMNS)
    return csv_text(header, _rows(snapshot)).encode()


def _rows(snapshot: Snapshot) -> Iterator[tuple[object, ...]]:
    for method, noise in snapshot.results.items():
        for column, label in enumerate(snapshot.channels):
            values = [snapshot.frequency, snapshot.data_psd[:, column]]
            values += [getattr(noise, field)[:, column] for field in _FIELDS]
            for row in np.stack(values, axis=1).tolist():
                numbers = [None if value != value else value for value in row]  # noqa: PLR0124 - NaN
                yield (method, label.sensor, label.channel, label.unit, *numbers[:-1], int(row[-1]))


def _parquet(snapshot: Snapshot, said: Said) -> bytes:
    arrow, parquet = load("pyarrow"), load("pyarrow.parquet")
    frame = to_frame(snapshot)
    units = {(label.sensor, label.channel): label.unit for label in snapshot.channels}
    keys = zip(frame["sensor"], frame["channel"], strict=True)
    frame.insert(3, "unit", [units[key] for key in keys])
    frame = frame.rename(columns={"frequency": "frequency_hz"})
    table = arrow.Table.from_pandas(frame, preserve_index=False)
    content = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata({**table.schema.metadata, **said}), content)
    return content.getvalue()


def _netcdf(snapshot: Snapshot, said: Said) -> bytes:
    return _netcdf_bytes(to_xarray(snapshot, said))


def _netcdf_bytes(dataset: xr.Dataset) -> bytes:
    load("h5netcdf")
    return bytes(dataset.to_netcdf(engine="h5netcdf"))


def _write_zarr(dataset: xr.Dataset, path: Path) -> None:
    """Write a folder; a Zarr folder of this name is replaced, and no other."""
    load("zarr")
    named = dataset
    for name, coordinate in dataset.coords.items():
        if coordinate.dtype.kind == "U":  # which no version of the format specifies at a length
            named = named.assign_coords({name: coordinate.astype(object)})
    with replaced(path) as part:
        named.to_zarr(part, mode="w", consolidated=True, zarr_format=2)
        if not load("xarray").open_dataset(part, engine="zarr", consolidated=True).equals(dataset):
            raise wrong_content(path)
        if (path / ".zgroup").is_file():
            shutil.rmtree(path)


def write_dataset(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a Dataset as netCDF, or as Zarr by the suffix; complete when it has its name."""
    out = Path(path)
    if out.suffix == ".zarr":
        _write_zarr(dataset, out)
    else:
        write_whole(out, _netcdf_bytes(dataset))


def _arrays(snapshot: Snapshot) -> dict[str, Any]:
    found: dict[str, Any] = {
        "frequency_hz": snapshot.frequency,
        "sensors": [label.sensor for label in snapshot.channels],
        "channels": [label.channel for label in snapshot.channels],
        "units": [f"({label.unit})²/Hz" for label in snapshot.channels],
        "data_psd": snapshot.data_psd,
    }
    for method, noise in snapshot.results.items():
        for column, field in zip(_COLUMNS, _FIELDS, strict=True):
            found[f"{method.replace('-', '_')}_{column}"] = getattr(noise, field)
    return found


def _mat(snapshot: Snapshot, said: Said) -> bytes:
    from scipy.io import savemat  # noqa: PLC0415 - takes long

    found = {
        name: np.array(value, dtype=object) if isinstance(value, list) else value
        for name, value in (_arrays(snapshot) | said).items()
    }
    content = io.BytesIO()
    savemat(
        cast("Any", content),  # or a file, which its types lack
        found,
        appendmat=False,
        do_compression=True,
        oned_as="column",
        long_field_names=True,
    )
    return content.getvalue()


def _npz(snapshot: Snapshot, said: Said) -> bytes:
    arrays: dict[str, Any] = {
        name: np.asarray(value) for name, value in (_arrays(snapshot) | said).items()
    }
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()


def _uff(snapshot: Snapshot, said: Said) -> bytes:
    load("pyuff")
    with TemporaryDirectory(prefix="huddle-") as folder:  # the library takes names of files only
        path = Path(folder) / "curves.uff"
        _write_uff(snapshot, path, said)
        return path.read_bytes()


def _write_uff(snapshot: Snapshot, path: Path, said: Said) -> None:
    pyuff = load("pyuff")
    file = pyuff.UFF(str(path))
    nodes = {name: number for number, name in enumerate(snapshot.sensor_names, start=1)}
    low, high = known_range(snapshot)  # the library reads NaN as zero
    known = (snapshot.frequency >= low) & (snapshot.frequency <= high)
    frequency = snapshot.frequency[known]
    digest = next((each["sha256"] for each in json.loads(said["recordings"])), None)
    span = f"{said['time_coverage_start'][:23]} to {said['time_coverage_end'][:23]}"
    even = np.allclose(np.diff(frequency), frequency[1] - frequency[0])
    for column, label in enumerate(snapshot.channels):
        curves = {"data": snapshot.data_psd[:, column]}
        for method, noise in snapshot.results.items():
            for each in CURVES:
                if each.is_density:
                    curves[f"{method} {each.name}"] = getattr(noise, each.field)[:, column]
        for name, values in curves.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                file.write_sets(
                    pyuff.prepare_58(
                        binary=1,
                        func_type=_PSD,
                        id1=f"{label.name} {name}"[:80],
                        id2=f"one-sided, ({_ascii(label.unit)})^2/Hz"[:80],
                        id3=f"{said['source']}; {span}"[:80],
                        id4=f"SHA-256 {digest}"[:80] if digest else "NONE",
                        id5=snapshot.caveats.nouns().upper() or "NONE",
                        rsp_ent_name=_ascii(label.sensor)[:10],
                        rsp_node=nodes[label.sensor],
                        rsp_dir=_DIRECTIONS.get(label.channel[-1:].upper(), 0),
                        ref_node=nodes[label.sensor],
                        ref_dir=_DIRECTIONS.get(label.channel[-1:].upper(), 0),
                        ord_data_type=_DOUBLE,
                        abscissa_spacing=int(even),
                        abscissa_min=float(frequency[0]),
                        abscissa_inc=float(frequency[1] - frequency[0]) if even else 0.0,
                        num_pts=len(frequency),
                        abscissa_spec_data_type=18,
                        abscissa_axis_units_lab="Hz",
                        ordinate_spec_data_type=0,
                        ordinate_axis_units_lab=f"({_ascii(label.unit)})^2/Hz"[:20],
                        orddenom_spec_data_type=0,
                        z_axis_spec_data_type=0,
                        x=frequency,
                        data=np.asarray(values[known], dtype=np.float64),
                    ),
                    "add",
                )


def _ascii(text: str) -> str:
    return text.replace("²", "^2").replace("µ", "u").encode("ascii", "replace").decode()


WRITERS: dict[str, tuple[str, Callable[[Snapshot, Said], bytes | xr.Dataset]]] = {
    "csv": (".csv", _csv),
    "parquet": (".parquet", _parquet),
    "netcdf": (".nc", _netcdf),
    "zarr": (".zarr", to_xarray),
    "mat": (".mat", _mat),
    "npz": (".npz", _npz),
    "uff58": (".uff", _uff),
}
"""Suffix and content of each format; of a folder, its Dataset."""


def write_curves(snapshot: Snapshot, kind: str, path: Path, said: Said) -> None:
    """Write all curves; the file has its name when it is complete.

    Parameters
    ----------
    snapshot : Snapshot
    kind : str
        One of `WRITERS`.
    path : Path
    said : dict of str to str
        What made the estimate, as `tui.output.json_document.provenance` has it.

    Raises
    ------
    MissingPackageError
        A package is not installed.
    OSError
        The file cannot be written.
    """
    content = WRITERS[kind][1](snapshot, said)
    if not isinstance(content, bytes):
        _write_zarr(content, path)
        return
    write_whole(path, content)
    if kind == "csv":
        write_metadata(path, said)


def write_samples(file: Path, out: Path) -> tuple[Exported, Path]:
    """Write all samples of a recording as miniSEED, with StationXML beside it.

    Both files have their names when they are complete.

    Parameters
    ----------
    file, out : Path

    Returns
    -------
    written : Exported
    station : Path
        The StationXML file.

    Raises
    ------
    MissingPackageError
        ObsPy is not installed.
    RecordingError, OSError
        The recording cannot be read, or a file not be written.
    """
    from daq.formats.miniseed_export import export_miniseed  # noqa: PLC0415 - ObsPy is an extra

    station = out.with_suffix(".xml")
    with Recording.open(file) as recording:
        return export_miniseed(recording, out, station), station


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
    except (RecordingError, OSError, ValueError, KeyError, TypeError) as error:
        if not path.exists():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path)) from None
        text = (
            f"{path}: no netCDF or Zarr of huddle (a recording: huddle.open), or damaged: {error}"
        )
        raise OSError(text) from error
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
