"""Units of ground motion and of noise density, and the way from one to another."""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from daq.errors import WrongSettingError
from estimator.records import dataclass

STANDARD_GRAVITY = 9.80665
"""In m/s²."""

# unit → (time derivatives of displacement, SI units in one of it)
_MOTION = {
    "m/s²": (2, 1.0),
    "mm/s²": (2, 1e-3),
    "g": (2, STANDARD_GRAVITY),
    "mg": (2, STANDARD_GRAVITY * 1e-3),
    "µg": (2, STANDARD_GRAVITY * 1e-6),
    "ng": (2, STANDARD_GRAVITY * 1e-9),
    "Gal": (2, 1e-2),
    "m/s": (1, 1.0),
    "mm/s": (1, 1e-3),
    "µm/s": (1, 1e-6),
    "nm/s": (1, 1e-9),
    "m": (0, 1.0),
    "mm": (0, 1e-3),
    "µm": (0, 1e-6),
    "nm": (0, 1e-9),
}
_SPELLINGS = {
    **{unit: unit for unit in ("m/s²", "m/s", "m")},
    **{unit.replace("µ", "u"): unit for unit in _MOTION if "µ" in unit},
    "gal": "Gal",
    "cm/s²": "Gal",
}
"""By what they are in small letters, where those cannot be mistaken."""
_CF = {
    **{unit: unit.replace("/s²", " s-2").replace("/s", " s-1") for unit in _MOTION},
    "g": "standard_free_fall",  # "g" is a gram there
    "mg": "1e-3 standard_free_fall",
    "µg": "1e-6 standard_free_fall",
    "ng": "1e-9 standard_free_fall",
    "Gal": "cm s-2",
    "counts": "count",
}
_FROM_CF = {spelled: unit for unit, spelled in _CF.items()}
"""Units as the CF conventions (UDUNITS) spell them, and back."""


def canonical(unit: str) -> str:
    """Return the unit as this program spells it: ``M/S^2`` and ``m s-2`` are ``m/s²``."""
    powers = " ".join(unit.replace("^-", "-").replace("**-", "-").replace("μ", "µ").split())
    if powers in _FROM_CF:
        return _FROM_CF[powers]
    spelled = unit.strip().replace("**2", "²").replace("^2", "²").replace("s2", "s²")
    spelled = spelled.replace("S**2", "²").replace("S2", "S²").replace("μ", "µ")
    if spelled in _MOTION:
        return spelled
    return _SPELLINGS.get(spelled.lower(), spelled)


def cf_unit(unit: str) -> str:
    """Return a unit as the CF conventions spell it, ``m s-2``; one that is not known as it is."""
    return _CF.get(canonical(unit), unit)


def is_motion(unit: str) -> bool:
    """Return whether a unit is one of displacement, velocity or acceleration."""
    return canonical(unit) in _MOTION


def decibels(psd: float) -> float:
    """Return 10 log10 of a PSD; NaN where it is not positive."""
    return 10 * math.log10(psd) if psd > 0 else math.nan


def levels_db(psd: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 10 log10 of every PSD, of the same shape; NaN where it is not positive."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(10 * np.log10(np.where(psd > 0, psd, np.nan)))


def in_acceleration(unit: str) -> float | None:
    """Return how many m/s² one of a unit is; None if it is no unit of acceleration."""
    derivatives, si = _MOTION.get(canonical(unit), (0, 1.0))
    return si if derivatives == 2 else None


def order_of(unit: str) -> int:
    """Return which time derivative of displacement a unit is of; other units count as of 2."""
    return _MOTION.get(canonical(unit), (2, 1.0))[0]


def in_si(unit: str) -> tuple[float, str] | None:
    """Return how many SI units one of a unit of motion is, and which; None of other units."""
    derivatives, si = _MOTION.get(canonical(unit), (-1, 1.0))
    return (si, ("m", "m/s", "m/s²")[derivatives]) if derivatives >= 0 else None


def conversion(unit: str, wanted: str, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return what spectra in `unit` are multiplied by to be in `wanted`.

    Parameters
    ----------
    unit, wanted : str
    frequency : float64, shape (n_freqs,)
        In Hz.

    Returns
    -------
    complex128, shape (n_freqs,)
        Infinite at 0 Hz where integration is needed.

    Raises
    ------
    WrongSettingError
        If one cannot become the other.
    """
    unit, wanted = canonical(unit), canonical(wanted)
    if unit == wanted:
        return np.ones(len(frequency), dtype=np.complex128)
    if unit not in _MOTION or wanted not in _MOTION:
        raise WrongSettingError(
            f"unit {unit!r} cannot be turned into {wanted!r};"
            f" among each other can: {', '.join(_MOTION)}"
        )
    derivatives, si = _MOTION[unit]
    wanted_derivatives, wanted_si = _MOTION[wanted]
    with np.errstate(divide="ignore", invalid="ignore"):
        power = (2j * np.pi * frequency) ** (wanted_derivatives - derivatives)
    return np.asarray(power * (si / wanted_si), dtype=np.complex128)


_FORMS = "such as µg/√Hz, (m/s²)²/Hz, g²/Hz or dB re 1 (m/s²)²/Hz"
_LEVEL = re.compile(r"dB\b(?:\s*(?:re|rel|ref|relative to)\b\.?)?(?:\s+1\b)?\s*(.*)")
_ROOT = re.compile(r"(\(.+\)|.+?)\s*/\s*(?:√\s*Hz|rt\s*Hz|sqrt\(Hz\)|Hz(?:\^|\*\*)0\.5)")
_SQUARE = re.compile(r"(\(.+\)|[^()/]+?)\s*(?:²|\^2|\*\*2)\s*/\s*Hz")
_ACCELERATION = re.compile(r"m(?:²|\^2|\*\*2)/s(?:⁴|\^4|\*\*4)/Hz")


@dataclass(frozen=True, slots=True)
class DensityUnit:
    """Unit of the numbers of a noise density.

    Attributes
    ----------
    unit : str
        Of the motion.
    is_root : bool
        Whether the numbers are roots of a PSD, per √Hz.
    is_level : bool
        Whether they are in dB.
    """

    unit: str
    is_root: bool = False
    is_level: bool = False

    @classmethod
    def parse(cls, text: str) -> DensityUnit:
        """Read a unit such as ``µg/√Hz`` or ``dB re 1 (m/s²)²/Hz``.

        Raises
        ------
        ValueError
            With the forms that are known.
        """
        level = _LEVEL.fullmatch(text.strip())
        inner = text.strip() if level is None else level[1]
        if not inner:
            raise ValueError(f"{text!r}: expected what 0 dB is, {_FORMS}")
        if _ACCELERATION.fullmatch(inner):
            return cls("m/s²", is_level=level is not None)
        square, root = _SQUARE.fullmatch(inner), _ROOT.fullmatch(inner)
        found = square or root
        if found is None:
            raise ValueError(f"{text!r}: expected a unit of noise density, {_FORMS}")
        unit = canonical(found[1].removeprefix("(").removesuffix(")"))
        return cls(unit, is_root=square is None, is_level=level is not None)

    def psd(self, value: float) -> float:
        """Return a number in this unit as a PSD in unit**2/Hz."""
        if self.is_level:
            return float(10 ** (value / 10))
        return value**2 if self.is_root else value
