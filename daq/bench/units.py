"""Units of ground motion, and the way from one to another through powers of iω."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daq.errors import WrongSettingError

if TYPE_CHECKING:
    from numpy.typing import NDArray

# unit → (time derivatives of displacement, SI units in one of it)
_MOTION = {
    "m/s²": (2, 1.0),
    "mm/s²": (2, 1e-3),
    "g": (2, 9.80665),
    "mg": (2, 9.80665e-3),
    "µg": (2, 9.80665e-6),
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


def canonical(unit: str) -> str:
    """Return the unit as this program spells it: ``M/S^2`` is ``m/s²``, ``ug`` is ``µg``."""
    spelled = unit.strip().replace("**2", "²").replace("^2", "²").replace("s2", "s²")
    spelled = spelled.replace("S**2", "²").replace("S2", "S²").replace("μ", "µ")
    if spelled in _MOTION:
        return spelled
    return _SPELLINGS.get(spelled.lower(), spelled)


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
