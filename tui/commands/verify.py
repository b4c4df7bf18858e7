"""``huddle verify``: checksums and signatures of recordings, and certificates."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from daq.errors import RecordingError
from tui.certificate.ledger import Ledger
from tui.commands.options import command
from tui.output.console import for_people, write_json


@command()
def verify(
    sources: list[Path],
    *,
    key: Path | None = None,
    ledgers: Annotated[list[Path] | None, typer.Option("--certificates")] = None,
    json: str | None = None,
) -> None:
    """Verify the checksums and signatures of recordings, or of all recordings of a service.

    Recordings that were certified are compared with the ledger of their
    certificates: beside them, or where their bench file says.

    A certificate (.pdf) is compared with the ledger in its folder by what is
    inside the PDF, and with the recordings named with it, or those beside
    that folder. Only a signature, verified with --key, shows that nobody
    has written both anew.

    The exit code is 3 if a recording is damaged, lost or exchanged, or a certificate or
    signature is not genuine.

    Parameters
    ----------
    sources : SOURCE
        Recordings, bench files or folders; certificates.
    key : FILE
        Public key that must have signed every recording; of certificates the public key or the
        X.509 certificate (PEM) that must have signed them and their ledger.
    ledgers : FOLDER
        Folder of certificates that no bench file names, or ledger of a certificate that is
        elsewhere; may be repeated.

    Examples
    --------
    huddle verify lab.toml
    huddle verify recordings
    huddle verify a.h5 --key lab.key.pub
    huddle verify a.h5 b.h5 --json -
    huddle verify certificates/HT-2026-0042-r0.pdf night.h5
    huddle verify certificates/HT-2026-0042-r0.pdf --key lab.pem
    """
    from tui.certificate import verification

    certificates = [source for source in sources if source.suffix.lower() == ".pdf"]
    if certificates:
        recordings = [source for source in sources if source not in certificates]
        findings = []
        for path in certificates:
            ledger = Ledger(ledgers[0] if ledgers else path.absolute().parent)
            lines = verification.verify(path, recordings, ledger, key=key)
            findings.append({"path": str(path), "findings": lines})
            for line in lines:
                for_people(json).print(f"{path.name}: {line}", soft_wrap=True)
        write_json(json, {"certificates": findings})
        return
    found = []
    paths, known, folders = _recordings(sources)
    folders |= {each.absolute() for each in ledgers or ()}
    for each in verification.verified(paths, known=known, folders=folders, key=key):
        found.append(each)
        said = each.state.removeprefix(f"{each.path}: ")
        for_people(json).print(f"{each.path}: {said}", soft_wrap=True)
        if each.warning:
            for_people(json).print(f"{each.path}: {each.warning}", soft_wrap=True, markup=False)
    bad = [each.path.name for each in found if not each.is_intact]
    write_json(
        json,
        {
            "recordings": [
                {
                    "path": str(each.path),
                    "intact": each.is_intact,
                    "state": each.state,
                    "root_sha256": each.root_sha256 or None,
                }
                for each in found
            ]
        },
    )
    if bad:
        raise RecordingError(f"{len(bad)} of {len(found)} recordings are damaged or lost")


def known_to_services(paths: Iterable[Path]) -> dict[Path, tuple[str, str]]:
    """Return run id and root SHA-256 of recordings, by the databases of services beside them."""
    from tui.service.records.places import NoServiceError, Place

    known: dict[Path, tuple[str, str]] = {}
    for folder in {path.absolute().parent for path in paths}:
        with contextlib.suppress(NoServiceError):
            identities = Place.of(folder).store.identities()
            known |= {
                path: identities[path.name]
                for path in paths
                if path.absolute().parent == folder and path.name in identities
            }
    return known


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
    return list(dict.fromkeys(found)), known_to_services(found) | known, folders
