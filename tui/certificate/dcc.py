"""The certificate as a Digital Calibration Certificate (DCC 3.1.2, PTB) with units of the D-SI.

The numbers are those of the report: levels of `daq.results.band_summary`, statements of
`daq.results.decision.conformity`. Intervals are given as they are, with both ends. A band whose
interval has no upper end has no place in the schema's lists and is left out.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from importlib.metadata import version
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeAlias

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
    from collections.abc import Iterable, Mapping, Sequence

    from daq.bench.model import Bench
    from daq.results.result import Result

Content: TypeAlias = "str | dict[str, Content] | list[Content] | None"
"""Of an element: a text, or elements by their names; of several, or none. `si:` is of the D-SI."""
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
    about = result.sources[0].bench if about is None else about
    root = ET.Element(_qualified("digitalCalibrationCertificate"), schemaVersion=SCHEMA_VERSION)
    _add(root, "administrativeData", _administrative(result.sources, about, issue))
    _add(root, "measurementResults", {"measurementResult": _measured(result, about)})
    ET.indent(root)
    content: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return content + b"\n"


def _administrative(
    found: Sequence[Source], about: Bench | None, issue: certificate.Issue | None
) -> Content:
    laboratory = Laboratory() if about is None else about.laboratory
    customer = Customer() if about is None else about.customer
    table = CertificateTable() if about is None else about.certificate
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
    responsible = (issue.by if issue else table.responsible) or "not given"
    people = [(responsible, "authorises the certificate", "true")]
    if operator := found[0].recording.operator:
        people.append((operator, "operator", "false"))
    software = {"name": _said("huddle"), "release": version("huddle-bench")}
    return {
        "dccSoftware": {"software": software},
        "coreData": {
            "countryCodeISO3166_1": laboratory.country or _NO_COUNTRY,
            "usedLangCodeISO639_1": _LANGUAGE,
            "mandatoryLangCodeISO639_1": _LANGUAGE,
            **_core(found, table, issue, order=customer.order),
        },
        "items": {"item": _items(found[-1], about)},
        "calibrationLaboratory": {"contact": _contact(laboratory, laboratory.phone)},
        "respPersons": {
            "respPerson": [
                {"person": {"name": _said(name)}, "role": role, "mainSigner": signs}
                for name, role, signs in people
            ]
        },
        "customer": _contact(customer),
        "statements": {"statement": [{"declaration": _said(line)} for line in lines]},
    }


def _core(
    found: Sequence[Source], table: CertificateTable, issue: certificate.Issue | None, *, order: str
) -> dict[str, Content]:
    """Return number, dates, and what the certificate is of and replaces."""
    first, last = found[0], found[-1]
    known = [("other", "SHA-256 of the recording", each.sha256 or "none") for each in found]
    if order:
        known.append(("customer", "order", order))
    if issue is not None and issue.entry:
        known.append(("calibrationLaboratory", "entry of the ledger", issue.entry))
    is_elsewhere = table.place or first.recording.location
    before: Content = None
    if issue is not None and issue.replaces is not None:
        before = {
            "referral": _said(issue.reason),
            "referralID": f"{issue.number}, revision {issue.replaces}",
            "procedure": "SHA-256",
            "value": issue.replaces_sha256,
        }
    return {
        "uniqueIdentifier": issue.name if issue else f"DRAFT {first.recording.run_id}",
        "identifications": _identifications(*known),
        "receiptDate": None if table.received is None else table.received.isoformat(),
        "beginPerformanceDate": f"{first.started:%Y-%m-%d}",
        "endPerformanceDate": f"{last.last:%Y-%m-%d}",
        "performanceLocation": "other" if is_elsewhere else "laboratory",
        "previousReport": before,
    }


def _items(last: Source, about: Bench | None) -> list[Content]:
    """Return the sensors."""
    condition = "" if about is None else about.certificate.condition
    makers = certificate.manufacturers(about)
    return [
        {
            "name": _said(sensor.name),
            "description": _said(f"Condition: {condition}") if condition else None,
            "manufacturer": {"name": _said(makers.get(sensor.name) or "not given")},
            "model": sensor.model or "not given",
            "identifications": _identifications(
                ("manufacturer", "serial number", sensor.serial_number or "not given")
            ),
        }
        for sensor in last.recording.sensors
    ]


def _measured(result: Result, about: Bench | None) -> Content:
    found, settings = result.sources, result.settings
    table = CertificateTable() if about is None else about.certificate
    name, by = f"Huddle test, {result.method} method", table.procedure or None
    description = _said(certificate.PROCEDURE)
    methods: list[Content] = [{"name": _said(name), "description": description, "reference": by}]
    stated = conformity(with_rule(found[0].bench, about), result)
    if stated:
        rule = _said(decision_rule(table, stated[0].k))
        norms: list[Content] = ["ILAC-G8:09/2019", "JCGM 106:2012"]
        methods.append({"name": _said("Decision rule"), "description": rule, "norm": norms})
    found_conditions = conditions(found, about, start=settings.start, end=settings.end)
    results: list[Content] = []
    name = f"Mean PSD over {span(*result.band)}"
    factor, unit = _in_si(result.snapshot.unit)
    whole = band_budgets(result)
    labels = result.snapshot.channels if whole else ()
    for label, total, spectrum in zip(labels, whole, third_octave_budgets(result), strict=True):
        own = [e for e in stated if (e.sensor, e.channel) == (label.sensor, label.channel)]
        lists = [_spectrum(spectrum, factor, unit)] if spectrum else []
        nothing = "No band of a third of an octave has both ends."
        data: Content = {
            "quantity": _mean(total, name, factor, unit),
            "text": None if spectrum else _said(nothing),
            "list": [*lists, *([_conformity(own)] if own else [])],
        }
        results.append(
            {"name": _said(f"Self-noise of {label.sensor}.{label.channel}"), "data": data}
        )
    unknown: Content = {"text": _said("Nothing can be said of the noise.")}
    return {
        "name": _said("Self-noise"),
        "usedMethods": {"usedMethod": methods},
        "influenceConditions": {"influenceCondition": _conditions(found_conditions)},
        "results": {"result": results or {"name": _said("Self-noise"), "data": unknown}},
    }


def _conditions(stated: Sequence[Condition]) -> Content:
    """Return the lowest and the highest of what devices and computer stated."""
    quantities: list[Content] = []
    for each in stated:
        if not isinstance(each.quantity, Quantity):
            continue
        name, unit = certificate.QUANTITIES[each.quantity], _STATED_IN[each.quantity]
        of = each.sensor or "the computer that recorded"
        for which, value in (("Lowest", each.lowest), ("Highest", each.highest)):
            quantities.append(_real(f"{which} {name} of {of}", value, unit))
    texts = certificate.outside_range(stated)
    if not any(each.sensor and each.quantity == Quantity.TEMPERATURE for each in stated):
        texts.append("Temperature: not stated by the devices.")
    data: Content = {"quantity": quantities, "text": [_said(text) for text in texts]}
    return {"name": _said("Conditions during the test"), "data": data}


def _mean(total: Budget, name: str, factor: float, unit: str) -> Content:
    """Return the level over the band, where its interval has both ends."""
    low, high = total.interval
    if not all(map(math.isfinite, (total.value, low, high))):
        return None
    interval: Content = {
        "si:standardUnc": _number(factor * total.standard),
        "si:intervalMin": _number(factor * low),
        "si:intervalMax": _number(factor * high),
        "si:coverageProbability": "0.95",
    }
    return _real(name, total.value * factor, unit, {"si:coverageInterval": interval})


def _spectrum(found: Sequence[Budget], factor: float, unit: str) -> Content:
    """Return levels in thirds of an octave as lists with their intervals."""
    frequencies: Content = {
        "si:valueXMLList": _numbers(math.sqrt(e.low * e.high) for e in found),
        "si:unitXMLList": r"\hertz",
    }
    levels: Content = {
        "si:valueXMLList": _numbers((e.value for e in found), factor),
        "si:unitXMLList": unit,
        "si:coverageIntervalXMLList": {
            "si:standardUncXMLList": _numbers((e.standard for e in found), factor),
            "si:intervalMinXMLList": _numbers((e.interval[0] for e in found), factor),
            "si:intervalMaxXMLList": _numbers((e.interval[1] for e in found), factor),
            "si:coverageProbabilityXMLList": "0.95",
        },
    }
    both = (("Frequency, centre of the band", frequencies), ("Self-noise, one-sided PSD", levels))
    return {
        "name": _said("PSD in bands of a third of an octave"),
        "quantity": [{"name": _said(name), "si:realListXMLList": each} for name, each in both],
    }


def _conformity(stated: Iterable[Conformity]) -> Content:
    """Return the statements on the limits in the words of the schema, with their risks."""
    quantities: list[Content] = []
    for each in stated:
        name = f"Probability that the noise is above {each.limit} in any band"
        quantity = {"name": _said(name), "noQuantity": _said("not known")}
        if math.isfinite(each.risk):
            quantity = _real(name, each.risk, r"\one")
        word = _STATED.get(each.statement)
        declared = _said(f"{each.limit}: {word or 'no statement'}")
        meta: Content = {"metaData": {"declaration": declared, "conformity": word}}
        quantities.append(quantity | {"measurementMetaData": meta})
    return {"name": _said("Conformity"), "quantity": quantities}


def _in_si(unit: str) -> tuple[float, str]:
    """Return what a PSD is multiplied by to be in an SI unit, and that unit in the D-SI."""
    found = in_si(unit)
    if found is None:
        return 1.0, r"\one\hertz\tothe{-1}"
    return found[0] ** 2, _UNITS[found[1]]


def _contact(who: Laboratory | Customer, phone: str = "") -> Content:
    """Return name and address, and how to reach them."""
    return {
        "name": _said(who.name or "not given"),
        "eMail": who.email or "not given",
        "phone": phone or None,
        "location": {"further": _said(who.address or "not given")},
    }


def _identifications(*entries: tuple[str, str, str]) -> Content:
    return {
        "identification": [
            {"issuer": issuer, "value": value, "name": _said(name)}
            for issuer, name, value in entries
        ]
    }


def _real(
    name: str, value: float, unit: str, more: Mapping[str, Content] = MappingProxyType({})
) -> dict[str, Content]:
    """Return a quantity of one number."""
    real: Content = {"si:value": _number(value), "si:unit": unit, **more}
    return {"name": _said(name), "si:real": real}


def _said(text: str) -> Content:
    """Return an element of the type of texts in languages."""
    return {"content": text}


def _add(part: ET.Element, name: str, content: Content) -> None:
    """Add elements of a name to another one: as many as there are contents."""
    for each in content if isinstance(content, list) else [content]:
        if each is None:
            continue
        element = ET.SubElement(part, _qualified(name))
        if isinstance(each, str):
            element.text = _printable(each)
            if name == "content":
                element.set("lang", _LANGUAGE)
        elif isinstance(each, dict):
            for inner, inside in each.items():
                _add(element, inner, inside)


def _qualified(name: str) -> str:
    own = name.removeprefix("si:")
    return f"{{{DCC if own == name else SI}}}{own}"


def _printable(text: str) -> str:
    """Return a text without the characters that XML does not have."""
    return "".join(c for c in text if c in "\t\n" or c.isprintable() or ord(c) >= 0xA0)


def _number(value: float) -> str:
    return f"{value:.8g}"


def _numbers(values: Iterable[float], factor: float = 1.0) -> str:
    return " ".join(_number(factor * value) for value in values)
