"""``huddle import``."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rich.table import Table

from daq.bench.loading import parse
from daq.estimation.settings import Settings
from daq.formats.importer import import_files
from tui.output.console import for_people, write_json
from tui.output.formatting import several, utc
from tui.runs.estimate_settings import chosen

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def import_recording(
    sources: Sequence[Path],
    *,
    out: Path,
    bench: Path | None,
    response: Path | None,
    sampling_rate: float | None,
    json: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Write a recording from files of other programs, and show what it holds.

    Options of the estimate become part of the bench file in the recording.
    """
    described = None if bench is None else parse(bench.read_text(encoding="utf-8"), bench)
    given = any(value is not None for value in wanted.values())
    settings = chosen(Settings.of(described), **wanted) if given else None
    imported = import_files(
        sources,
        out,
        bench=described,
        estimate=settings,
        response=response,
        sampling_rate=sampling_rate,
    )
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("sensor", "channels", "rate", "start (UTC)", "samples", "gaps"):
        table.add_column(column, justify="right" if column in {"samples", "gaps"} else "left")
    for entry in imported:
        table.add_row(
            entry.sensor,
            " ".join(entry.channels),
            f"{entry.sampling_rate:g} Hz",
            utc(entry.start_utc_ns),
            str(entry.n_samples),
            f"{entry.n_gaps} ({several(entry.missing, 'sample')})" if entry.n_gaps else "none",
        )
    screen = for_people(json)
    screen.print(table)
    screen.print(f"{out} written; next: huddle estimate {out}")
    write_json(json, {"recording": str(out), "sensors": [asdict(entry) for entry in imported]})
