"""Tables of the bench file for certificates: who tests, for whom, and how certificates are made."""

from __future__ import annotations

import datetime as dt
import enum
import re
from pathlib import Path
from typing import Annotated, TypeAlias

from pydantic import AfterValidator, Field

from daq.bench.tables.fields import BenchTable

Day: TypeAlias = dt.date
_PREFIX = re.compile(r"[A-Za-z0-9][A-Za-z0-9.]{0,15}", re.ASCII)

_COUNTRY = re.compile(r"[A-Z]{2}", re.ASCII)


class Rule(enum.StrEnum):
    """Decision rules of ILAC-G8:09/2019."""

    SIMPLE_ACCEPTANCE = "simple-acceptance"
    """4.2.1: pass at or below the limit, whatever the uncertainty."""
    GUARD_BAND_BINARY = "guard-band-binary"
    """4.2.2: pass where the guard band below the limit is kept, else fail."""
    GUARD_BAND = "guard-band"
    """4.2.3: pass, conditional pass, conditional fail, fail."""


def _prefix(value: str) -> str:
    if not _PREFIX.fullmatch(value):
        raise ValueError('expected 1 to 16 letters, digits and dots, such as "LAB"')
    return value


def _country(value: str) -> str:
    if value and not _COUNTRY.fullmatch(value):
        raise ValueError('expected the two capital letters of ISO 3166, such as "DE"')
    return value


class Laboratory(BenchTable):
    """``[laboratory]``: who issues the certificate."""

    name: str = ""
    address: str = ""
    country: Annotated[str, AfterValidator(_country)] = ""
    """ISO 3166 code, such as ``DE``."""
    email: str = ""
    phone: str = ""
    accreditation: str = ""
    """Text of the accreditation, such as its body and number; empty without one."""


class Customer(BenchTable):
    """``[customer]``: for whom the test is done."""

    name: str = ""
    address: str = ""
    email: str = ""
    order: str = ""
    """Number of the order."""


class CertificateTable(BenchTable):
    """``[certificate]``: how certificates are numbered, and what they state."""

    prefix: Annotated[str, AfterValidator(_prefix)] = "HT"
    """Start of the numbers, as in ``HT-2026-0042``."""
    folder: Path = Path("certificates")
    """Folder of the certificates and of their ledger; relative to the recording."""
    procedure: str = ""
    """Number and issue of the laboratory's procedure."""
    place: str = ""
    """Where the test was done, if not at the address of the laboratory."""
    received: Day | None = None
    """When the sensors arrived."""
    condition: str = ""
    """Of the sensors as received."""
    traceability: str = ""
    """How sensitivities and times are traceable to the SI."""
    deviations: str = ""
    """From the procedure."""
    responsible: str = ""
    """Who authorises certificates."""
    decision_rule: Rule = Rule.GUARD_BAND
    """Of ILAC-G8:09/2019: simple acceptance (4.2.1), guard band with two statements (4.2.2) or
    with four (4.2.3)."""
    guard_band: Annotated[float, Field(ge=0.0)] = 1.0
    """r of the guard band w = r·U; 1 is the rule of ILAC-G8."""
