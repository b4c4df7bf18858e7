"""What is known of a channel's sensitivity: by its certificate, its tolerance and its temperature.

All are relative to the sensitivity itself. A certificate states a standard uncertainty; a tolerance
and a coefficient of temperature are limits, whose standard uncertainty is that of a rectangular
distribution (JCGM 100:2008, 4.3.7).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from typing import Any, TypeAlias

from estimator.records import dataclass

REFERENCE_TEMPERATURE = 23.0
"""In °C, at which a sensitivity holds where the data sheet states no other."""
_RECTANGULAR = math.sqrt(3.0)


@dataclass(frozen=True, slots=True)
class KnownSensitivity:
    """What is known of one channel's sensitivity.

    Attributes
    ----------
    own : float
        Relative standard uncertainty by the certificate, or else by the tolerance; 0 without. A
        difference of the certificate, which is not corrected, adds by squares in full, so that
        95 % intervals hold whatever its size.
    is_certified : bool
        Whether a certificate states it.
    off : float
        The sensitivity that is used over that of the certificate, less 1.
    coefficient : float
        Largest change of the sensitivity with temperature, in 1/°C; 0 where not stated.
    reference : float
        Temperature in °C at which the sensitivity holds.
    temperatures : (float, float)
        Lowest and highest temperature of the sensor in °C: those of its readings, or else the
        range of the data sheet.
    used : (float, float) or ()
        Smallest and largest sensitivity by which recordings are divided, counts per unit; empty
        where not known.
    """

    own: float = 0.0
    is_certified: bool = False
    off: float = 0.0
    coefficient: float = 0.0
    reference: float = REFERENCE_TEMPERATURE
    temperatures: tuple[float, float] = (REFERENCE_TEMPERATURE, REFERENCE_TEMPERATURE)
    used: tuple[float, ...] = ()

    @property
    def is_stated(self) -> bool:
        """Whether certificate or tolerance state an uncertainty."""
        return self.own > 0

    @property
    def spread(self) -> float:
        """Relative difference of the sensitivities of recordings."""
        return (max(self.used) - min(self.used)) / max(map(abs, self.used)) if self.used else 0.0

    @property
    def by_temperature(self) -> float:
        """Relative standard uncertainty by the temperature."""
        farthest = max(abs(each - self.reference) for each in self.temperatures)
        return self.coefficient * farthest / _RECTANGULAR

    @property
    def combined(self) -> float:
        """Relative standard uncertainty by all causes."""
        return math.hypot(self.own, self.by_temperature)

    def joined(self, other: KnownSensitivity) -> KnownSensitivity:
        """Return what both allow."""
        ends, used = (*self.temperatures, *other.temperatures), self.used + other.used
        return replace(
            max(self, other, key=lambda each: each.own),
            is_certified=self.is_certified and other.is_certified,
            used=(min(used), max(used)) if used else (),
            coefficient=max(self.coefficient, other.coefficient),
            temperatures=(min(ends), max(ends)),
        )

    def at(self, readings: tuple[float, float] | None) -> KnownSensitivity:
        """Return it at the lowest and highest temperature that was read; None: none was."""
        return self if readings is None else replace(self, temperatures=readings)


Sensitivities: TypeAlias = Mapping[tuple[str, str], KnownSensitivity]
"""By names of sensor and channel."""


def as_document(known: Sensitivities) -> list[tuple[str, str, dict[str, Any]]]:
    """Return sensitivities as JSON has them."""
    return [(*names, asdict(each)) for names, each in known.items()]


def sensitivities_from(document: Iterable[Any]) -> Sensitivities:
    """Return the sensitivities of a document."""
    return {
        (sensor, channel): KnownSensitivity(
            **each
            | {"temperatures": tuple(each["temperatures"]), "used": tuple(each.get("used", ()))}
        )
        for sensor, channel, each in document
    }


def joined(several: Iterable[Sensitivities]) -> Sensitivities:
    """Return what all recordings allow."""
    found: dict[tuple[str, str], KnownSensitivity] = {}
    for each in several:
        for names, known in each.items():
            found[names] = known.joined(found.get(names, known))
    return found


def known_sensitivities(table: Mapping[str, Any]) -> Sensitivities:
    """Return what a bench file knows of its sensitivities.

    Parameters
    ----------
    table : mapping
        The bench file, checked before.
    """
    return {
        (sensor["name"], channel["name"]): _known(channel, sensor.get("data_sheet") or {})
        for sensor in table["sensors"]
        for channel in sensor["channels"]
    }


def _known(channel: Mapping[str, Any], sheet: Mapping[str, Any]) -> KnownSensitivity:
    own, off = float(channel.get("tolerance", 0.0)) / _RECTANGULAR, 0.0
    certificate = channel.get("certificate")
    if certificate is not None:
        value = float(certificate["value"])
        off = float(channel["sensitivity"]) / value - 1
        relative = float(certificate["expanded_uncertainty"]) / abs(value)
        own = math.hypot(relative / certificate.get("k", 2.0), off)
    reference = float(sheet.get("reference_temperature", REFERENCE_TEMPERATURE))
    is_for = not sheet.get("channels") or channel["name"] in sheet["channels"]
    low, high = sheet.get("temperature", (reference, reference))
    return KnownSensitivity(
        own=own,
        is_certified=certificate is not None,
        off=off,
        coefficient=float(sheet.get("temperature_coefficient", 0.0)) if is_for else 0.0,
        reference=reference,
        temperatures=(float(low), float(high)),
        used=(float(channel["sensitivity"]),) * 2,
    )
