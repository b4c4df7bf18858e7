"""Curves and samples in files of other programs: CSV, Parquet, netCDF, Zarr, MAT, NumPy, UFF 58.

A tidy table has one row for each method, channel and frequency. All densities are one-sided, in
unit²/Hz; the unit is in a column, an attribute or a variable of every file. What made the estimate
(program, settings, span of time, recordings with their SHA-256) is in every file too, for CSV in
the file of metadata that CSV on the Web puts beside it.
"""

from __future__ import annotations

import json
import os
import shutil
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from daq.recording.reader import Recording
from tui.notebook.tables import to_frame, to_xarray
from tui.output.csv_text import csv_text, write_metadata
from tui.output.extras import load

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import xarray as xr

    from daq.estimation.snapshot import Snapshot
    from daq.formats.miniseed_export import Exported

    Said: TypeAlias = dict[str, str]

MINISEED = "mseed"
_COLUMNS = ("noise_psd", "noise_low", "noise_high", "cov", "flags")
_FIELDS = ("noise_psd", "low", "high", "cov", "flags")
_PSD = 9
_DOUBLE = 4
_DIRECTIONS = {"X": 1, "Y": 2, "Z": 3, "E": 1, "N": 2, "1": 1, "2": 2, "3": 3}


def _csv(snapshot: Snapshot, path: Path, said: Said) -> None:
    del said  # in the metadata beside it
    header = ("method", "sensor", "channel", "unit", "frequency_hz", "data_psd", *_COLUMNS)
    path.write_text(csv_text(header, _rows(snapshot)), encoding="utf-8")


def _rows(snapshot: Snapshot) -> Iterator[tuple[object, ...]]:
    for method, noise in snapshot.results.items():
        for column, label in enumerate(snapshot.channels):
            values = [snapshot.frequency, snapshot.data_psd[:, column]]
            values += [getattr(noise, field)[:, column] for field in _FIELDS]
            for row in np.stack(values, axis=1).tolist():
                numbers = [None if value != value else value for value in row]  # noqa: PLR0124 - NaN
                yield (method, label.sensor, label.channel, label.unit, *numbers[:-1], int(row[-1]))


def _parquet(snapshot: Snapshot, path: Path, said: Said) -> None:
    arrow, parquet = load("pyarrow"), load("pyarrow.parquet")
    frame = to_frame(snapshot)
    units = {(label.sensor, label.channel): label.unit for label in snapshot.channels}
    keys = zip(frame["sensor"], frame["channel"], strict=True)
    frame.insert(3, "unit", [units[key] for key in keys])
    frame = frame.rename(columns={"frequency": "frequency_hz"})
    table = arrow.Table.from_pandas(frame, preserve_index=False)
    parquet.write_table(table.replace_schema_metadata({**table.schema.metadata, **said}), path)


def _netcdf(snapshot: Snapshot, path: Path, said: Said) -> None:
    load("h5netcdf")
    to_xarray(snapshot, said).to_netcdf(path, engine="h5netcdf")


def _zarr(snapshot: Snapshot, path: Path, said: Said) -> None:
    _write_zarr(to_xarray(snapshot, said), path)


def _write_zarr(dataset: xr.Dataset, path: Path) -> None:
    load("zarr")
    for name, coordinate in dataset.coords.items():
        if coordinate.dtype.kind == "U":  # which no version of the format specifies at a length
            dataset = dataset.assign_coords({name: coordinate.astype(object)})
    dataset.to_zarr(path, mode="w", consolidated=True, zarr_format=2)


def write_dataset(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a Dataset as netCDF, or as Zarr by the suffix; complete when it has its name."""
    out = Path(path)
    part = out.with_name(f".{out.name}.part")
    try:
        if out.suffix == ".zarr":
            _write_zarr(dataset, part)
        else:
            load("h5netcdf")
            dataset.to_netcdf(part, engine="h5netcdf")
        _named(part, out)
    finally:
        _removed(part)


def _named(part: Path, path: Path) -> None:
    """Give a file or folder its name; a Zarr folder of this name is replaced, and no other."""
    if part.is_dir():
        if (path / ".zgroup").is_file():
            shutil.rmtree(path)
    else:
        with part.open("rb") as file:
            os.fsync(file.fileno())
    part.replace(path)


def _removed(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part)
    else:
        part.unlink(missing_ok=True)


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


def _mat(snapshot: Snapshot, path: Path, said: Said) -> None:
    from scipy.io import savemat  # noqa: PLC0415 - takes long

    found = {
        name: np.array(value, dtype=object) if isinstance(value, list) else value
        for name, value in (_arrays(snapshot) | said).items()
    }
    savemat(
        str(path),
        found,
        appendmat=False,
        do_compression=True,
        oned_as="column",
        long_field_names=True,
    )


def _npz(snapshot: Snapshot, path: Path, said: Said) -> None:
    arrays: dict[str, Any] = {
        name: np.asarray(value) for name, value in (_arrays(snapshot) | said).items()
    }
    with path.open("wb") as file:
        np.savez(file, **arrays)


def _uff(snapshot: Snapshot, path: Path, said: Said) -> None:
    pyuff = load("pyuff")
    path.unlink(missing_ok=True)
    file = pyuff.UFF(str(path))
    nodes = {name: number for number, name in enumerate(snapshot.sensor_names, start=1)}
    frequency = snapshot.frequency
    digest = next((each["sha256"] for each in json.loads(said["recordings"])), None)
    span = f"{said['time_coverage_start'][:23]} to {said['time_coverage_end'][:23]}"
    even = np.allclose(np.diff(frequency), frequency[1] - frequency[0])
    for column, label in enumerate(snapshot.channels):
        curves = {"data": snapshot.data_psd[:, column]}
        for method, noise in snapshot.results.items():
            for name, field in zip(_COLUMNS[:3], _FIELDS[:3], strict=True):
                curves[f"{method} {name}"] = getattr(noise, field)[:, column]
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
                        id5="SIMULATED SENSORS" if said["simulated"] == "true" else "NONE",
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
                        data=np.asarray(values, dtype=np.float64),
                    ),
                    "add",
                )


def _ascii(text: str) -> str:
    return text.replace("²", "^2").replace("µ", "u").encode("ascii", "replace").decode()


WRITERS: dict[str, tuple[str, Callable[[Snapshot, Path, Said], None]]] = {
    "csv": (".csv", _csv),
    "parquet": (".parquet", _parquet),
    "netcdf": (".nc", _netcdf),
    "zarr": (".zarr", _zarr),
    "mat": (".mat", _mat),
    "npz": (".npz", _npz),
    "uff58": (".uff", _uff),
}
"""Suffix and writer of each format."""


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
    part = path.with_name(f".{path.name}.part")
    try:
        WRITERS[kind][1](snapshot, part, said)
        _named(part, path)
        if kind == "csv":
            write_metadata(path, said)
    finally:
        _removed(part)


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
    parts = [path.with_name(f".{path.name}.part") for path in (out, station)]
    try:
        with Recording.open(file) as recording:
            written = export_miniseed(recording, *parts)
        for part, path in zip(parts, (out, station), strict=True):
            part.replace(path)
    finally:
        for part in parts:
            part.unlink(missing_ok=True)
    return written, station
