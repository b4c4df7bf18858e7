"""The certificate as a Digital Calibration Certificate (DCC 3.1.2, PTB) with units of the D-SI.

The numbers are those of the report: levels of `daq.results.band_summary`, statements of
`daq.results.decision.conformity`. Intervals are given as they are, with both ends. A band whose
interval has no upper end has no place in the schema's lists and is left out.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from importlib.metadata import version
from typing import TYPE_CHECKING

from daq.bench.tables.certificate import CertificateTable, Customer, Laboratory
from daq.bench.units import in_si
from daq.caveats import Caveats
from daq.protocols.block import Quantity
from daq.results.decision.conformity import Conformity, Statement, conformity, with_rule
from daq.results.sources import Condition, Source, conditions
from daq.results.uncertainty_budget import Budget, band_budgets, third_octave_budgets
from estimator.wording import span
from tui.report import certificate
from tui.report.noise import decision_rule

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from daq.bench.model import Bench
    from daq.results.result import Result

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
SCHEMA_VERSION = "3.1.2"
NAME = "certificate.dcc.xml"
"""Name of the DCC in the PDF."""
_LANGUAGE, _NO_COUNTRY = "en", "ZZ"
"""ISO 3166 keeps ZZ free for what is not known."""
_STATED = {
    Statement.PASS: "pass",
    Statement.CONDITIONAL_PASS: "conditionalPass",
    Statement.CONDITIONAL_FAIL: "conditionalFail",
    Statement.FAIL: "fail",
}
_STATED_IN = {Quantity.TEMPERATURE: r"\degreecelsius", Quantity.SUPPLY: r"\volt"}
_UNITS = {
    "m/s²": r"\metre\tothe{2}\second\tothe{-4}\hertz\tothe{-1}",
    "m/s": r"\metre\tothe{2}\second\tothe{-2}\hertz\tothe{-1}",
    "m": r"\metre\tothe{2}\hertz\tothe{-1}",
}
"""PSD of each unit of motion in the D-SI."""


def dcc(
    result: Result,
    *,
    issue: certificate.Issue | None = None,
    about: Bench | None = None,
) -> bytes:
    """Return the DCC of an estimate; without an `issue` it is a draft and says so.

    Parameters
    ----------
    result : Result
        A finished estimate of recordings.
    issue : Issue, optional
        Number and revision.
    about : Bench, optional
        Where laboratory, customer and sensors are described; default: the recorded bench.
    """
    for prefix, name in (("dcc", DCC), ("si", SI)):
        ET.register_namespace(prefix, name)
    found = result.sources
    about = found[0].bench if about is None else about
    root = ET.Element(_dcc("digitalCalibrationCertificate"), schemaVersion=SCHEMA_VERSION)
    _administrative(root, found, about, issue)
    _results(root, result, about)
    ET.indent(root)
    content: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return content + b"\n"


def _administrative(
    root: ET.Element, found: Sequence[Source], about: Bench | None, issue: certificate.Issue | None
) -> None:
    laboratory = Laboratory() if about is None else about.laboratory
    customer = Customer() if about is None else about.customer
    table = CertificateTable() if about is None else about.certificate
    part = _add(root, "administrativeData")
    software = _add(_add(part, "dccSoftware"), "software")
    _text(software, "name", "huddle")
    _add(software, "release", version("huddle-bench"))
    country = laboratory.country or _NO_COUNTRY
    _core(_add(part, "coreData"), found, table, issue, country=country, order=customer.order)
    _items(_add(part, "items"), found[-1], about)
    _contact(
        _add(_add(part, "calibrationLaboratory"), "contact"),
        (laboratory.name, laboratory.address),
        email=laboratory.email,
        phone=laboratory.phone,
    )
    responsible = issue.by if issue else table.responsible
    _persons(_add(part, "respPersons"), responsible, found[0].recording.operator)
    _contact(_add(part, "customer"), (customer.name, customer.address), email=customer.email)
    statements = _add(part, "statements")
    lines = [certificate.SCOPE, f"Traceability: {table.traceability or 'not given'}"]
    if laboratory.accreditation:
        lines.append(laboratory.accreditation)
    caveats = Caveats.joined(source.recording.caveats for source in found)
    lines[:0] = [each.words.scope for each in caveats]
    if issue is None or issue.is_specimen:
        what = "DRAFT" if issue is None else certificate.SPECIMEN
        lines.insert(0, f"{what}: not a certificate.")
    if issue is not None and issue.despite:
        lines.append(f"Issued despite facts that invalidate the result: {issue.despite}")
    for line in lines:
        _content(_add(_add(statements, "statement"), "declaration"), line)


def _core(
    core: ET.Element,
    found: Sequence[Source],
    table: CertificateTable,
    issue: certificate.Issue | None,
    *,
    country: str,
    order: str,
) -> None:
    """Add number, dates, and what the certificate is of and replaces."""
    first, last = found[0], found[-1]
    _add(core, "countryCodeISO3166_1", country)
    _add(core, "usedLangCodeISO639_1", _LANGUAGE)
    _add(core, "mandatoryLangCodeISO639_1", _LANGUAGE)
    _add(core, "uniqueIdentifier", issue.name if issue else f"DRAFT {first.recording.run_id}")
    identifications = [("other", "SHA-256 of the recording", s.sha256 or "none") for s in found]
    if order:
        identifications.append(("customer", "order", order))
    if issue is not None and issue.entry:
        entry = ("calibrationLaboratory", "entry of the ledger", issue.entry)
        identifications.append(entry)
    _identifications(core, identifications)
    if table.received is not None:
        _add(core, "receiptDate", table.received.isoformat())
    _add(core, "beginPerformanceDate", f"{first.started:%Y-%m-%d}")
    _add(core, "endPerformanceDate", f"{last.last:%Y-%m-%d}")
    _add(
        core,
        "performanceLocation",
        "other" if table.place or first.recording.location else "laboratory",
    )
    if issue is not None and issue.replaces is not None:
        before = _add(core, "previousReport")
        _text(before, "referral", issue.reason)
        _add(before, "referralID", f"{issue.number}, revision {issue.replaces}")
        _add(before, "procedure", "SHA-256")
        _add(before, "value", issue.replaces_sha256)


def _items(items: ET.Element, last: Source, about: Bench | None) -> None:
    """Add the sensors."""
    condition = "" if about is None else about.certificate.condition
    makers = certificate.manufacturers(about)
    for sensor in last.recording.sensors:
        item = _add(items, "item")
        _text(item, "name", sensor.name)
        if condition:
            _content(_add(item, "description"), f"Condition: {condition}")
        _text(_add(item, "manufacturer"), "name", makers.get(sensor.name) or "not given")
        _add(item, "model", sensor.model or "not given")
        serial = ("manufacturer", "serial number", sensor.serial_number or "not given")
        _identifications(item, [serial])


def _persons(persons: ET.Element, responsible: str, operator: str) -> None:
    """Add who authorises, and who did the test."""
    people = [(responsible or "not given", "authorises the certificate", "true")]
    if operator:
        people.append((operator, "operator", "false"))
    for name, role, signs in people:
        person = _add(persons, "respPerson")
        _text(_add(person, "person"), "name", name)
        _add(person, "role", role)
        _add(person, "mainSigner", signs)


def _results(
    root: ET.Element,
    result: Result,
    about: Bench | None,
) -> None:
    found, settings = result.sources, result.settings
    table = CertificateTable() if about is None else about.certificate
    one = _add(_add(root, "measurementResults"), "measurementResult")
    _text(one, "name", "Self-noise")
    methods = _add(one, "usedMethods")
    method = _add(methods, "usedMethod")
    _text(method, "name", f"Huddle test, {result.method} method")
    _content(_add(method, "description"), certificate.PROCEDURE)
    if table.procedure:
        _add(method, "reference", table.procedure)
    stated = conformity(with_rule(found[0].bench, about), result)
    if stated:
        method = _add(methods, "usedMethod")
        _text(method, "name", "Decision rule")
        _content(_add(method, "description"), decision_rule(table, stated[0].k))
        _add(method, "norm", "ILAC-G8:09/2019")
        _add(method, "norm", "JCGM 106:2012")
    found_conditions = conditions(found, about, start=settings.start, end=settings.end)
    _conditions(_add(_add(one, "influenceConditions"), "influenceCondition"), found_conditions)
    results = _add(one, "results")
    whole = band_budgets(result)
    spectra = third_octave_budgets(result)
    if not whole:
        element = _add(results, "result")
        _text(element, "name", "Self-noise")
        _content(_add(_add(element, "data"), "text"), "Nothing can be said of the noise.")
        return
    name = f"Mean PSD over {span(*result.band)}"
    factor, unit = _in_si(result.snapshot.unit)
    for label, total, spectrum in zip(result.snapshot.channels, whole, spectra, strict=True):
        element = _add(results, "result")
        _text(element, "name", f"Self-noise of {label.sensor}.{label.channel}")
        data = _add(element, "data")
        _mean(data, total, name, factor, unit)
        if spectrum:
            _spectrum(data, spectrum, factor, unit)
        else:
            _content(_add(data, "text"), "No band of a third of an octave has both ends.")
        concerned = [e for e in stated if (e.sensor, e.channel) == (label.sensor, label.channel)]
        if concerned:
            _conformity(_add(data, "list"), concerned)


def _conditions(condition: ET.Element, stated: Sequence[Condition]) -> None:
    """Add the lowest and the highest of what devices and computer stated."""
    _text(condition, "name", "Conditions during the test")
    data = _add(condition, "data")
    for each in stated:
        if not isinstance(each.quantity, Quantity):
            continue
        name, unit = certificate.QUANTITIES[each.quantity], _STATED_IN[each.quantity]
        of = each.sensor or "the computer that recorded"
        for which, value in (("Lowest", each.lowest), ("Highest", each.highest)):
            quantity = _add(data, "quantity")
            _text(quantity, "name", f"{which} {name} of {of}")
            real = _si(quantity, "real")
            _si(real, "value", _number(value))
            _si(real, "unit", unit)
    for text in certificate.outside_range(stated):
        _content(_add(data, "text"), text)
    if not any(each.sensor and each.quantity == Quantity.TEMPERATURE for each in stated):
        _content(_add(data, "text"), "Temperature: not stated by the devices.")


def _mean(data: ET.Element, total: Budget, name: str, factor: float, unit: str) -> None:
    """Add the level over the band, where its interval has both ends."""
    low, high = total.interval
    if not all(map(math.isfinite, (total.value, low, high))):
        return
    quantity = _add(data, "quantity")
    _text(quantity, "name", name)
    real = _si(quantity, "real")
    _si(real, "value", _number(total.value * factor))
    _si(real, "unit", unit)
    interval = _si(real, "coverageInterval")
    _si(interval, "standardUnc", _number(factor * total.standard))
    _si(interval, "intervalMin", _number(factor * low))
    _si(interval, "intervalMax", _number(factor * high))
    _si(interval, "coverageProbability", "0.95")


def _spectrum(data: ET.Element, found: Sequence[Budget], factor: float, unit: str) -> None:
    """Add levels in thirds of an octave as lists with their intervals."""
    listed = _add(data, "list")
    _text(listed, "name", "PSD in bands of a third of an octave")
    quantity = _add(listed, "quantity")
    _text(quantity, "name", "Frequency, centre of the band")
    frequency = _si(quantity, "realListXMLList")
    _si(frequency, "valueXMLList", _numbers(math.sqrt(e.low * e.high) for e in found))
    _si(frequency, "unitXMLList", r"\hertz")
    quantity = _add(listed, "quantity")
    _text(quantity, "name", "Self-noise, one-sided PSD")
    values = _si(quantity, "realListXMLList")
    _si(values, "valueXMLList", _numbers((e.value for e in found), factor))
    _si(values, "unitXMLList", unit)
    interval = _si(values, "coverageIntervalXMLList")
    _si(interval, "standardUncXMLList", _numbers((e.standard for e in found), factor))
    _si(interval, "intervalMinXMLList", _numbers((e.interval[0] for e in found), factor))
    _si(interval, "intervalMaxXMLList", _numbers((e.interval[1] for e in found), factor))
    _si(interval, "coverageProbabilityXMLList", "0.95")


def _conformity(listed: ET.Element, stated: Iterable[Conformity]) -> None:
    """Add the statements on the limits in the words of the schema, with their risks."""
    _text(listed, "name", "Conformity")
    for each in stated:
        quantity = _add(listed, "quantity")
        _text(quantity, "name", f"Probability that the noise is above {each.limit} in any band")
        if math.isfinite(each.risk):
            real = _si(quantity, "real")
            _si(real, "value", _number(each.risk))
            _si(real, "unit", r"\one")
        else:
            _content(_add(quantity, "noQuantity"), "not known")
        meta = _add(_add(quantity, "measurementMetaData"), "metaData")
        said = _STATED.get(each.statement, "no statement")
        _content(_add(meta, "declaration"), f"{each.limit}: {said}")
        if each.statement in _STATED:
            _add(meta, "conformity", _STATED[each.statement])


def _in_si(unit: str) -> tuple[float, str]:
    """Return what a PSD is multiplied by to be in an SI unit, and that unit in the D-SI."""
    found = in_si(unit)
    if found is None:
        return 1.0, r"\one\hertz\tothe{-1}"
    return found[0] ** 2, _UNITS[found[1]]


def _contact(part: ET.Element, who: tuple[str, str], *, email: str, phone: str = "") -> None:
    """Add name and address, and how to reach them."""
    name, address = who
    _text(part, "name", name or "not given")
    _add(part, "eMail", email or "not given")
    if phone:
        _add(part, "phone", phone)
    _content(_add(_add(part, "location"), "further"), address or "not given")


def _identifications(part: ET.Element, entries: Sequence[tuple[str, str, str]]) -> None:
    listed = _add(part, "identifications")
    for issuer, name, value in entries:
        entry = _add(listed, "identification")
        _add(entry, "issuer", issuer)
        _add(entry, "value", value)
        _text(entry, "name", name)


def _text(part: ET.Element, name: str, text: str) -> None:
    """Add an element of the type of texts in languages."""
    _content(_add(part, name), text)


def _content(part: ET.Element, text: str) -> None:
    _add(part, "content", text).set("lang", _LANGUAGE)


def _add(part: ET.Element, name: str, text: str | None = None) -> ET.Element:
    element = ET.SubElement(part, _dcc(name))
    element.text = None if text is None else _printable(text)
    return element


def _si(part: ET.Element, name: str, text: str | None = None) -> ET.Element:
    element = ET.SubElement(part, f"{{{SI}}}{name}")
    element.text = text
    return element


def _dcc(name: str) -> str:
    return f"{{{DCC}}}{name}"


def _printable(text: str) -> str:
    """Return a text without the characters that XML does not have."""
    return "".join(c for c in text if c in "\t\n" or c.isprintable() or ord(c) >= 0xA0)


def _number(value: float) -> str:
    return f"{value:.8g}"


def _numbers(values: Iterable[float], factor: float = 1.0) -> str:
    return " ".join(_number(factor * value) for value in values)
