"""Noise masks: PSDs against frequency, published ones and those of data sheets, in any unit.

Published models of the ground's noise, in (m/s²)²/Hz:

- NLNM and NHNM: J. Peterson, "Observations and modeling of seismic background noise", U.S.
  Geological Survey Open-File Report 93-322 (1993), tables 3 and 4.
- ALNM and AHNM, of quiet and noisy strong-motion stations: C. Cauzzi and J. Clinton, "A high- and
  low-noise model for high-quality strong-motion accelerometer stations", Earthquake Spectra 29
  (2013) 85-102, doi:10.1193/1.4000107.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from daq.bench.units import canonical, conversion

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Mask:
    """A PSD against frequency, straight between its points where both axes are logarithmic.

    Attributes
    ----------
    name : str
    unit : str or None
        Unit of motion; None for that of the channel it is beside.
    frequency : tuple of float
        Rising, in Hz.
    psd : tuple of float
        One-sided, in unit**2/Hz.
    """

    name: str
    unit: str | None
    frequency: tuple[float, ...]
    psd: tuple[float, ...]

    def at(self, frequency: FloatArray, unit: str, *, of_channel: str | None = None) -> FloatArray:
        """Return the PSD in `unit` squared per Hz; NaN outside of the mask.

        Parameters
        ----------
        frequency : float64, shape (n,)
            In Hz.
        unit : str
        of_channel : str or None
            Unit of a mask that has none of its own; `unit`, if not given.

        Raises
        ------
        WrongSettingError
            If the unit of the mask cannot be turned into `unit`.
        """
        with np.errstate(divide="ignore"):
            x = np.log(frequency)
        found = np.interp(x, np.log(self.frequency), np.log(self.psd), left=np.nan, right=np.nan)
        own = self.unit or of_channel or unit
        psd = np.exp(found)
        if canonical(own) != canonical(unit):
            psd = psd * np.abs(conversion(own, unit, frequency)) ** 2
        return np.asarray(psd)

    def check_unit(self, unit: str) -> None:
        """Refuse a unit of motion that the mask cannot be turned into.

        Raises
        ------
        WrongSettingError
            With the units there are.
        """
        if self.unit is not None:
            conversion(self.unit, unit, np.ones(1))

    def points(self, frequency: FloatArray) -> FloatArray:
        """Return where to draw it: its own points, and the given ones that it covers; in Hz."""
        inside = (frequency >= self.frequency[0]) & (frequency <= self.frequency[-1])
        return np.unique(np.concatenate([self.frequency, frequency[inside]]))


_LONGEST_PERIOD = 1e5  # s, of Peterson's models


def _peterson(name: str, rows: Iterable[tuple[float, float, float]]) -> Mask:
    """Return a model of lines ``A + B log10(T)`` in dB, each from its period T on.

    At their ends the lines differ by up to 0.1 dB, so each has both of its ends.
    """
    ends = [*rows, (_LONGEST_PERIOD, 0.0, 0.0)]
    points = [
        (1 / at, 10 ** ((a + b * math.log10(at)) / 10))
        for (period, a, b), (end, _, _) in pairwise(ends)
        for at in (period, end * (1 - 1e-9) if end < _LONGEST_PERIOD else end)
    ]
    return _rising(name, points)


def _straight(name: str, rows: Iterable[tuple[float, float]]) -> Mask:
    """Return a model of points: period in s, and dB."""
    return _rising(name, [(1 / period, 10 ** (level / 10)) for period, level in rows])


def _rising(name: str, points: Iterable[tuple[float, float]]) -> Mask:
    frequency, psd = zip(*sorted(points), strict=True)
    return Mask(name, "m/s²", frequency, psd)


_NLNM = (
    (0.10, -162.36, 5.64), (0.17, -166.70, 0.00), (0.40, -170.00, -8.30), (0.80, -166.40, 28.90),
    (1.24, -168.60, 52.48), (2.40, -159.98, 29.81), (4.30, -141.10, 0.00), (5.00, -71.36, -99.77),
    (6.00, -97.26, -66.49), (10.00, -132.18, -31.57), (12.00, -205.27, 36.16),
    (15.60, -37.65, -104.33), (21.90, -114.37, -47.10), (31.60, -160.58, -16.28),
    (45.00, -187.50, 0.00), (70.00, -216.47, 15.70), (101.00, -185.00, 0.00),
    (154.00, -168.34, -7.61), (328.00, -217.43, 11.90), (600.00, -258.28, 26.60),
    (10000.00, -346.88, 48.75),
)  # fmt: skip
_NHNM = (
    (0.10, -108.73, -17.23), (0.22, -150.34, -80.50), (0.32, -122.31, -23.87),
    (0.80, -116.85, 32.51), (3.80, -108.48, 18.08), (4.60, -74.66, -32.95), (6.30, 0.66, -127.18),
    (7.90, -93.37, -22.42), (15.40, 73.54, -162.98), (20.00, -151.52, 10.01),
    (354.80, -206.66, 31.63),
)  # fmt: skip
_AHNM = (
    (0.01, -91.5), (0.10, -91.5), (0.22, -97.41), (0.32, -110.5), (0.80, -120.0), (3.80, -98.0),
    (4.60, -96.5), (6.30, -101.0), (7.10, -105.0), (150.0, -91.25),
)  # fmt: skip
_ALNM = ((0.01, -135.0), (1.0, -135.0), (10.0, -130.0), (150.0, -118.25))

NOISE_MODELS: Mapping[str, Mask] = {
    "nlnm": _peterson("NLNM", _NLNM),
    "nhnm": _peterson("NHNM", _NHNM),
    "alnm": _straight("ALNM", _ALNM),
    "ahnm": _straight("AHNM", _AHNM),
}
"""Published models, by the name that the bench file and the command line know."""
SOURCES: Mapping[str, str] = {
    "NLNM": "Peterson (1993), low noise",
    "NHNM": "Peterson (1993), high noise",
    "ALNM": "Cauzzi and Clinton (2013), quiet strong-motion stations",
    "AHNM": "Cauzzi and Clinton (2013), noisy strong-motion stations",
}
"""Source and meaning of each published model, by its name in figures."""


def check_points(frequency: Sequence[float], values: Sequence[float]) -> None:
    """Refuse points that are no mask.

    Raises
    ------
    ValueError
        With what was expected.
    """
    if len(frequency) != len(values):
        raise ValueError(
            f"{len(frequency)} frequencies and {len(values)} values; expected as many of both"
        )
    if len(frequency) < 2:
        raise ValueError("expected at least two points")
    for low, high in pairwise(frequency):
        if high <= low:
            raise ValueError(f"{high:g} Hz after {low:g} Hz; expected increasing frequencies")
