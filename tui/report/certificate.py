"""What makes a report a certificate: who, for whom, by which procedure, and what is not given.

`CHECKLIST` follows ISO/IEC 17025:2017, 7.8.2 to 7.8.6 and 7.8.8; ``docs/certificate.md`` has it for
people.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING

from daq.bench.durations import format_duration
from daq.bench.estimate_settings import to_table
from daq.bench.tables.certificate import CertificateTable, Customer, Laboratory
from daq.caveats import Caveats
from daq.estimation.settings import Settings
from daq.protocols.block import Quantity
from daq.results.sources import Condition, Source, conditions
from tui.page.blocks import KeyValues, Paragraph, Part
from tui.page.table import Table
from tui.wording.formatting import plain_number, utc_time

if TYPE_CHECKING:
    import datetime as dt
    from collections.abc import Callable, Sequence

    from daq.bench.model import Bench
    from daq.estimation.snapshot import Snapshot
    from daq.results.result import Result

_NONE = "not given"
LEAST_LOST = 0.01
"""Share of a recording without samples of a sensor that page 1 states."""
PROCEDURE = (
    "Self-noise by the coherence of sensors side by side (huddle test): Zhu, Au and Wang,"
    " Instrument noise calibration with arbitrary sensor orientations, which extends Sleeman, van"
    " Wettum and Trampert (2006), Bull. Seismol. Soc. Am. 96, 258–271, to sensors in any"
    " orientation."
)
SPECIMEN = "SPECIMEN"
"""Number and watermark of what only shows how a certificate looks."""
NOT_VERIFIED = (
    "Given by the customer or user, and not verified: data of the sensors and of the parties,"
    " sensitivities without a certificate."
)
SCOPE = (
    "The results relate only to the items listed, as received, and to the time and place of the"
    " test. The certificate may be reproduced only in full, unless the laboratory agrees in"
    " writing."
)


@dataclass(frozen=True, slots=True)
class Issue:
    """How a certificate was issued; a report without one is a draft.

    Attributes
    ----------
    number : str
        Such as ``HT-2026-0042``.
    revision : int
    at : datetime
        UTC.
    by : str
        Who authorised it.
    entry : str
        Hash of its row in the ledger.
    replaces : int or None
        The revision it replaces.
    reason : str
        Of the revision.
    changes : tuple of str
        Settings that differ from the replaced revision.
    replaces_sha256 : str
        Of the file of the replaced revision.
    incomplete : bool
        Whether it was issued without all that the checklist asks.
    despite : str
        Why it was issued although a fact invalidates the result.
    objections : tuple of str
        Of a specimen: why a certificate would be refused.
    """

    number: str
    revision: int
    at: dt.datetime
    by: str
    entry: str
    replaces: int | None = None
    reason: str = ""
    changes: tuple[str, ...] = ()
    replaces_sha256: str = ""
    incomplete: bool = False
    despite: str = ""
    objections: tuple[str, ...] = ()

    @property
    def is_specimen(self) -> bool:
        """Whether it is no certificate."""
        return self.number == SPECIMEN

    @property
    def name(self) -> str:
        """Number and revision, as on every page."""
        if self.is_specimen:
            return f"{SPECIMEN}, not a certificate"
        return f"{self.number}, revision {self.revision}"


@dataclass(frozen=True, slots=True)
class Requirement:
    """One line of the checklist.

    Attributes
    ----------
    clause : str
        Of ISO/IEC 17025:2017.
    what : str
        What is missing, as people read it.
    key : str
        Where it is given.
    is_given : callable
    """

    clause: str
    what: str
    key: str
    is_given: Callable[[Bench, Source], bool]


CHECKLIST = (
    Requirement(
        "7.8.2.1 b", "name and address of the laboratory", "[laboratory] name, address",
        lambda bench, _: bool(bench.laboratory.name and bench.laboratory.address),
    ),
    Requirement(
        "7.8.2.1 c", "place of the test", "[certificate] place, or location",
        lambda bench, source: bool(bench.certificate.place or source.recording.location),
    ),
    Requirement(
        "7.8.2.1 e", "name and contact of the customer", "[customer] name, and address or email",
        lambda bench, _: bool(
            bench.customer.name and (bench.customer.address or bench.customer.email)
        ),
    ),
    Requirement(
        "7.8.2.1 f", "procedure", "[certificate] procedure",
        lambda bench, _: bool(bench.certificate.procedure),
    ),
    Requirement(
        "7.8.2.1 g", "model, manufacturer and serial number of every sensor",
        "[[sensors]] model, manufacturer, serial_number",
        lambda bench, source: not unidentified(bench, source),
    ),
    Requirement(
        "7.8.2.1 g", "condition of the sensors", "[certificate] condition",
        lambda bench, _: bool(bench.certificate.condition),
    ),
    Requirement(
        "7.8.2.1 h", "date of receipt", "[certificate] received",
        lambda bench, _: bench.certificate.received is not None,
    ),
    Requirement(
        "7.8.2.1 o", "person who authorises", "[certificate] responsible, or --by",
        lambda bench, _: bool(bench.certificate.responsible),
    ),
    Requirement(
        "7.8.3.1 / 7.5.1", "operator", "operator", lambda _, source: bool(source.recording.operator)
    ),
    Requirement(
        "7.8.4.1 c", "metrological traceability", "[certificate] traceability",
        lambda bench, _: bool(bench.certificate.traceability) or _is_calibrated(bench),
    ),
)  # fmt: skip
"""What a user has to give; the rest of the checklist is made by the program."""


def missing(bench: Bench | None, source: Source, *, by: str = "") -> list[Requirement]:
    """Return what the user has not given."""
    if bench is None:
        return list(CHECKLIST)
    if by and not bench.certificate.responsible:
        table = bench.certificate.model_copy(update={"responsible": by})
        bench = bench.model_copy(update={"certificate": table})
    return [each for each in CHECKLIST if not each.is_given(bench, source)]


def unidentified(bench: Bench, source: Source) -> list[str]:
    """Return the sensors without model, manufacturer or serial number."""
    makers = manufacturers(bench)
    return [
        sensor.name
        for sensor in source.recording.sensors
        if not (sensor.model and sensor.serial_number and makers.get(sensor.name))
    ]


def manufacturers(bench: Bench | None) -> dict[str, str]:
    """Return the manufacturer of every sensor that has one."""
    sensors = () if bench is None else bench.sensors
    return {sensor.name: sensor.manufacturer for sensor in sensors if sensor.manufacturer}


def _is_calibrated(bench: Bench) -> bool:
    return any(
        all(channel.certificate is not None for channel in sensor.channels if not channel.auxiliary)
        for sensor in bench.sensors
    )


def settings_line(settings: Settings, bench: Bench | None) -> Paragraph:
    """Return the settings in a line, with those that are not of the bench file."""
    shown = to_table(settings) | {
        key: value.isoformat()
        for key, value in (("start", settings.start), ("end", settings.end))
        if value is not None
    }
    changed = changes(to_table(Settings.of(bench)), shown)
    text = "Settings: " + (_listed(shown) or "all defaults") + "."
    if changed:
        of = "the bench file" if bench else "the defaults"
        return Paragraph(f"{text} Not those of {of}: {'; '.join(changed)}.", "doubtful")
    return Paragraph(text, "quiet")


def changes(before: dict[str, object], after: dict[str, object]) -> list[str]:
    """Return what differs between two tables of settings, in words."""
    return [
        f"{key} {_value(key, before)} → {_value(key, after)}"
        for key in dict.fromkeys([*before, *after])
        if before.get(key) != after.get(key)
    ]


def _listed(table: dict[str, object]) -> str:
    return ", ".join(f"{key} {_value(key, table)}" for key in table)


def _value(key: str, table: dict[str, object]) -> str:
    """Return a setting with its unit."""
    value = table.get(key)
    if isinstance(value, (list, tuple)) and key == "band":
        return " to ".join(f"{end:g}" for end in value) + " Hz"
    if isinstance(value, float):
        return f"{value:g}{' s' if key == 'segment' else ''}"
    return "default" if key not in table else str(value)


def notices(
    found: Sequence[Source],
    result: Result,
    bench: Bench | None,
    issue: Issue | None,
) -> tuple[Paragraph, ...]:
    """Return what must be read before the numbers."""
    settings = result.settings
    caveats = Caveats.joined(source.recording.caveats for source in found)
    lines = [Paragraph(each.words.warning, "bad") for each in caveats]
    if issue is None:
        text = "DRAFT: not a certificate. huddle issue makes one."
        left = len(missing(bench, found[0]))
        if left:
            text += f" Not given: {left} of its {len(CHECKLIST)} entries; see the annex."
        lines.append(Paragraph(text, "doubtful"))
    elif issue.is_specimen:
        text = "SPECIMEN: not a certificate. It has no number and is in no ledger."
        lines.append(Paragraph(text, "bad"))
        lines += [
            Paragraph(f"A certificate would be refused: {each}.", "doubtful")
            for each in issue.objections
        ]
    else:
        lines += _of_issue(issue, bench, found[0])
    if issue is not None and issue.despite:
        text = f"Issued despite facts that invalidate the result. Reason: {issue.despite}."
        lines.append(Paragraph(text, "bad"))
    lines += [Paragraph(text, "bad") for text in without_samples(found[-1], result.snapshot)]
    stated = conditions(found, bench, start=settings.start, end=settings.end)
    lines += [Paragraph(text, "bad") for text in outside_range(stated)]
    lines.append(settings_line(settings, bench))
    return tuple(lines)


def _of_issue(issue: Issue, bench: Bench | None, source: Source) -> list[Paragraph]:
    """Return how a certificate was issued."""
    text = f"Certificate {issue.name}, issued {issue.at:%Y-%m-%d} by {issue.by}."
    if issue.replaces is not None:
        text += (
            f" Replaces revision {issue.replaces} of {issue.number}. Reason: {issue.reason}."
            f" Changed settings: {'; '.join(issue.changes) or 'none'}."
        )
    lines = [Paragraph(text)]
    if issue.incomplete:
        left = "; ".join(each.what for each in missing(bench, source, by=issue.by))
        lines.append(Paragraph(f"Issued incomplete. Not given: {left}.", "doubtful"))
    return lines


def without_samples(source: Source, snapshot: Snapshot) -> list[str]:
    """Return the sensors that recorded nothing for more than `LEAST_LOST` of a recording."""
    whole = (source.last - source.started).total_seconds()
    lines = []
    for sensor in snapshot.sensors:
        lost = whole - sensor.n_samples / sensor.sampling_rate
        if whole > 0 and lost > max(LEAST_LOST * whole, 1.0):
            lines.append(
                f"Sensor {sensor.name} recorded nothing for {format_duration(round(lost))} of "
                f"{format_duration(round(whole))}."
            )
    return lines


def watermark(found: Sequence[Source], issue: Issue | None) -> str:
    """Return what stands across every page."""
    if issue is not None and issue.is_specimen:
        return SPECIMEN
    caveats = Caveats.joined(source.recording.caveats for source in found)
    return caveats.after().upper() or ("DRAFT" if issue is None else "")


def parties(found: Sequence[Source], bench: Bench | None, issue: Issue | None) -> list[Part]:
    """Return laboratory, customer, items, procedure and traceability."""
    laboratory = Laboratory() if bench is None else bench.laboratory
    customer = Customer() if bench is None else bench.customer
    table = CertificateTable() if bench is None else bench.certificate
    first, last = found[0], found[-1]
    place = table.place or first.recording.location or laboratory.address
    rows = [
        ("Bench", first.bench.name if first.bench else _NONE),
        ("Laboratory", _joined(laboratory.name, laboratory.address)),
        ("Contact", _joined(laboratory.email, laboratory.phone)),
        ("Accreditation", laboratory.accreditation or "none claimed"),
        ("Customer", _joined(customer.name, customer.address, customer.email)),
        ("Order", customer.order or _NONE),
        ("Place of the test", place or _NONE),
        ("Received", _NONE if table.received is None else table.received.isoformat()),
        ("Condition", table.condition or _NONE),
        ("Location", first.recording.location if first.recording.location != place else ""),
        ("Tested", f"{utc_time(first.started)} to {utc_time(last.last)}"),
        ("Procedure", table.procedure or _NONE),
        ("Method", PROCEDURE),
        ("Deviations", table.deviations or "none"),
        ("Traceability", table.traceability or _traceability(bench)),
        ("Operator", first.recording.operator or _NONE),
        ("Authorised by", (issue.by if issue else table.responsible) or _NONE),
        ("Date of issue", f"{issue.at:%Y-%m-%d}" if issue and issue.entry else "not issued"),
        ("Report made by", f"huddle {version('huddle-bench')}"),
    ]
    if issue is not None and issue.entry:
        rows.append(("Entry of the ledger", issue.entry))
    parts: list[Part] = [KeyValues(tuple(row for row in rows if row[1] not in {_NONE, ""}))]
    absent = [f"{e.what} ({e.key})" for e in missing(bench, found[0])] if issue is None else []
    absent = absent or [name for name, value in rows if value == _NONE]
    if absent:
        parts.append(Paragraph(f"Not given: {'; '.join(absent)}."))
    return parts


QUANTITIES = {Quantity.TEMPERATURE: "temperature", Quantity.SUPPLY: "supply voltage"}


def outside_range(stated: Sequence[Condition]) -> list[str]:
    """Return the sensors whose temperature left the range of their data sheet, in words."""
    return [
        f"Sensor {each.sensor} was outside of its data sheet's range: {each.lowest:.1f} to"
        f" {each.highest:.1f} °C; {each.limits[0]:g} to {each.limits[1]:g} °C are permitted."
        for each in stated
        if each.limits is not None and each.is_outside
    ]


def conditions_stated(
    found: Sequence[Source], about: Bench | None, settings: Settings
) -> list[Part]:
    """Return what devices and computer stated, and what is outside the data sheet's range."""
    stated = conditions(found, about, start=settings.start, end=settings.end)
    rows = [
        (
            each.sensor or "computer",
            *_quantity(each.quantity),
            plain_number(each.lowest, ".2f"),
            plain_number(each.highest, ".2f"),
            str(each.n_readings),
            "" if each.limits is None else f"{each.limits[0]:g} … {each.limits[1]:g}",
        )
        for each in stated
    ]
    titles = ("of", "quantity", "unit", "lowest", "highest", "readings", "range of the data sheet")
    silent = {sensor.name for sensor in found[0].recording.sensors} - {
        each.sensor for each in stated
    }
    note = "Conditions are read from the devices once a minute."
    if silent:
        note += f" Nothing is stated by {', '.join(sorted(silent))}."
    parts: list[Part] = [Table(titles, tuple(rows))] if rows else []
    parts += [Paragraph(text, "bad") for text in outside_range(stated)]
    return [*parts, Paragraph(note, "quiet")]


def _quantity(quantity: Quantity | str) -> tuple[str, str]:
    if isinstance(quantity, Quantity):
        return QUANTITIES[quantity], quantity.unit
    return quantity, ""


def _joined(*parts: str) -> str:
    return ", ".join(part for part in parts if part) or _NONE


def _traceability(bench: Bench | None) -> str:
    if bench is None or not _is_calibrated(bench):
        return "not given: sensitivities are nominal values"
    numbers = sorted(
        {
            channel.certificate.number or "without number"
            for sensor in bench.sensors
            for channel in sensor.channels
            if channel.certificate is not None
        }
    )
    return f"sensitivities by certificates {', '.join(numbers)}; times by the host's clock (UTC)"
