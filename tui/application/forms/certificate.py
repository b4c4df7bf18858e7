"""The form for all that a certificate asks of its user; it stays in the bench file."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from datetime import date

from pydantic import BaseModel, ValidationError

from daq.bench.editing import with_values
from daq.bench.tables.certificate import CertificateTable, Customer, Laboratory, Rule
from estimator.wording import listed
from tui.application.forms.form import Field, Form

TABLES: Mapping[str, type[BaseModel]] = {
    "laboratory": Laboratory,
    "customer": Customer,
    "certificate": CertificateTable,
}
HINTS = {
    "operator": "Who does the test.",
    "laboratory-name": "Who issues the certificate (ISO/IEC 17025, 7.8.2.1 b).",
    "laboratory-address": "Street, place and country of the laboratory (7.8.2.1 b).",
    "laboratory-country": "Two letters of ISO 3166, such as DE.",
    "laboratory-email": "How to reach the laboratory.",
    "laboratory-phone": "How to reach the laboratory.",
    "laboratory-accreditation": "Body and number of the accreditation. Empty without one.",
    "customer-name": "For whom the test is done (7.8.2.1 e).",
    "customer-address": "Address of the customer, or give an e-mail (7.8.2.1 e).",
    "customer-email": "How to reach the customer.",
    "customer-order": "Number of the order.",
    "certificate-prefix": "Start of the numbers: HT gives HT-2026-0001.",
    "certificate-folder": "Folder of the certificates, relative to the recording.",
    "certificate-procedure": "Number and issue of the laboratory's procedure (7.8.2.1 f).",
    "certificate-place": "Where the test is done, if not the location of the bench (7.8.2.1 c).",
    "certificate-received": "When the sensors arrived, such as 2026-11-20 (7.8.2.1 h).",
    "certificate-condition": "Of the sensors as received (7.8.2.1 g).",
    "certificate-traceability": "How sensitivities and times are traceable to the SI (7.8.4.1 c).",
    "certificate-deviations": "From the procedure (7.8.2.1 n). Empty without any.",
    "certificate-responsible": "Who authorises certificates (7.8.2.1 o); or huddle issue --by.",
    "certificate-decision_rule": f"One of {listed([str(rule) for rule in Rule])} (ILAC-G8).",
    "certificate-guard_band": "r of the guard band w = r·U. Empty: 1, the rule of ILAC-G8.",
}
"""Fields in their order, each with what it means."""


class CertificateForm(Form[str]):
    """Asks for operator, laboratory, customer and certificate; returns the text of the bench file.

    Parameters
    ----------
    text : str
        Of the bench file. Comments, and what is not asked for, stay.
    """

    HINTS = HINTS

    def __init__(self, text: str) -> None:
        self._text = text
        given = tomllib.loads(text)
        fields = [
            Field(name, name.replace("-", " ").replace("_", " "), _shown(given, name))
            for name in HINTS
        ]
        super().__init__("certificate", fields, does="saves")

    def problem(self, name: str) -> str:
        """Return what is wrong with a field; empty if nothing is."""
        table, _, key = name.partition("-")
        value = self._value(name)
        if not key or value is None:
            return ""
        try:
            TABLES[table].model_validate({key: value})
        except ValidationError as error:
            reason = error.errors()[0]["msg"].removeprefix("Value error, ")
            return f"{key}: {reason[:1].lower()}{reason[1:]}"
        return ""

    def submit(self) -> None:
        """Save."""
        values: dict[str, object] = {"operator": self.value("operator") or None}
        for table in TABLES:
            names = [name for name in HINTS if name.startswith(f"{table}-")]
            own = {name.partition("-")[2]: self._value(name) for name in names}
            if any(value is not None for value in own.values()) or table in tomllib.loads(
                self._text
            ):
                values[table] = own
        self.dismiss(with_values(self._text, values))

    def _value(self, name: str) -> object:
        """Return what was typed as the bench file has it; None if it is empty."""
        text = self.value(name)
        if not text:
            return None
        try:
            if name == "certificate-received":
                return date.fromisoformat(text)
            if name == "certificate-guard_band":
                return float(text)
        except ValueError:
            pass
        return text


def _shown(given: Mapping[str, object], name: str) -> str:
    table, _, key = name.partition("-")
    of = given.get(table, "")
    if not key:
        return str(of)
    return str(of.get(key, "")) if isinstance(of, dict) else ""
