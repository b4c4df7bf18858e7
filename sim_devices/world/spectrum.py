"""Shapes of one-sided power spectral densities, in (m/s²)²/Hz.

Each shape is a frozen table, written in a bench file as::

    {shape = "white", level = 1e-13}
    {shape = "mixed", level = 2e-14, low_corner = 20.0, high_corner = 30.0}
    {shape = "sum", terms = [{shape = "white", level = 1e-13}, {shape = "pink", level = 1e-12}]}
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, Self, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat, model_validator

from sim_devices.arrays import FloatArray


class Shape(BaseModel):
    """Base of all shapes: a frozen table without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def psd(self, frequency: FloatArray) -> FloatArray:
        """One-sided PSD in (m/s²)²/Hz at `frequency` (Hz, any shape, zero and above)."""
        raise NotImplementedError


class White(Shape):
    """Constant `level` at every frequency."""

    shape: Literal["white"] = "white"
    level: NonNegativeFloat

    def psd(self, frequency: FloatArray) -> FloatArray:
        """One-sided PSD in (m/s²)²/Hz at `frequency` (Hz)."""
        return np.full(np.shape(frequency), self.level)


class Pink(Shape):
    """`level` at 1 Hz, times `frequency**-exponent`; constant far below `flat_below` (Hz)."""

    shape: Literal["pink"] = "pink"
    level: NonNegativeFloat
    exponent: PositiveFloat = 1.0
    flat_below: PositiveFloat = 0.02

    def psd(self, frequency: FloatArray) -> FloatArray:
        """One-sided PSD in (m/s²)²/Hz at `frequency` (Hz)."""
        return np.asarray(self.level * np.hypot(frequency, self.flat_below) ** -self.exponent)


class Mixed(Shape):
    """Servo-accelerometers of §2.4: pink below `low_corner`, increasing above `high_corner` (Hz).

    The PSD is ``level (low_corner / f + 1 + (f / high_corner)**rise)``: about `level` between the
    corners, proportional to 1/f below and to `f**rise` above; constant far below `flat_below`.
    """

    shape: Literal["mixed"] = "mixed"
    level: NonNegativeFloat
    low_corner: PositiveFloat = 20.0
    high_corner: PositiveFloat = 30.0
    rise: PositiveFloat = 2.0
    flat_below: PositiveFloat = 0.02

    def psd(self, frequency: FloatArray) -> FloatArray:
        """One-sided PSD in (m/s²)²/Hz at `frequency` (Hz)."""
        pink = self.low_corner / np.hypot(frequency, self.flat_below)
        return np.asarray(self.level * (pink + 1 + (frequency / self.high_corner) ** self.rise))


class Resonance(Shape):
    """One structural mode: `level` at its `frequency` (Hz), `damping` as a fraction of critical.

    This is the acceleration of an oscillator under a white force: proportional to f⁴ below the
    mode, and constant at `level (2 damping)²` above.
    """

    shape: Literal["resonance"] = "resonance"
    level: NonNegativeFloat
    frequency: PositiveFloat
    damping: PositiveFloat

    def psd(self, frequency: FloatArray) -> FloatArray:
        """One-sided PSD in (m/s²)²/Hz at `frequency` (Hz)."""
        ratio = (np.asarray(frequency) / self.frequency) ** 2
        width = (2 * self.damping) ** 2
        return np.asarray(self.level * width * ratio**2 / ((1 - ratio) ** 2 + width * ratio))


class Tabulated(Shape):
    """Points joined by straight lines in log-log axes; constant outside the first and last."""

    shape: Literal["tabulated"] = "tabulated"
    frequency: tuple[PositiveFloat, ...] = Field(min_length=1)
    level: tuple[PositiveFloat, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _points(self) -> Self:
        if len(self.frequency) != len(self.level):
            raise ValueError(
                f"{len(self.frequency)} frequencies and {len(self.level)} levels;"
                " expected equal numbers"
            )
        if any(second <= first for first, second in pairwise(self.frequency)):
            raise ValueError(f"frequency = {list(self.frequency)} must increase strictly")
        return self

    def psd(self, frequency: FloatArray) -> FloatArray:
        """One-sided PSD in (m/s²)²/Hz at `frequency` (Hz)."""
        at = np.log(np.maximum(frequency, self.frequency[0]))
        return np.asarray(np.exp(np.interp(at, np.log(self.frequency), np.log(self.level))))


class Sum(Shape):
    """Sum of independent contributions."""

    shape: Literal["sum"] = "sum"
    terms: tuple[Spectrum, ...] = Field(min_length=1)

    def psd(self, frequency: FloatArray) -> FloatArray:
        """One-sided PSD in (m/s²)²/Hz at `frequency` (Hz)."""
        return np.asarray(sum(term.psd(frequency) for term in self.terms), dtype=float)


Spectrum: TypeAlias = Annotated[
    White | Pink | Mixed | Resonance | Tabulated | Sum, Field(discriminator="shape")
]
