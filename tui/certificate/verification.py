"""Verifies recordings and certificates, by all that is known of them.

A recording is compared with its own checksums and manifest, the database of the service that made
it, the ledgers of its certificates, and its signature. A certificate is compared with the ledger
and the recordings by what is *inside* the PDF: number, revision, authoriser, roots of the
recordings, and the hash of the row in which its number was given. A ledger that was written again
has another hash there, however well its rows fit together.

Without a signature, who can write the folder can write PDF and ledger anew, and nothing here shows
it. With a signature, and the public key from elsewhere, both are those of the owner of the key.
"""

from __future__ import annotations

import hashlib
import io
import json
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from daq.errors import HuddleError
from daq.memory_limit import memory_limit
from daq.python_process import install_command
from daq.recording.reader import Recording
from daq.recording.repair import verify as verify_recording
from daq.recording.signing import problem, signature_of
from daq.recording.storage.trial import trials
from tui.certificate.dcc import DCC
from tui.certificate.dcc import NAME as DCC_NAME
from tui.certificate.ledger import Ledger, LedgerEntry, ledgers_of, unknown_beside
from tui.output.extras import require
from tui.report.certificate import SPECIMEN

JSON_NAME = "result.json"
"""Name of the result in the certificate."""
_AT_LEAST, _MOST = 1 << 28, 100
"""Bytes that any PDF may take in memory, and each of its bytes: pypdf and pyHanko bound streams."""


class VerificationError(HuddleError, ValueError):
    """A certificate is not what the ledger says, or not of the recording that is there."""


@dataclass(frozen=True, slots=True)
class Verified:
    """What verification found of one recording.

    Attributes
    ----------
    path : Path
    state : str
        Begins with "intact" if nothing is wrong.
    root_sha256 : str
        Empty where it could not be read.
    warning : str
    """

    path: Path
    state: str
    root_sha256: str
    warning: str = ""

    @property
    def is_intact(self) -> bool:
        """Whether nothing is wrong."""
        return self.state.startswith("intact")


def verified(
    paths: Iterable[Path],
    *,
    known: Mapping[Path, tuple[str, str]],
    folders: Iterable[Path] = (),
    key: Path | None = None,
) -> Iterator[Verified]:
    """Verify recordings: checksums, manifest, identity in the database, ledgers, signature.

    In children: a file that hangs or crashes HDF5 is damaged, and the others are verified.

    Parameters
    ----------
    paths : iterable of Path
    known : mapping of Path to (str, str)
        Run id and root SHA-256 by the databases of services.
    folders : iterable of Path
        Folders of ledgers besides those that recordings name.
    key : Path, optional
        Public key that must have signed every recording.
    """
    for path, report in trials(list(paths), "verify"):
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
                entry, wrong = ledger.certified(path, *own)
                if entry is not None:
                    names.append(entry.name)
                    lacking = unknown_beside(ledger.folder, ledger.entries())
                    wrong = wrong or "; ".join([*_head(ledger, entry, "")[1], *lacking])
                state = wrong or state
        if state == "intact":
            state = problem(path, *own, public=key) or state
        signer = signature_of(path) if state == "intact" else None
        if signer is not None:
            state = f"intact, signed with key {signer.key_id}"
        if names and state.startswith("intact"):
            state += f", certified by {'; '.join(names)}"
        if state == "intact" and not report["closed"]:
            written = report["being_written"]
            state += ", being written" if written else ", not closed: huddle repair closes it"
        yield Verified(path, state, report.get("root_sha256") or "", report.get("warning", ""))


@dataclass(frozen=True, slots=True)
class Claims:
    """What a certificate says of itself, by the files inside.

    Attributes
    ----------
    number : str
    revision : int
    by, entry : str
        Who authorised it, and the hash of its row.
    roots : mapping of str to str
        Root SHA-256 of each recording by run id.
    text : str
        Of all pages, without white space.
    """

    number: str
    revision: int
    by: str
    entry: str
    roots: Mapping[str, str]
    text: str

    @classmethod
    def of(cls, path: Path, content: bytes) -> Claims:
        """Read a certificate.

        Raises
        ------
        VerificationError
            If it is none, or its parts contradict each other.
        """
        require("pypdf")
        from pypdf import PdfReader  # noqa: PLC0415 - an extra

        try:
            reader = PdfReader(io.BytesIO(content))
            attached = reader.attachments
            pages = ["".join(page.extract_text().split()) for page in reader.pages]
            (result,), (xml,) = (attached.get(name, []) for name in (JSON_NAME, DCC_NAME))
            own: dict[str, Any] = json.loads(result)["certificate"]
            of_dcc = ET.fromstring(xml).find(f".//{{{DCC}}}uniqueIdentifier")  # noqa: S314 - without entities: ET expands none from outside
            found = cls(
                number=str(own["number"]),
                revision=int(own["revision"]),
                by=str(own["by"]),
                entry=str(own["entry"]),
                roots={str(run): str(root) for run, root in own["roots"].items()},
                text="".join(pages),
            )
        except Exception as error:  # noqa: BLE001 - of a damaged file, pypdf raises anything
            raise VerificationError(
                f"{path}: not genuine: no certificate of huddle, or damaged ({error})"
            ) from None
        if found.number == SPECIMEN:
            raise VerificationError(f"{path}: a specimen, no certificate")
        name = f"{found.number}, revision {found.revision}"
        if of_dcc is None or of_dcc.text != name:
            raise VerificationError(
                f"{path}: not genuine: the DCC inside is not that of certificate {name}"
            )
        foot = "".join(name.split())
        if not pages or any(foot not in page for page in pages) or found.entry not in found.text:
            raise VerificationError(
                f"{path}: not genuine: its pages are not those of certificate {name}"
            )
        return found


def verify(
    path: Path, recordings: Sequence[Path], ledger: Ledger, *, key: Path | None = None
) -> list[str]:
    """Return what is right with a certificate, a line each.

    Parameters
    ----------
    path : Path
        The certificate.
    recordings : sequence of Path
        Those it should be of; none: those beside the folder of the ledger, by their names.
    ledger : Ledger
    key : Path, optional
        Public key, or X.509 certificate, that must have signed certificate and ledger.

    Raises
    ------
    VerificationError
        With all that is wrong.
    KeyFileError
        If the key cannot be read.
    LedgerError
        If the ledger was changed by hand.
    """
    wanted = ""
    if key is not None:
        require("cryptography")
        from tui.certificate.keys import key_id, public_key  # noqa: PLC0415 - an extra

        wanted = key_id(public_key(key))
    content = path.read_bytes()
    with _bounded(content):
        claims = Claims.of(path, content)
    if wanted and not ledger.exists:
        return _without_ledger(path, content, claims, recordings, wanted)
    entries = ledger.entries()
    entry = next(
        (e for e in entries if (e.number, e.revision) == (claims.number, claims.revision)), None
    )
    if entry is None:
        raise VerificationError(
            f"{path}: not genuine: {claims.number}, revision {claims.revision}, is not in the "
            f"ledger {ledger.folder}: another ledger, or one that was cut short"
        )
    wrong = _against_ledger(path, content, claims, entry, entries)
    signed, of_signature = _signatures(content, entry, wanted)
    wrong += of_signature
    if not of_signature:
        said, of_ledger = _head(ledger, entry, wanted)
        signed, wrong = [*signed, *said], wrong + of_ledger
    if wrong:
        raise VerificationError(f"{path}: not genuine: {'; '.join(wrong)}")
    lines = [f"certificate {entry.name}, issued {entry.at:%Y-%m-%d} by {entry.by}: {entry.state}"]
    if entry.state == "replaced":
        last = ledger.last_of(entry.runs, entries)
        lines.append(f"replaced by revision {last.revision}" if last else "replaced")
    lines.append("number, revision, authoriser and row inside the PDF; SHA-256: as in the ledger")
    return [*lines, *signed, *_recordings(path, entry, recordings, ledger)]


def _bounded(content: bytes) -> AbstractContextManager[None]:
    return memory_limit(max(_AT_LEAST, _MOST * len(content)))


def _without_ledger(
    path: Path, content: bytes, claims: Claims, recordings: Sequence[Path], wanted: str
) -> list[str]:
    """Return what a signature alone shows, to who has the certificate and not its ledger."""
    entry = LedgerEntry(
        number=claims.number,
        revision=claims.revision,
        at=datetime.now(UTC),
        by=claims.by,
        recordings=tuple((run_id, run_id, "") for run_id in claims.roots),
        settings={},
        reason="",
        hash=claims.entry,
        state="issued",
        roots=claims.roots,
        signer=wanted,
    )
    signed, wrong = _signatures(content, entry, wanted)
    if wrong:
        raise VerificationError(f"{path}: not genuine: {'; '.join(wrong)}")
    return [
        f"certificate {entry.name}, by {entry.by}",
        "no ledger here: a later revision would not be known",
        *signed,
        *_recordings(path, entry, recordings, None),
    ]


def _against_ledger(
    path: Path, content: bytes, claims: Claims, entry: LedgerEntry, entries: Sequence[LedgerEntry]
) -> list[str]:
    """Return where a certificate and the ledger differ."""
    wrong = []
    if claims.entry != entry.hash:
        wrong.append("the ledger has another row for it than the one it names: one was rewritten")
    if claims.by != entry.by:
        wrong.append(f"authorised by {claims.by}, in the ledger by {entry.by}")
    if dict(claims.roots) != dict(entry.roots):
        wrong.append("it is of other contents of the recording than the ledger says")
    if entry.state == "void":
        wrong.append("its number is void")
    elif hashlib.sha256(content).hexdigest() != entry.sha256:
        wrong.append("changed since it was issued: its SHA-256 is not that of the ledger")
    named = next((each for each in entries if each.file == path.name), entry)
    if named is not entry:
        wrong.append(f"it is {entry.name}, under the name of {named.name}")
    wrong += unknown_beside(path.parent, entries)
    return wrong


def _signatures(content: bytes, entry: LedgerEntry, wanted: str) -> tuple[list[str], list[str]]:
    """Return who signed, a line each, and what is wrong with that."""
    if b"/ByteRange" not in content:
        wrong = []
        if entry.signer:
            wrong.append(f"its signature, with key {entry.signer}, was removed")
        elif wanted:
            wrong.append("it is not signed")
        return ["not signed: who can write the folder can write certificate and ledger"], wrong
    if find_spec("pyhanko") is None:
        line = f"signature not checked; run: {install_command('sign')}"
        return [line], [line] if wanted else []
    from tui.certificate.signing import signatures  # noqa: PLC0415 - an extra

    lines, wrong = [], []
    try:
        with _bounded(content):
            found = signatures(content)
    except Exception as error:  # noqa: BLE001 - of a damaged file, pyHanko raises anything
        return [], [f"its signature cannot be read ({error})"]
    for each in found:
        if not each.is_intact:
            wrong.append(f"the signature of {each.signer} is not intact, or not of the whole file")
        if each.key_id != entry.signer:
            wrong.append(
                f"signed with key {each.key_id}, in the ledger "
                + (f"with {entry.signer}" if entry.signer else "not signed")
            )
        if wanted and each.key_id != wanted:
            wrong.append(f"signed with key {each.key_id}, expected {wanted}")
        lines.append(
            f"signed by {each.signer} with key {each.key_id}: intact"
            + ("" if wanted else "; whose key this is, --key or a reader shows")
        )
    return lines, wrong if lines else ["its signature cannot be read"]


def _head(ledger: Ledger, entry: LedgerEntry, wanted: str) -> tuple[list[str], list[str]]:
    """Return whether the ledger is signed as far as a certificate, and what is wrong with that."""
    if not entry.signer and not wanted:
        return [], []
    if find_spec("cryptography") is None:
        return [f"signature of the ledger not checked; run: {install_command('sign')}"], []
    rows = ledger.signed_rows()
    key_id = wanted or entry.signer
    if rows.get(key_id, 0) < entry.row:
        return [], [f"the ledger is not signed with key {key_id} as far as this certificate"]
    return [f"ledger signed with key {key_id} as far as this certificate"], []


def _recordings(
    path: Path, entry: LedgerEntry, recordings: Sequence[Path], ledger: Ledger | None
) -> list[str]:
    files = [file for file, _, _ in entry.recordings]
    beside = [] if ledger is None else [ledger.folder.parent / file for file in files]
    given = list(recordings) or [each for each in beside if each.is_file()]
    if not given:
        return [f"recording not checked: name it ({', '.join(files)})"]
    expected = {run_id: (file, sha256) for file, run_id, sha256 in entry.recordings}
    lines = []
    for each in given:
        with Recording.open(each) as recording:
            run_id = recording.run_id
        if run_id not in expected:
            raise VerificationError(f"{path}: {each} is another recording than the one certified")
        with each.open("rb") as file:
            is_same = hashlib.file_digest(file, "sha256").hexdigest() == expected[run_id][1]
        state = "unchanged"
        if not is_same:
            report = verify_recording(each)
            root = entry.roots.get(run_id)
            if not report.intact or root is None or report.root_sha256 != root:
                raise VerificationError(f"{path}: {each} was changed since the certificate")
            state = "its contents unchanged, its file not (such as results stored in it since)"
        lines.append(f"recording {each}: the one certified, {state}")
    return lines
