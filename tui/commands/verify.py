"""``huddle verify``: checksums and signatures of recordings, and certificates."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.errors import RecordingError
from daq.recording.storage.trial import trials
from tui.certificate.ledger import Ledger, ledgers_of
from tui.commands.options import JsonOption, examples

if TYPE_CHECKING:
    from collections.abc import Sequence


@examples(
    "huddle verify lab.toml",
    "huddle verify recordings",
    "huddle verify a.h5 --key lab.key.pub",
    "huddle verify a.h5 b.h5 --json -",
    "huddle verify certificates/HT-2026-0042-r0.pdf night.h5",
)
def verify(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="SOURCE", help="Recordings, bench files or folders; certificates."),
    ],
    *,
    key: Annotated[
        Path | None,
        typer.Option(
            "--key", metavar="FILE", help="Public key that must have signed every recording."
        ),
    ] = None,
    ledgers: Annotated[
        list[Path] | None,
        typer.Option(
            "--certificates",
            metavar="FOLDER",
            help="Folder of certificates that no bench file names; may be repeated.",
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Verify the checksums and signatures of recordings, or of all recordings of a service.

    Recordings that were certified are compared with the ledger of their
    certificates: beside them, or where their bench file says.

    A certificate (.pdf) is compared with the ledger in its folder, and with
    the recordings named with it, or those beside that folder.

    The exit code is 3 if a recording is damaged, lost or exchanged, or a signature does not fit.
    """
    from daq.recording.signing import problem, signature_of
    from tui.output.console import for_people, write_json

    certificates = [source for source in sources if source.suffix.lower() == ".pdf"]
    if certificates:
        _verify_certificates(certificates, sources, json=json)
        return
    found = []
    paths, known, folders = _recordings(sources)
    folders |= {each.absolute() for each in ledgers or ()}
    # In children: a file that hangs or crashes HDF5 is damaged, and the others are verified.
    for path, report in trials(paths, "verify"):
        damaged = ", ".join(report.get("damaged", ()))
        state = report.get("error") or (f"damaged: {damaged}" if damaged else "intact")
        if "fatal" in report:
            state = f"damaged: {report['fatal']}"
        own = report.get("run_id", ""), report.get("root_sha256", "")
        if state == "intact" and known.get(path, own) != own:
            state = "exchanged: not the recording that the service has made under this name"
        names: list[str] = []
        if state == "intact":
            for ledger in ledgers_of(path, folders):
                name, wrong = ledger.certified(path, *own)
                names += [name] if name else []
                state = wrong or state
        if state == "intact":
            state = problem(path, *own, public=key) or state
        signer = signature_of(path) if state == "intact" else None
        if signer is not None:
            state = f"intact, signed with key {signer.key_id}"
        if names and state.startswith("intact"):
            state += f", certified by {'; '.join(names)}"
        found.append((path, state, report.get("root_sha256") or None))
        for_people(json).print(f"{path}: {state.removeprefix(f'{path}: ')}", soft_wrap=True)
        if warning := report.get("warning"):
            for_people(json).print(f"{path}: {warning}", soft_wrap=True, markup=False)
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
    from tui.certificate.issuing import verify
    from tui.output.console import for_people, write_json

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
) -> tuple[list[Path], dict[Path, tuple[str, str]], set[Path]]:
    """Return recordings, run id and root SHA-256 of those that services know.

    And the folders of certificates that bench files name.
    """
    from tui.service.records.places import NoServiceError, Place

    found: list[Path] = []
    folders: set[Path] = set()
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
        if place.bench is not None:
            folders.add(place.bench.certificate.folder)
        runs = place.runs(kept=True)
        found += [place.folder / part for run in runs for part in run.parts]
        known |= {place.folder / part: own for part, own in place.store.identities().items()}
    return list(dict.fromkeys(found)), known, folders
