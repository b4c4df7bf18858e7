"""A channel as recordings hold it: plain, so that opening one loads no validation.

The table of a bench file is checked by `daq.bench.model`, which makes these of it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from estimator.records import dataclass

if TYPE_CHECKING:
    import datetime as dt

    from daq.bench.response import PolesZeros, Response


def check_name(value: str) -> str:
    """Return a name that a sensor, a channel, a limit or a bench may have.

    Raises
    ------
    ValueError
        Saying what was expected.
    """
    if value in {".", ".."} or "/" in value or not value.isprintable() or value != value.strip():
        raise ValueError("expected a printable name without '/' and outer spaces")
    if not 0 < len(value.encode()) <= 64:
        raise ValueError("expected a name of 1 to 64 bytes")
    return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """Calibration of a channel by a laboratory.

    Attributes
    ----------
    value, expanded_uncertainty : float
        The sensitivity and its expanded uncertainty, in counts per unit.
    k : float
        Coverage factor of the expanded uncertainty.
    date : date or None
    number : str
        Of the certificate.
    """

    value: float
    expanded_uncertainty: float
    k: float = 2.0
    date: dt.date | None = None
    number: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """One digitised input.

    Attributes
    ----------
    name : str
    sensitivity : float
        In counts per unit, not zero.
    unit : str
    direction : str or None
    response : PolesZeros, Response or None
        Poles and zeros, as the bench file has them, or the whole response of an imported file.
    tolerance : float or None
        Of the sensitivity, as a fraction of it, by the data sheet.
    certificate : Certificate or None
        A sensor with one for each channel is the reference of ``huddle calibrate``.
    auxiliary : bool
        Recorded but not part of the huddle test (temperature, …).

    Raises
    ------
    ValueError
        If the name or the sensitivity is none; what a damaged recording holds is not used.
    """

    name: str
    sensitivity: float
    unit: str = "m/s²"
    direction: str | None = None
    response: PolesZeros | Response | None = None
    tolerance: float | None = None
    certificate: Certificate | None = None
    auxiliary: bool = False

    def __post_init__(self) -> None:
        check_name(self.name)
        if not self.sensitivity or not math.isfinite(self.sensitivity):
            raise ValueError("sensitivity: expected counts per unit, not zero")
