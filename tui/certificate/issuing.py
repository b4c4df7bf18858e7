"""Issues certificates and verifies them: what is refused, and what a certificate consists of."""

from __future__ import annotations

import hashlib
import io
import json
from datetime import UTC, datetime
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from daq.bench.estimate_settings import to_table
from daq.bench.outline import BenchOutline
from daq.errors import HuddleError
from daq.estimation.contributions import with_sensitivities
from daq.estimation.snapshot_builder import sensitivities_at
from daq.recording.reader import Recording
from daq.recording.repair import verify as verify_recording
from daq.recording.signing import identity
from daq.results.decision.conformity import conformity, with_rule
from daq.results.decision.limits import judge
from daq.results.sources import sources
from tui.certificate.dcc import NAME as DCC_NAME
from tui.certificate.dcc import dcc
from tui.output.console import finite
from tui.output.json_document import document
from tui.report.certificate import Issue, changes, missing
from tui.report.contents import report_of
from tui.report.paper import write_paper

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from daq.bench.masks.mask import Mask
    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.results.sources import Source
    from tui.certificate.ledger import Entry, Ledger
    from tui.report.parts import Report

JSON_NAME = "result.json"
"""Name of the result in the certificate."""


class NotIssuedError(HuddleError, ValueError):
    """A certificate is refused; the message says why, and what to do."""

    is_usage_error = True


class VerificationError(HuddleError, ValueError):
    """A certificate is not what the ledger says, or not of the recording that is there."""


def refuse_unfit(found: Sequence[Source], about: Bench | None, *, by: str, complete: bool) -> None:
    """Refuse what no certificate may be made of.

    Parameters
    ----------
    found : sequence of Source
    about : Bench or None
        Where laboratory, customer and sensors are described.
    by : str
        Who authorises.
    complete : bool
        Whether all that the checklist asks must be given.

    Raises
    ------
    NotIssuedError
        With everything that is missing.
    """
    for source in found:
        if source.simulated:
            raise NotIssuedError(
                f"{source.path}: sensors were simulated: no certificate is issued of a model;"
                " huddle report writes a draft"
            )
        if source.state in {"growing", "left open"}:
            wanted = "wait for its end" if source.state == "growing" else "huddle repair closes it"
            raise NotIssuedError(f"{source.path}: not closed; {wanted}")
    left = missing(about, found[0], by=by)
    if left and complete:
        text = "\n".join(f"  {each.what}: {each.key} ({each.clause})" for each in left)
        raise NotIssuedError(
            f"not given in the bench file:\n{text}\n"
            "--bench takes a bench file that gives it; --allow-incomplete issues without"
        )


def settings_table(settings: Settings, snapshot: Snapshot) -> dict[str, Any]:
    """Return the settings of an estimate as the ledger keeps them."""
    span = {
        key: None if value is None else value.isoformat()
        for key, value in (("start", settings.start), ("end", settings.end))
    }
    table = to_table(settings) | span | {"method": list(snapshot.results)}
    table = {key: value for key, value in table.items() if value is not None}
    plain: dict[str, Any] = json.loads(json.dumps(table, default=str))
    return plain


def issue(
    snapshot: Snapshot,
    settings: Settings,
    recordings: Sequence[Path],
    ledger: Ledger,
    *,
    by: str,
    reason: str = "",
    about: Bench | None = None,
    models: Sequence[Mask] = (),
    complete: bool = True,
    sign: Callable[[bytes], bytes] | None = None,
) -> tuple[Entry, Path]:
    """Issue a certificate: number, file, and both in the ledger.

    Parameters
    ----------
    snapshot : Snapshot
        A finished estimate.
    settings : Settings
        It was made with.
    recordings : sequence of Path
    ledger : Ledger
    by : str
        Who authorises.
    reason : str
        Of a revision: needed where these recordings have a certificate already.
    about : Bench, optional
        Where laboratory, customer and sensors are described; default: the recorded bench.
    models : sequence of Mask
        Noise models to show.
    complete : bool
        Whether all that the checklist asks must be given.
    sign : callable, optional
        Signs the PDF.

    Raises
    ------
    NotIssuedError
        If the recordings may not have a certificate.
    LedgerError
        If the ledger was changed by hand or is in use.
    """
    found = sources(recordings)
    about = found[0].bench if about is None else about
    refuse_unfit(found, about, by=by, complete=complete)
    snapshot = with_stated(snapshot, found, about)
    prefix = "HT" if about is None else about.certificate.prefix
    runs = [(source.path.name, source.run_id, source.sha256) for source in found]
    roots = dict(identity(source.path) for source in found)
    table = settings_table(settings, snapshot)
    if about is not None and about.certificate.guard_band != 1.0:
        table["guard_band"] = about.certificate.guard_band
    if about is not None:
        table["decision_rule"] = str(about.certificate.decision_rule)
    with ledger.held():
        before = ledger.last_of(frozenset(run_id for _, run_id, _ in runs))
        if before is not None and not reason:
            raise NotIssuedError(
                f"certificate {before.name} is of the same recording; --reason TEXT issues a"
                " revision of it"
            )
        at = datetime.now(UTC).replace(microsecond=0)
        entry = ledger.allot(
            prefix, at=at, by=by, recordings=runs, settings=table, reason=reason, roots=roots
        )
        try:
            made = Issue(
                number=entry.number,
                revision=entry.revision,
                at=at,
                by=by,
                entry=entry.hash,
                replaces=None if before is None else before.revision,
                replaces_sha256="" if before is None else before.sha256,
                reason=reason,
                changes=() if before is None else tuple(changes(dict(before.settings), table)),
                incomplete=bool(missing(about, found[0], by=by)),
            )
            report = report_of(snapshot, settings, found, models, issue=made, about=about)
            xml = dcc(snapshot, settings, found, issue=made, about=about)
            content = _pdf(report, _result(snapshot, settings, found, made, about), xml, at)
            if sign is not None:
                content = sign(content)
            path = ledger.publish(entry, ".pdf", content)
        except Exception as error:
            ledger.void(entry, f"{type(error).__name__}: {error}")
            raise
    return entry, path


def with_stated(snapshot: Snapshot, found: Sequence[Source], about: Bench | None) -> Snapshot:
    """Return a snapshot with the sensitivities that a bench file states of the sensors."""
    outline = None if about is None else BenchOutline.of_text(about.text)
    if outline is None:
        return snapshot
    readings = (each for source in found for each in source.readings)
    return with_sensitivities(snapshot, sensitivities_at(outline.sensitivities, readings))


def _result(
    snapshot: Snapshot,
    settings: Settings,
    found: Sequence[Source],
    made: Issue,
    about: Bench | None,
) -> bytes:
    """Return the result as JSON, with the certificate it is of."""
    rule = with_rule(found[0].bench, about)
    verdict = judge(rule, snapshot, settings)
    result = document(snapshot, settings, sources=found, verdict=verdict)
    result["certificate"] = {
        "number": made.number,
        "revision": made.revision,
        "issued": made.at.isoformat(),
        "by": made.by,
        "entry": made.entry,
    }
    stated = conformity(rule, snapshot, settings)
    if rule is not None and stated:
        result["certificate"] |= {
            "decision_rule": rule.certificate.decision_rule,
            "guard_band": rule.certificate.guard_band,
            "conformity": [
                {
                    "limit": each.limit,
                    "sensor": each.sensor,
                    "channel": each.channel,
                    "statement": each.statement,
                    "risk": each.risk,
                    "frequency_hz": each.frequency,
                }
                for each in stated
            ],
        }
    return json.dumps(finite(result), ensure_ascii=False, allow_nan=False).encode()


def _pdf(report: Report, result: bytes, xml: bytes, at: datetime) -> bytes:
    """Return the certificate with its machine-readable forms inside."""
    paper = io.BytesIO()
    attached = [(JSON_NAME, "application/json", result), (DCC_NAME, "application/xml", xml)]
    write_paper(report, paper, attached=attached, at=at)
    return paper.getvalue()


def verify(path: Path, recordings: Sequence[Path], ledger: Ledger) -> list[str]:
    """Return what is right with a certificate, a line each.

    Parameters
    ----------
    path : Path
        The certificate.
    recordings : sequence of Path
        Those it should be of; none: those beside the folder of the ledger, by their names.
    ledger : Ledger

    Raises
    ------
    VerificationError
        With the first thing that is wrong.
    LedgerError
        If the ledger was changed by hand.
    """
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    entries = ledger.entries()
    entry = next((each for each in entries if each.sha256 == sha256), None)
    if entry is None:
        same = next((each for each in entries if each.file == path.name), None)
        if same is None:
            raise VerificationError(f"{path}: not in the ledger {ledger.folder}")
        raise VerificationError(
            f"{path}: changed: its SHA-256 is not that of certificate {same.name} in the ledger"
        )
    lines = [f"certificate {entry.name}, issued {entry.at:%Y-%m-%d} by {entry.by}: {entry.state}"]
    if entry.state == "replaced":
        last = ledger.last_of(entry.runs, entries)
        lines.append(f"replaced by revision {last.revision}" if last else "replaced")
    lines.append("SHA-256 and ledger: as issued")
    lines += _signatures(path)
    return [*lines, *_recordings(path, entry, recordings, ledger)]


def _signatures(path: Path) -> list[str]:
    """Return who signed, a line each."""
    content = path.read_bytes()
    if b"/ByteRange" not in content:
        return ["not signed"]
    if find_spec("pyhanko") is None:
        return ["signature not checked: pip install 'huddle-bench[sign]'"]
    from tui.certificate.signing import signatures  # noqa: PLC0415 - an extra

    lines = []
    for name, intact in signatures(content):
        if not intact:
            raise VerificationError(f"{path}: the signature of {name} is not intact")
        lines.append(f"signed by {name}: intact; whom the signer is vouched for by, a reader shows")
    return lines


def _recordings(path: Path, entry: Entry, recordings: Sequence[Path], ledger: Ledger) -> list[str]:
    beside = [ledger.folder.parent / file for file, _, _ in entry.recordings]
    given = list(recordings) or [each for each in beside if each.is_file()]
    if not given:
        names = ", ".join(file for file, _, _ in entry.recordings)
        return [f"recording not checked: name it ({names})"]
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
