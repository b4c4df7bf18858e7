"""Units in which spectra are read off. Does not use Textual."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

GRAVITY = 9.80665  # m/s² per g
MOST_TICKS = 8


@dataclass(frozen=True, slots=True)
class SpectrumUnit:
    """A unit of spectra, of values in dB re 1 unit²/Hz of the estimate.

    Attributes
    ----------
    name : str
        As an axis says it.
    scale : float
        Of a PSD in this unit, or of its root.
    is_amplitude : bool
        Whether it is the root of a PSD.
    is_db : bool
        Whether it is in dB.
    """

    name: str
    scale: float = 1.0
    is_amplitude: bool = False
    is_db: bool = False

    def value(self, level_db: float) -> float:
        """Return a level in this unit."""
        if self.is_db:
            return level_db
        return self.scale * math.pow(10.0, level_db / (20 if self.is_amplitude else 10))

    def text(self, level_db: float) -> str:
        """Return a level in this unit, without its name."""
        if math.isnan(level_db):
            return "?"
        value = self.value(level_db)
        if self.is_db:
            return f"{value:.1f}".replace("-", "−")
        return f"{value:.3g}"

    def ticks(self, low_db: float, high_db: float, most: int = MOST_TICKS) -> list[float]:
        """Return round values between two levels, as levels in dB."""
        if self.is_db:
            step = next((s for s in (5, 10, 20, 40, 50) if (high_db - low_db) / s <= most), 100)
            first = math.ceil(low_db / step) * step
            return [float(tick) for tick in np.arange(first, high_db + 1e-9, step)]
        per_decade = 20 if self.is_amplitude else 10
        offset = per_decade * math.log10(self.scale)
        low, high = (low_db + offset) / per_decade, (high_db + offset) / per_decade
        return [per_decade * tick - offset for tick in log_ticks(low, high, most)]

    def labels(self, ticks: Sequence[float]) -> list[str]:
        """Return the labels of ticks."""
        if self.is_db:
            return [f"{tick:.0f} dB".replace("-", "−") for tick in ticks]
        return [f"{float(f'{self.value(tick):.1g}'):.4g}" for tick in ticks]


def log_ticks(low: float, high: float, most: int) -> list[float]:
    """Return log10 of round numbers between two ends: decades, and with room 2 and 5 or 3."""
    for digits, skip in (((1, 2, 5), 1), ((1, 3), 1), ((1,), 1), ((1,), 2), ((1,), 4)):
        first, last = math.floor(low), math.ceil(high) + 1
        decades = range(first + -first % skip, last, skip)
        ticks = [decade + math.log10(digit) for decade in decades for digit in digits]
        ticks = [tick for tick in ticks if low <= tick <= high]
        if len(ticks) <= most:
            break
    return ticks


def units_of(unit: str) -> tuple[SpectrumUnit, ...]:
    """Return the units for an estimate in (unit)²/Hz, dB first."""
    units = [SpectrumUnit(f"dB re 1 ({unit})²/Hz", is_db=True), SpectrumUnit(f"({unit})²/Hz")]
    if unit == "m/s²":
        units.append(SpectrumUnit("g²/Hz", GRAVITY**-2))
        units.append(SpectrumUnit("ng/√Hz", 1e9 / GRAVITY, is_amplitude=True))
    else:
        units.append(SpectrumUnit(f"{unit}/√Hz", is_amplitude=True))
    return tuple(units)
