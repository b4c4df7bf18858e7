"""``huddle issue`` and ``huddle issues``."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

import typer
from rich.table import Table

from daq.bench.masks.mask_file import masks_named
from daq.devices.bench_file import load
from daq.recording.reader import Recording
from daq.results.decision.limits import judge
from daq.results.sources import sources
from tui.certificate.ledger import Ledger, LedgerError
from tui.commands.estimate import estimated, exit_with
from tui.output.console import console, for_people, notices, write_json
from tui.output.extras import require

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def issue_certificate(
    files: Sequence[Path],
    *,
    by: str,
    reason: str,
    bench: Path | None,
    folder: Path | None,
    models: str,
    allow_incomplete: bool,
    sign: Path | None,
    start: str | None,
    end: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Estimate recordings, and issue their certificate.

    Raises
    ------
    NotIssuedError
        If the recordings may not have a certificate; nothing is estimated then.
    typer.Exit
        With 1 if a limit is not met, with 4 if that is not decided, after the certificate was
        issued.
    """
    require("matplotlib", "jinja2", "fpdf", *(["pyhanko"] if sign is not None else []))
    from tui.certificate.issuing import (  # noqa: PLC0415 - loads matplotlib
        issue,
        ledger_of,
        refuse_unfit,
    )

    signer = None
    if sign is not None:
        from tui.certificate.signing import Signer  # noqa: PLC0415 - an extra

        signer = Signer(sign, _passphrase())
    masks = masks_named(models)
    found = sources(files)
    about = found[0].bench if bench is None else load(bench)
    refuse_unfit(found, about, by=by, complete=not allow_incomplete)
    ledger = ledger_of(files[0], about) if folder is None else Ledger(folder)
    snapshot, settings, recorded = estimated(files, start=start, end=end, **wanted)
    with notices().status("issuing the certificate"):
        entry, path = issue(
            snapshot,
            settings,
            files,
            ledger,
            by=by,
            reason=reason,
            about=about,
            models=masks,
            complete=not allow_incomplete,
            sign=signer,
        )
    console().print(f"certificate {entry.name}: {path}", soft_wrap=True)
    exit_with(judge(recorded.bench, snapshot, settings))


def _passphrase() -> str:
    """Return the passphrase of the key: of the environment, or asked for; empty if neither."""
    given = os.environ.get("HUDDLE_PASSPHRASE")
    if given is not None or not sys.stdin.isatty():
        return given or ""
    return str(typer.prompt("Passphrase of the key", hide_input=True, default=""))


def list_issues(source: Path, *, json: str | None) -> None:
    """List the certificates of a folder, or of the folder that belongs to a recording.

    Raises
    ------
    LedgerError
        If there is no ledger, or if it was changed by hand.
    """
    from tui.certificate.issuing import ledger_of  # noqa: PLC0415 - loads matplotlib

    if source.is_dir():
        ledger = Ledger(source)
        if not ledger.exists and Ledger(source / "certificates").exists:
            ledger = Ledger(source / "certificates")
    else:
        with Recording.open(source) as recording:
            about = recording.bench
        ledger = ledger_of(source, about)
    entries = ledger.entries()
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for title in ("number", "revision", "state", "date", "by", "recording", "reason"):
        table.add_column(title, overflow="fold")
    for each in entries:
        recorded = ", ".join(file for file, _, _ in each.recordings)
        table.add_row(
            *(each.number, str(each.revision), each.state, f"{each.at:%Y-%m-%d}"),
            *(each.by, recorded, each.reason),
        )
    for_people(json).print(table)
    write_json(
        json,
        {
            "folder": str(ledger.folder),
            "certificates": [
                {
                    "number": each.number,
                    "revision": each.revision,
                    "state": each.state.replace(" ", "-"),
                    "issued": each.at.isoformat(),
                    "by": each.by,
                    "reason": each.reason or None,
                    "recordings": [
                        {"file": file, "run_id": run_id, "sha256": sha256}
                        for file, run_id, sha256 in each.recordings
                    ],
                    "file": each.file or None,
                    "sha256": each.sha256 or None,
                    "settings": dict(each.settings),
                }
                for each in entries
            ],
        },
    )
    lost = [each.name for each in entries if each.state == "file missing"]
    if lost:
        raise LedgerError(f"{ledger.folder}: the files of these are missing: {'; '.join(lost)}")
