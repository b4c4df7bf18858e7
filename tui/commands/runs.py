"""``huddle runs``, ``huddle pin``, ``huddle verify``: what a service has kept."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table

from daq.errors import HuddleError, RecordingError
from daq.recording.signing import problem, signature_of
from daq.recording.storage.trial import trials
from tui.certificate.ledger import Ledger
from tui.output.console import check_places, for_people, write_json, write_text
from tui.output.csv_text import csv_text
from tui.service.records.places import NoServiceError, Place
from tui.service.records.run_state import Run, RunState, utc_text

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

_STYLES = {RunState.FAILED: "red", RunState.MISSED: "yellow", RunState.DONE: "green"}
PAGE = 100
"""Runs that are listed unless another number is given."""
_COLUMNS = (
    *("bench", "entry", "due", "state", "verdict", "started", "ended", "duration"),
    *("recordings", "pinned", "removed", "reason"),
)


class RunNotFoundError(HuddleError):
    """No run has this recording or due time."""

    is_usage_error = True


def list_runs(source: Path, *, last: int | None, json: str | None, csv: str | None) -> None:
    """List the runs of a service: the last ones where `last` is given, or for people.

    Raises
    ------
    NoServiceError, StoreError
        If there is no database of runs, or it cannot be read.
    """
    check_places(json, csv)
    place = Place.of(source)
    is_page = last is None and json is None and csv is None
    runs = place.runs(last=PAGE + 1 if is_page else last)
    is_page = is_page and len(runs) > PAGE
    runs = runs[-PAGE:] if is_page else runs
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("due (UTC)", "entry", "state", "verdict", "recording", "reason"):
        table.add_column(name, overflow="fold")
    for run in runs:
        kept = ", ".join(run.parts) or "-"
        notes = [*(["pinned"] if run.pinned else []), *(["removed"] if run.removed else [])]
        table.add_row(
            *(f"{run.due:%Y-%m-%d %H:%M}", run.entry, run.state, run.verdict or "-"),
            kept + (f" ({', '.join(notes)})" if notes else ""),
            run.reason,
            style=_STYLES.get(run.state),
        )
    screen = for_people(json, csv)
    screen.print(table)
    if is_page:
        screen.print(f"The last {PAGE} runs; --last N shows more, --csv and --json all.")
    write_json(json, {"runs": [run.document() for run in runs]})
    if csv is not None:
        write_text(csv, csv_text(_COLUMNS, map(_cells, runs)))


def _cells(run: Run) -> list[object]:
    document = run.document() | {"recordings": " ".join(run.parts)}
    return [document[name] for name in _COLUMNS]


def pin_runs(source: Path, names: Sequence[str], *, pinned: bool) -> None:
    """Keep runs whatever the limits of storage, or no longer.

    Parameters
    ----------
    source : Path
        Bench file or folder.
    names : sequence of str
        File names of recordings, or due times.
    pinned : bool

    Raises
    ------
    RunNotFoundError
        If there is no such run; then none is changed.
    """
    place = Place.of(source)
    runs = place.runs()
    found = [run for name in names for run in runs_named(runs, name)]
    place.store.pin([run.key for run in found], pinned=pinned)
    for run in found:
        for_people(None).print(f"run {run.name} {'is kept' if pinned else 'is no longer pinned'}")


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


def verify_recordings(
    sources: Sequence[Path], *, key: Path | None = None, json: str | None
) -> None:
    """Walk the checksums of recordings, or of all that services have kept.

    Parameters
    ----------
    sources : sequence of path
        Recordings, bench files or folders.
    key : Path, optional
        Public key that must have signed every recording.
    json : str or None

    Raises
    ------
    RecordingError
        If one is damaged, lost, another one than the service made, or not signed with the key.
    """
    certificates = [source for source in sources if source.suffix.lower() == ".pdf"]
    if certificates:
        _verify_certificates(certificates, sources, json=json)
        return
    found = []
    paths, known = _recordings(sources)
    # In children: a file that hangs or crashes HDF5 is damaged, and the others are verified.
    for path, report in trials(paths, "verify"):
        damaged = ", ".join(report.get("damaged", ()))
        state = report.get("error") or (f"damaged: {damaged}" if damaged else "intact")
        if "fatal" in report:
            state = f"damaged: {report['fatal']}"
        own = report.get("run_id", ""), report.get("root_sha256", "")
        if state == "intact" and known.get(path, own) != own:
            state = "exchanged: not the recording that the service has made under this name"
        if state == "intact":
            state = problem(path, *own, public=key) or state
        signer = signature_of(path) if state == "intact" else None
        if signer is not None:
            state = f"intact, signed with key {signer.key_id}"
        found.append((path, state, report.get("root_sha256") or None))
        for_people(json).print(f"{path}: {state.removeprefix(f'{path}: ')}", soft_wrap=True)
    bad = [path.name for path, state, _ in found if not state.startswith("intact")]
    write_json(
        json,
        {
            "recordings": [
                {
                    "path": str(path),
                    "intact": state.startswith("intact"),
                    "state": state,
                    "root_sha256": root,
                }
                for path, state, root in found
            ]
        },
    )
    if bad:
        raise RecordingError(f"{len(bad)} of {len(found)} recordings are damaged or lost")


def _verify_certificates(
    certificates: Sequence[Path], sources: Sequence[Path], *, json: str | None
) -> None:
    """Check certificates against the ledger in their folder, and the recordings named beside them.

    Raises
    ------
    VerificationError
        If one was changed, or is of another recording.
    """
    from tui.certificate.issuing import verify  # noqa: PLC0415 - loads matplotlib

    recordings = [source for source in sources if source not in certificates]
    found = []
    for path in certificates:
        lines = verify(path, recordings, Ledger(path.absolute().parent))
        found.append({"path": str(path), "findings": lines})
        for line in lines:
            for_people(json).print(f"{path.name}: {line}", soft_wrap=True)
    write_json(json, {"certificates": found})


def _recordings(
    sources: Sequence[Path],
) -> tuple[list[Path], dict[Path, tuple[str, str]]]:
    """Return recordings, and run id and root SHA-256 of those that services know."""
    found: list[Path] = []
    known: dict[Path, tuple[str, str]] = {}
    for source in sources:
        if source.suffix.lower() in {".h5", ".hdf5"}:
            found.append(source)
            continue
        try:
            place = Place.of(source)
        except NoServiceError:
            if not source.is_dir():
                raise
            found += sorted(source.glob("*.h5"))
            continue
        runs = place.runs(kept=True)
        found += [place.folder / part for run in runs for part in run.parts]
        known |= {place.folder / part: own for part, own in place.store.identities().items()}
    return list(dict.fromkeys(found)), known
