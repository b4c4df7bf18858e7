"""``huddle runs`` and ``huddle pin``: the runs of a service."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from daq.caveats import Caveat
from daq.errors import HuddleError
from tui.commands.options import command
from tui.output.console import check_places, for_people, write_json, write_text
from tui.output.csv_text import csv_text
from tui.page.table import Cell, Table, Tone
from tui.service.records.run_state import Run, RunState, utc_text

_TONES: dict[RunState, Tone] = {
    RunState.FAILED: "bad",
    RunState.MISSED: "doubtful",
    RunState.DONE: "good",
}
PAGE = 100
"""Runs that are listed unless another number is given."""
_COLUMNS = (
    *("bench", "entry", "due", "state", "verdict", "started", "ended", "duration"),
    *("recordings", *Caveat, "pinned", "removed", "reason"),
)


@command()
def runs(
    source: Path,
    *,
    last: Annotated[int | None, typer.Option(min=1)] = None,
    json: str | None = None,
    csv: str | None = None,
) -> None:
    """List the runs of a service: state, verdict, recordings, reason.

    A run is due, recording, estimating, done, failed or missed.

    Parameters
    ----------
    source : BENCH
        Bench file, or a folder of recordings.
    last : N
        The last N runs (default on the screen: 100).

    Examples
    --------
    huddle runs lab.toml
    huddle runs lab.toml --last 10
    huddle runs recordings --csv -
    """
    from tui.service.records.places import Place

    check_places(json, csv)
    place = Place.of(source)
    is_page = last is None and json is None and csv is None
    runs = place.runs(last=PAGE + 1 if is_page else last)
    is_page = is_page and len(runs) > PAGE
    runs = runs[-PAGE:] if is_page else runs
    screen = for_people(json, csv)
    names = ("due (UTC)", "entry", "state", "verdict", "recording", "reason")
    screen.print(Table.of(names, map(_row, runs)))
    if is_page:
        screen.print(f"The last {PAGE} runs; --last N shows more, --csv and --json all.")
    write_json(json, {"runs": [run.document() for run in runs]})
    if csv is not None:
        write_text(csv, csv_text(_COLUMNS, map(_cells, runs)))


@command()
def pin(
    source: Path,
    names: list[str],
    *,
    remove: bool = False,
) -> None:
    """Protect runs from removal by the storage limits of the bench file.

    Parameters
    ----------
    source : BENCH
        Bench file, or a folder of recordings.
    names : RUN
        Recording or due time, as in huddle runs.
    remove
        Allow their removal again.

    Examples
    --------
    huddle pin lab.toml lab-20261121T220000Z.h5
    huddle pin lab.toml '2026-11-21 22:00' --remove
    """
    from tui.service.records.places import Place

    pinned = not remove
    place = Place.of(source)
    runs = place.runs()
    found = [run for name in names for run in runs_named(runs, name)]
    place.store.pin([run.key for run in found], pinned=pinned)
    for run in found:
        for_people(None).print(f"run {run.name} {'is kept' if pinned else 'is no longer pinned'}")


class RunNotFoundError(HuddleError):
    """No run has this recording or due time."""

    is_usage_error = True


def _row(run: Run) -> list[Cell]:
    marks = {**run.caveats.keys, "pinned": run.pinned, "removed": run.removed}
    notes = ", ".join(name for name, holds in marks.items() if holds)
    kept = (", ".join(run.parts) or "-") + (f" ({notes})" if notes else "")
    about = (f"{run.due:%Y-%m-%d %H:%M}", run.entry, run.state, run.verdict or "-")
    return [Cell(each, _TONES.get(run.state, "plain")) for each in (*about, kept, run.reason)]


def _cells(run: Run) -> list[object]:
    document = run.document() | {"recordings": " ".join(run.parts)}
    return [document[name] for name in _COLUMNS]


def runs_named(runs: Sequence[Run], name: str) -> list[Run]:
    """Return the runs with a recording of this file name, or with this due time.

    Raises
    ------
    RunNotFoundError
        If there is none.
    """
    short = name.rpartition("/")[2]
    found = [
        run
        for run in runs
        if short in run.parts or name in {utc_text(run.due), f"{run.due:%Y-%m-%d %H:%M}"}
    ]
    if not found:
        raise RunNotFoundError(
            f"{name}: no such run; expected a recording or a due time as huddle runs shows them"
        )
    return found
