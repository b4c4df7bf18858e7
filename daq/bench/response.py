"""What a channel makes of motion at each frequency: poles and zeros, or all stages of a response.

Theory of operation
-------------------
A response is a product of stages, each ``factor · shape(f)``. ``factor`` is worked out when a file
is read (:mod:`daq.formats.response`): it is the gain of the stage over the size of its shape at the
frequency for which that gain is stated. So a reader of a recording needs no rule but the product,
and no file of another program. Responses are normalised: their size is 1 at `frequency`, where the
sensitivity of the channel holds.

Phases are those of samples whose times are right: the delay that a digitizer has taken out of its
times (FIR filters with symmetry, corrections of other filters) is not in them. This is evalresp's
convention.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, kw_only=True)
class PolesZeros:
    """Frequency response as poles and zeros of the Laplace transform, in rad/s.

    ``H(s) = normalization * prod(s - zeros) / prod(s - poles)``, to be multiplied by the channel's
    sensitivity. Without ``normalization``, ``|H| = 1`` at ``frequency`` in Hz, at which the
    sensitivity holds.
    """

    zeros: tuple[complex, ...] = ()
    poles: tuple[complex, ...] = ()
    normalization: float | None = None
    frequency: float = 1.0

    @property
    def described(self) -> str:
        """What it consists of, for people."""
        return f"{len(self.poles)} poles, {len(self.zeros)} zeros"

    def at(self, frequency: FloatArray) -> ComplexArray:
        """Return the response, without sensitivity.

        Parameters
        ----------
        frequency : float64, any shape
            In Hz.
        """
        value = _rational(self.zeros, self.poles, 2j * np.pi * np.asarray(frequency, np.float64))
        if self.normalization is not None:
            return value * self.normalization
        at = np.array(2j * np.pi * self.frequency)
        return value / np.abs(_rational(self.zeros, self.poles, at))


@dataclass(frozen=True, slots=True)
class GainStage:
    """A stage that is the same at all frequencies."""

    kind: ClassVar[str] = "gain"
    factor: float

    def shape(self, frequency: FloatArray) -> ComplexArray:
        """Return 1 at every frequency in Hz."""
        return np.ones_like(frequency, dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class AnalogPolesZeros:
    """Poles and zeros of the Laplace transform, in rad/s."""

    kind: ClassVar[str] = "analog"
    factor: float
    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]

    def shape(self, frequency: FloatArray) -> ComplexArray:
        """Return ``prod(s - zeros) / prod(s - poles)`` at frequencies in Hz."""
        return _rational(self.zeros, self.poles, 2j * np.pi * frequency)


@dataclass(frozen=True, slots=True)
class DigitalPolesZeros:
    """Poles and zeros of the z-transform; `sampling_rate` in Hz is that of its input."""

    kind: ClassVar[str] = "digital"
    factor: float
    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    sampling_rate: float

    def shape(self, frequency: FloatArray) -> ComplexArray:
        """Return ``prod(z - zeros) / prod(z - poles)`` at frequencies in Hz."""
        z = np.exp(2j * np.pi * frequency / self.sampling_rate)
        return _rational(self.zeros, self.poles, z)


@dataclass(frozen=True, slots=True)
class Fir:
    """A filter of finite length.

    Attributes
    ----------
    factor : float
    coefficients : tuple of float
        All of them, or the first half of a symmetric filter.
    symmetry : {"none", "odd", "even"}
        Odd: the last coefficient is the middle one. Symmetric filters have no phase.
    sampling_rate : float
        Of its input, in Hz.
    correction : float
        Delay in s that is taken out of the times of samples; of filters without symmetry.
    """

    kind: ClassVar[str] = "fir"
    factor: float
    coefficients: tuple[float, ...]
    symmetry: Literal["none", "odd", "even"]
    sampling_rate: float
    correction: float = 0.0

    def shape(self, frequency: FloatArray) -> ComplexArray:
        """Return the transform of the coefficients at frequencies in Hz."""
        given = np.array(self.coefficients)
        omega = 2 * np.pi * frequency / self.sampling_rate
        if self.symmetry == "none":
            value = _polynomial(given, np.exp(-1j * omega))
            return np.asarray(value * np.exp(2j * np.pi * frequency * self.correction))
        middle_first = given[::-1]
        if self.symmetry == "odd":  # c0 + 2 Σ ck cos(kω), a series of Chebyshev polynomials
            series = np.concatenate([middle_first[:1], 2 * middle_first[1:]])
            return _chebyshev(series, np.cos(omega)).astype(np.complex128)
        series = np.zeros(2 * len(given))  # 2 Σ ck cos((k + ½)ω)
        series[1::2] = 2 * middle_first
        return _chebyshev(series, np.cos(omega / 2)).astype(np.complex128)


@dataclass(frozen=True, slots=True)
class Iir:
    """A recursive filter by its coefficients; `sampling_rate` in Hz is that of its input."""

    kind: ClassVar[str] = "iir"
    factor: float
    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    sampling_rate: float

    def shape(self, frequency: FloatArray) -> ComplexArray:
        """Return the ratio of the transforms at frequencies in Hz."""
        inverse_z = np.exp(-2j * np.pi * frequency / self.sampling_rate)
        above = _polynomial(np.array(self.numerator), inverse_z)
        return np.asarray(above / _polynomial(np.array(self.denominator), inverse_z))


@dataclass(frozen=True, slots=True)
class Measured:
    """A list of measured values: amplitudes and phases (rad) at rising frequencies (Hz).

    Cubic splines lie between them. Nothing is known outside: the response is NaN there.
    """

    kind: ClassVar[str] = "list"
    factor: float
    frequencies: tuple[float, ...]
    amplitudes: tuple[float, ...]
    phases: tuple[float, ...]

    def shape(self, frequency: FloatArray) -> ComplexArray:
        """Return the values between those measured, at frequencies in Hz."""
        from scipy.interpolate import make_interp_spline  # noqa: PLC0415 - takes long, seldom used

        known = np.array(self.frequencies)
        order = min(3, len(known) - 1)
        values = make_interp_spline(
            known, np.column_stack([self.amplitudes, self.phases]), k=order
        )(np.clip(frequency, known[0], known[-1]))
        inside = (frequency >= known[0]) & (frequency <= known[-1])
        size = np.where(inside, values[..., 0], np.nan)
        return np.asarray(size * np.exp(1j * values[..., 1]))


Stage: TypeAlias = GainStage | AnalogPolesZeros | DigitalPolesZeros | Fir | Iir | Measured
_KINDS: dict[str, type[Any]] = {
    each.kind: each for each in (GainStage, AnalogPolesZeros, DigitalPolesZeros, Fir, Iir, Measured)
}
_COMPLEX = ("zeros", "poles")


@dataclass(frozen=True)
class Response:
    """All stages of a response.

    Attributes
    ----------
    stages : tuple of Stage
        From the sensor to the counts.
    frequency : float
        In Hz: where the size of the response is 1, and the sensitivity of the channel holds.
    """

    stages: tuple[Stage, ...]
    frequency: float

    @cached_property
    def sensitivity(self) -> float:
        """Counts per unit of motion at `frequency`, by the stages."""
        return float(np.abs(self._product(np.array([self.frequency])))[0])

    @property
    def filters(self) -> tuple[Fir | Iir | DigitalPolesZeros, ...]:
        """Its digital filters."""
        kinds = (Fir, Iir, DigitalPolesZeros)
        return tuple(each for each in self.stages if isinstance(each, kinds))

    @property
    def described(self) -> str:
        """What it consists of, for people."""
        analog = [each for each in self.stages if isinstance(each, AnalogPolesZeros)]
        poles, zeros = sum(len(s.poles) for s in analog), sum(len(s.zeros) for s in analog)
        parts = [f"{poles} poles, {zeros} zeros"] if poles or zeros else []
        finite = sum(isinstance(each, Fir) for each in self.filters)
        for n, what in (
            (sum(isinstance(each, Measured) for each in self.stages), "list"),
            (finite, "FIR stage"),
            (len(self.filters) - finite, "IIR stage"),
        ):
            if n:
                parts.append(f"{n} {what}{'s' * (n > 1)}")
        return ", ".join(parts) or "flat"

    def at(self, frequency: FloatArray) -> ComplexArray:
        """Return the response, without sensitivity.

        Parameters
        ----------
        frequency : float64, any shape
            In Hz.
        """
        return self._product(np.asarray(frequency, np.float64)) / self.sensitivity

    def _product(self, frequency: FloatArray) -> ComplexArray:
        value = np.ones_like(frequency, dtype=np.complex128)
        for stage in self.stages:
            value = value * stage.factor
            if not isinstance(stage, GainStage):
                value = value * stage.shape(frequency)
        return value

    def to_json(self) -> str:
        """Return text from which `response_from_json` makes an equal response."""
        stages = [{"kind": stage.kind} | asdict(stage) for stage in self.stages]
        return _text({"frequency": self.frequency, "stages": stages})


def response_to_json(response: PolesZeros | Response) -> str:
    """Return a response as a recording holds it."""
    return response.to_json() if isinstance(response, Response) else _text(asdict(response))


def _text(table: dict[str, Any]) -> str:
    return json.dumps(table, default=lambda z: [z.real, z.imag])


def response_from_json(text: str) -> PolesZeros | Response:
    """Return the response that a recording holds.

    Raises
    ------
    ValueError
        The text is none.
    """
    table = json.loads(text)
    if not isinstance(table, Mapping) or "stages" not in table:
        return _poles_zeros(table)
    try:
        stages = tuple(_stage(dict(each)) for each in table["stages"])
        return Response(stages, float(table["frequency"]))
    except (KeyError, TypeError) as error:
        raise ValueError(f"not a response: {error!r}") from error


def _poles_zeros(table: Any) -> PolesZeros:  # noqa: ANN401 - whatever JSON holds
    try:
        zeros, poles = (tuple(complex(*pair) for pair in table[key]) for key in _COMPLEX)
        given = table["normalization"]
        normalization = None if given is None else float(given)
        frequency = float(table["frequency"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"not a response: {error!r}") from error
    values = (*zeros, *poles, normalization or 0.0, frequency)
    if not np.isfinite(values).all() or frequency <= 0:
        raise ValueError("not a response: expected finite numbers, and a frequency above 0")
    return PolesZeros(zeros=zeros, poles=poles, normalization=normalization, frequency=frequency)


def _stage(table: dict[str, Any]) -> Stage:
    kind = _KINDS[table.pop("kind")]
    known = {field.name for field in fields(kind)}
    if set(table) - known:
        raise TypeError(f"unknown: {', '.join(sorted(set(table) - known))}")
    for key, value in table.items():
        if key in _COMPLEX:
            table[key] = tuple(complex(real, imaginary) for real, imaginary in value)
        elif isinstance(value, list):
            table[key] = tuple(map(float, value))
    found: Stage = kind(**table)
    return found


def _rational(
    zeros: tuple[complex, ...],
    poles: tuple[complex, ...],
    x: NDArray[np.complexfloating[Any, Any]],
) -> ComplexArray:
    value = np.ones_like(x, dtype=np.complex128)
    # Factor by factor in turn, so that high orders neither overflow nor underflow.
    for index in range(max(len(zeros), len(poles))):
        if index < len(zeros):
            value = value * (x - zeros[index])
        if index < len(poles):
            value = value / (x - poles[index])
    return value


def _polynomial(coefficients: FloatArray, x: ComplexArray) -> ComplexArray:
    """Return ``Σ c[k] x**k`` by Horner's rule."""
    value = np.zeros_like(x)
    for each in coefficients[::-1]:
        value *= x
        value += each
    return value


def _chebyshev(coefficients: FloatArray, x: FloatArray) -> FloatArray:
    """Return ``Σ c[k] T_k(x)`` by Clenshaw's rule: three real operations a coefficient."""
    return np.asarray(np.polynomial.chebyshev.chebval(x, coefficients))
