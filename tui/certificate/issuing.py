"""Issues certificates and specimens: what is refused, and what a certificate consists of."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

from daq.bench.estimate_settings import to_table
from daq.bench.outline import BenchOutline
from daq.errors import HuddleError
from daq.estimation.contributions import with_sensitivities
from daq.estimation.snapshot_builder import sensitivities_at
from daq.recording.signing import identity
from daq.results.decision.conformity import conformity, with_rule
from daq.results.result import Result
from daq.results.sources import Source, sources
from tui.certificate.dcc import NAME as DCC_NAME
from tui.certificate.dcc import dcc
from tui.certificate.ledger import HeadSigner, Ledger, LedgerEntry
from tui.certificate.verification import JSON_NAME, verified
from tui.output.json_document import document
from tui.output.json_values import json_text
from tui.page.pdf import write_paper
from tui.report.certificate import SPECIMEN, Issue, changes, missing
from tui.report.contents import report_of
from tui.report.evidence import invalidating
from tui.report.writing import write_content

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from daq.bench.masks.mask import Mask
    from daq.bench.model import Bench


class NotIssuedError(HuddleError, ValueError):
    """A certificate is refused; the message says why, and what to do."""

    is_usage_error = True


class PdfSigner(HeadSigner, Protocol):
    """The key of a laboratory, which signs certificates and the head of their ledger."""

    def __call__(self, content: bytes) -> bytes:
        """Return a PDF with a signature over all of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What is asked of a certificate.

    Attributes
    ----------
    by : str
        Who authorises; empty: only a specimen can be made.
    about : Bench or None
        Where laboratory, customer, sensors and their sensitivities are described; default: the
        recorded bench.
    reason : str
        Of a revision: needed where these recordings have a certificate already.
    despite : str
        Why a result that a fact invalidates is certified nevertheless.
    complete : bool
        Whether all that the checklist asks must be given.
    models : sequence of Mask
        Noise models to show.
    signer : PdfSigner, optional
    """

    by: str = ""
    about: Bench | None = None
    reason: str = ""
    despite: str = ""
    complete: bool = True
    models: Sequence[Mask] = ()
    signer: PdfSigner | None = None


@dataclass(frozen=True, slots=True)
class Objection:
    """Why no certificate may be made of recordings.

    Attributes
    ----------
    line : str
        In a line.
    details : str
        What follows on the command line: what is missing where, and which option helps.
    """

    line: str
    details: str = ""

    def __str__(self) -> str:
        return self.line + self.details


@dataclass(frozen=True, slots=True)
class Examined:
    """Recordings that were examined before a certificate is made of them: by `examine` only.

    Attributes
    ----------
    found : tuple of Source
    order : Order
    about : Bench or None
        That of the order, or the recorded one.
    objections : tuple of Objection
        Why no certificate may be made of them; a specimen may.
    """

    found: tuple[Source, ...]
    order: Order
    about: Bench | None
    objections: tuple[Objection, ...]

    def check(self) -> None:
        """Refuse what no certificate may be made of.

        Raises
        ------
        NotIssuedError
            With all objections.
        """
        if self.objections:
            raise NotIssuedError("\n".join(map(str, self.objections)))
        if not self.order.by:
            raise NotIssuedError("nobody authorises the certificate; expected --by NAME")


def examine(
    recordings: Sequence[Path],
    order: Order,
    *,
    known: Callable[[Sequence[Path]], Mapping[Path, tuple[str, str]]],
    folders: Iterable[Path] = (),
) -> Examined:
    """Examine recordings, before they are estimated.

    Parameters
    ----------
    recordings : sequence of Path
    order : Order
    known : callable
        Returns run id and root SHA-256 of recordings by the databases of services.
    folders : iterable of Path
        Of ledgers besides those that recordings name.
    """
    found = sources(recordings)
    about = found[0].bench if order.about is None else order.about
    objections = []
    for source in found:
        objections += [
            Objection(f"{source.path}: {each.words.refusal}", "; --specimen makes a specimen")
            for each in source.recording.caveats
        ]
        if source.state in {"growing", "left-open"}:
            wanted = "wait for its end" if source.state == "growing" else "huddle repair closes it"
            objections.append(Objection(f"{source.path}: not closed; {wanted}"))
    if not any(source.state == "growing" for source in found):
        paths = [source.path for source in found]  # with those that continue the ones given
        objections += [
            Objection(f"{each.path}: {each.state.removeprefix(f'{each.path}: ')}")
            for each in verified(paths, known=known(paths), folders=folders)
            if not each.is_intact
        ]
    left = missing(about, found[0], by=order.by)
    if left and order.complete:
        where = "".join(f"\n  {each.what}: {each.key} ({each.clause})" for each in left)
        objections.append(
            Objection(
                f"not given in the bench file: {', '.join(each.what for each in left)}",
                f"{where}\n--bench takes a bench file that gives it;"
                " --allow-incomplete issues without",
            )
        )
    outline = None if about is None else BenchOutline.of_text(about.text)
    stated = {} if outline is None else outline.sensitivities
    unknown = [
        f"{sensor.name}.{channel.name}"
        for sensor in found[0].recording.sensors
        for channel in sensor.channels
        if not channel.auxiliary
        and ((own := stated.get((sensor.name, channel.name))) is None or not own.is_stated)
    ]
    if unknown:
        objections.append(
            Objection(
                f"uncertainty of the sensitivity not stated: {', '.join(unknown)}",
                "; expected certificate or tolerance of each channel in [[sensors.channels]] of the"
                " bench file",
            )
        )
    return Examined(found, order, about, tuple(objections))


def settings_table(result: Result) -> dict[str, Any]:
    """Return the settings of an estimate as the ledger keeps them."""
    settings = result.settings
    span = {
        key: None if value is None else value.isoformat()
        for key, value in (("start", settings.start), ("end", settings.end))
    }
    table = to_table(settings) | span | {"method": list(result.snapshot.results)}
    table = {key: value for key, value in table.items() if value is not None}
    plain: dict[str, Any] = json.loads(json.dumps(table, default=str))
    return plain


def issue(result: Result, examined: Examined, ledger: Ledger) -> tuple[LedgerEntry, Path]:
    """Issue a certificate: number, file, and both in the ledger.

    Parameters
    ----------
    result : Result
        A finished estimate of the examined recordings.
    examined : Examined
    ledger : Ledger

    Raises
    ------
    NotIssuedError
        If the recordings may not have a certificate, or a fact invalidates the result.
    LedgerError
        If the ledger was changed by hand or is in use.
    """
    found, about, order = examined.found, examined.about, examined.order
    examined.check()
    if result.method == "multi-part":
        raise NotIssuedError(
            "the noise of two sensors assumes steady gains: no certificate is issued of it;"
            " --specimen makes a specimen"
        )
    result = with_stated(result, examined)
    invalid = invalidating(result.facts)
    if invalid and not order.despite:
        lines = "\n".join(f"  {each.text}" for each in invalid)
        raise NotIssuedError(
            f"the result is invalid:\n{lines}\n--despite REASON issues a certificate that prints"
            " the reason on page 1"
        )
    now = sources([source.path for source in found])
    if [source.sha256 for source in now] != [source.sha256 for source in found]:
        raise NotIssuedError("a recording was changed while it was estimated; try again")
    prefix = "HT" if about is None else about.certificate.prefix
    runs = [(source.path.name, source.recording.run_id, source.sha256) for source in found]
    roots = dict(identity(source.path) for source in found)
    table = settings_table(result)
    if about is not None and about.certificate.guard_band != 1.0:
        table["guard_band"] = about.certificate.guard_band
    if about is not None:
        table["decision_rule"] = str(about.certificate.decision_rule)
    signer = order.signer
    with ledger.held():
        before = ledger.last_of(frozenset(run_id for _, run_id, _ in runs))
        if before is not None and not order.reason:
            raise NotIssuedError(
                f"certificate {before.name} is of the same recording; --reason TEXT issues a"
                " revision of it"
            )
        at = datetime.now(UTC).replace(microsecond=0)
        entry = ledger.allot(
            prefix,
            at=at,
            by=order.by,
            recordings=runs,
            settings=table,
            reason=order.reason,
            roots=roots,
            signer="" if signer is None else signer.key_id,
        )
        try:
            made = Issue(
                number=entry.number,
                revision=entry.revision,
                at=at,
                by=order.by,
                entry=entry.hash,
                replaces=None if before is None else before.revision,
                replaces_sha256="" if before is None else before.sha256,
                reason=order.reason,
                changes=() if before is None else tuple(changes(dict(before.settings), table)),
                incomplete=bool(missing(about, found[0], by=order.by)),
                despite=order.despite if invalid else "",
            )
            content = _content(result, examined, made, roots)
            if signer is not None:
                content = signer(content)
            path = ledger.publish(entry, ".pdf", content, signer)
        except Exception as error:
            ledger.void(entry, f"{type(error).__name__}: {error}")
            raise
    return entry, path


def specimen(result: Result, examined: Examined, folder: Path) -> Path:
    """Make a specimen: what a certificate would be, watermarked, without number and ledger.

    Parameters
    ----------
    result, examined
        As `issue` takes them, of any recordings.
    folder : Path
        Where it is written; made if absent. An earlier specimen of the recording is replaced.

    Returns
    -------
    Path
    """
    made = Issue(
        number=SPECIMEN,
        revision=0,
        at=datetime.now(UTC).replace(microsecond=0),
        by=examined.order.by or "nobody",
        entry="",
        despite=examined.order.despite,
        objections=tuple(each.line for each in examined.objections),
    )
    content = _content(with_stated(result, examined), examined, made, {})
    name = f"{examined.found[0].path.stem}-specimen.pdf"
    folder.mkdir(parents=True, exist_ok=True)
    return write_content(folder / name, content, "replace")


def _content(
    result: Result,
    examined: Examined,
    made: Issue,
    roots: Mapping[str, str],
) -> bytes:
    """Return the PDF, with its machine-readable forms inside."""
    about = examined.about
    report = report_of(result, examined.order.models, issue=made, about=about)
    own, xml = _result(result, examined, made, roots), dcc(result, issue=made, about=about)
    attached = [(JSON_NAME, "application/json", own), (DCC_NAME, "application/xml", xml)]
    paper = io.BytesIO()
    write_paper(report, paper, attached=attached, at=made.at)
    return paper.getvalue()


def with_stated(result: Result, examined: Examined) -> Result:
    """Return a result with what the bench file of the order states of sensitivities."""
    about, snapshot = examined.order.about, result.snapshot
    outline = None if about is None else BenchOutline.of_text(about.text)
    if outline is not None:
        readings = (each for source in examined.found for each in source.readings)
        stated = sensitivities_at(outline.sensitivities, readings)
        snapshot = with_sensitivities(snapshot, stated)
    return Result(snapshot, result.settings, examined.found[0].bench, examined=examined.found)


def _result(
    result: Result,
    examined: Examined,
    made: Issue,
    roots: Mapping[str, str],
) -> bytes:
    """Return the result as JSON, with the certificate it is of."""
    rule, text = with_rule(result.bench, examined.about), document(result)
    text["certificate"] = {
        "number": made.number,
        "revision": made.revision,
        "issued": made.at.isoformat(),
        "by": made.by,
        "entry": made.entry,
        "roots": dict(roots),
        "despite": made.despite or None,
    }
    stated = conformity(rule, result)
    if rule is not None and stated:
        text["certificate"] |= {
            "decision_rule": rule.certificate.decision_rule,
            "guard_band": rule.certificate.guard_band,
            "conformity": stated,
        }
    return json_text(text).encode()
