"""``huddle issue`` and ``huddle issues``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from tui.certificate.ledger import Ledger, LedgerError, ledger_of, ledgers_of
from tui.commands.estimate import estimated, exit_with
from tui.commands.options import command, with_spanned_options
from tui.commands.verify import known_to_services
from tui.output.console import console, for_people, notices, write_json
from tui.output.extras import require
from tui.page.table import Table


@command(first="by reason bench folder allow_incomplete despite specimen sign start end")
@with_spanned_options
def issue(
    files: list[Path],
    *,
    by: str = "",
    reason: str = "",
    bench: Path | None = None,
    folder: Path | None = None,
    allow_incomplete: bool = False,
    despite: str = "",
    is_specimen: Annotated[bool, typer.Option("--specimen")] = False,
    sign: Path | None = None,
    models: str = "",
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Issue a numbered certificate of a huddle test as PDF.

    The number, such as HT-2026-0042, comes from an append-only ledger in the
    folder of the certificates. No certificate is overwritten: a further one
    of the same recording is a revision, and needs a reason. Recordings are
    verified before, as huddle verify does it. Those of simulated sensors are
    refused, and so are results that a fact invalidates, unless --despite
    says why. --specimen shows what a certificate would be.

    Options not given come from the bench file inside the recording.
    The exit code is 1 if a limit is not met, and 4 if that is not decided.

    Parameters
    ----------
    by : NAME
        Who authorises the certificate; a specimen needs nobody.
    reason : TEXT
        Why a certificate of the same recording is revised.
    bench : BENCH
        Bench file with [laboratory], [customer], [certificate] and the manufacturers of the sensors
        (default: the one inside the recording).
    folder : DIR
        Folder of the certificates and their ledger (default: folder of [certificate], or
        certificates beside the recording).
    allow_incomplete
        Issue without all that ISO/IEC 17025 asks for; say so.
    despite : REASON
        Why a result is certified although a fact invalidates it; printed on page 1.
    is_specimen
        Make a specimen of any recording, simulated ones too: watermarked, without number, in no
        ledger (NAME-specimen.pdf beside the recording, or in --folder).
    sign : FILE
        Key of the laboratory (.p12) that signs the PDF, and the ledger as far as this certificate.
        Its passphrase is asked for, or taken from HUDDLE_PASSPHRASE. Extra: sign.

    Examples
    --------
    huddle issue night.h5 --by 'A. Lovelace'
    huddle issue night.h5 --by 'A. Lovelace' --bench lab.toml
    huddle issue night.h5 --specimen
    huddle issue night.h5 --by 'A. Lovelace' --segment 20s --reason 'resolution of 0.05 Hz'
    """
    from daq.bench.masks.mask_file import masks_named
    from daq.devices.bench_file import load

    require("matplotlib", "jinja2", "fpdf", *(["pyhanko"] if sign is not None else []))
    from tui.certificate.issuing import Order, examine, issue, specimen, with_stated

    if is_specimen and sign is not None:
        raise typer.BadParameter("--sign: a specimen is not signed")
    signer = None
    if sign is not None:
        from tui.certificate.signing import Signer

        signer = Signer(sign, _passphrase())
    order = Order(
        by=by,
        about=None if bench is None else load(bench),
        reason=reason,
        despite=despite,
        complete=not allow_incomplete,
        models=masks_named(models),
        signer=signer,
    )
    with notices().status("verifying the recording"):
        examined = examine(
            files,
            order,
            known=known_to_services,
            folders=() if folder is None else (folder.absolute(),),
        )
    if not is_specimen:
        examined.check()
    result = estimated(files, whole=True, calibrates=True, **wanted)
    with notices().status("making the certificate"):
        if is_specimen:
            place = files[0].absolute().parent if folder is None else folder
            said = f"specimen: {specimen(result, examined, place)}"
        else:
            ledger = ledger_of(files[0], examined.about) if folder is None else Ledger(folder)
            entry, path = issue(result, examined, ledger)
            said = f"certificate {entry.name}: {path}"
            if signer is not None:
                said += f"\nsigned with key {signer.key_id}"
            known = {each.folder.resolve() for each in ledgers_of(files[0], ())}
            if ledger.folder.resolve() not in known:
                said += (
                    f"\nhuddle verify --certificates {ledger.folder} compares recordings with it"
                )
    console().print(said, soft_wrap=True)
    exit_with(with_stated(result, examined).verdict)


@command()
def issues(
    source: Path = Path("certificates"),
    *,
    json: str | None = None,
) -> None:
    """List the certificates of a ledger, with revisions and void numbers.

    The exit code is 3 if the ledger was changed, or if a certificate is missing.

    Parameters
    ----------
    source : SOURCE
        Folder of certificates, or a recording of the laboratory.

    Examples
    --------
    huddle issues certificates
    huddle issues night.h5 --json -
    """
    from daq.recording.reader import Recording

    if source.is_dir() or not (source.exists() or source.suffix):
        ledger = Ledger(source)
        if not ledger.exists and Ledger(source / "certificates").exists:
            ledger = Ledger(source / "certificates")
    else:
        with Recording.open(source) as recording:
            about = recording.bench
        ledger = ledger_of(source, about)
    entries = ledger.entries()
    rows = (
        (
            *(each.number, each.revision, each.state, f"{each.at:%Y-%m-%d}", each.by),
            *(", ".join(file for file, _, _ in each.recordings), each.reason),
        )
        for each in entries
    )
    names = ("number", "revision", "state", "date", "by", "recording", "reason")
    for_people(json).print(Table.of(names, rows))
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


def _passphrase() -> str:
    """Return the passphrase of the key: of the environment, or asked for; empty if neither."""
    given = os.environ.get("HUDDLE_PASSPHRASE")
    if given is not None or not sys.stdin.isatty():
        return given or ""
    return str(typer.prompt("Passphrase of the key", hide_input=True, default=""))
