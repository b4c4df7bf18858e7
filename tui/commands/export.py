"""``huddle export``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from tui.commands.estimate import estimated
from tui.commands.options import OutOption, command, with_logging, with_spanned_options
from tui.output.console import for_people, write_json


@command()
@with_logging
@with_spanned_options
def export(
    files: list[Path],
    *,
    kind: Annotated[str, typer.Option("--format")],
    out: OutOption = None,
    json: str | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Write samples or noise curves for other programs.

    mseed: all samples (times within 0.5 % of the sampling interval), and StationXML.

    csv, parquet: a row for each method, channel and frequency.

    netcdf, zarr: labelled arrays, for xarray.

    mat, npz: an array (n_frequencies, n_channels) of each curve.

    uff58: a function of type 9 (PSD) for each curve.

    Parameters
    ----------
    kind : FORMAT
        Samples: mseed. Curves: csv, parquet, netcdf, zarr, mat, npz, uff58.
    out : FILE
        File (default: beside the recording).

    Examples
    --------
    huddle export night.h5 --format mseed
    huddle export night.h5 --format netcdf --method all --out noise.nc
    huddle export monday.h5 tuesday.h5 --format uff58
    """
    from estimator.wording import several
    from tui.notebook.curve_files import MINISEED, WRITERS, write_curves
    from tui.output.json_document import provenance

    if kind == MINISEED:
        if len(files) > 1 or any(value is not None for value in wanted.values()):
            raise typer.BadParameter(
                "mseed holds all samples of one recording; expected one FILE and no options of the"
                " estimate"
            )
        _export_samples(files[0], out or files[0].with_suffix(".mseed"), json)
        return
    if kind not in WRITERS:
        known = ", ".join((MINISEED, *WRITERS))
        raise typer.BadParameter(f"--format {kind}: expected one of {known}")
    path = out or files[0].with_suffix(WRITERS[kind][0])
    result = estimated(files, **wanted)
    snapshot = result.snapshot
    write_curves(snapshot, kind, path, provenance(result))
    n_curves = len(snapshot.results) * len(snapshot.channels)
    for_people(json).print(f"{path} written: {several(n_curves, 'noise curve')}")
    write_json(json, {"file": str(path), "format": kind, "methods": list(snapshot.results)})


def _export_samples(file: Path, out: Path, json: str | None) -> None:
    from estimator.wording import several
    from tui.notebook.curve_files import MINISEED, write_samples

    written, station = write_samples(file, out)
    screen = for_people(json)
    for name, codes in written.codes.items():
        full = f"{codes.network}.{codes.station}.{codes.location}.{codes.channel}"
        if full != name:
            screen.print(f"{name} is {full}")
    screen.print(f"{out} and {station} written: {several(written.n_gaps, 'gap')}")
    write_json(
        json, {"file": str(out), "stationxml": str(station), "format": MINISEED, **asdict(written)}
    )
