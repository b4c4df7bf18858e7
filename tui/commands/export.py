"""``huddle export``."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import typer

from daq.results.sources import sources
from tui.commands.estimate import estimated
from tui.notebook.curve_files import MINISEED, WRITERS, write_curves, write_samples
from tui.output.console import for_people, write_json
from tui.output.json_document import provenance
from tui.wording.formatting import several

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def export_recordings(
    files: Sequence[Path],
    *,
    kind: str,
    out: Path | None,
    start: str | None,
    end: str | None,
    json: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Write samples or curves of recordings to a file of another program.

    Raises
    ------
    typer.BadParameter
        An unknown format, or options that it does not take.
    """
    if kind == MINISEED:
        given = [start, end, *wanted.values()]
        if len(files) > 1 or any(value is not None for value in given):
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
    snapshot, settings, _ = estimated(files, start=start, end=end, **wanted)
    write_curves(snapshot, kind, path, provenance(snapshot, settings, sources(files)))
    n_curves = len(snapshot.results) * len(snapshot.channels)
    for_people(json).print(f"{path} written: {several(n_curves, 'noise curve')}")
    write_json(json, {"file": str(path), "format": kind, "methods": list(snapshot.results)})


def _export_samples(file: Path, out: Path, json: str | None) -> None:
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
