"""Sensitivities that the common motion shows: which channels read more or less of it than others.

The rows of a relative response are as long as the gains, whatever the orientations of the sensors.
Sensors that agree are taken to be right: a majority of them says which of the others are not.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from estimator.checks.relative_response import RelativeResponse
from estimator.records import dataclass
from estimator.types import FloatArray

TOLERANCE = 0.05
"""Difference of a gain from 1 from which on a sensitivity is wrong."""
CERTAIN = 5.0
"""Standard errors that the difference must exceed as well: they come from eight parts of the band,
and every channel is examined."""
UNKNOWN_ERROR = 0.1
"""Standard error of a gain, as a fraction, where too few frequencies give one."""
STANDARD_GRAVITY = 9.80665
STEPS = (4.0, 5.0, 8.0, 10.0, 16.0, 20.0, 32.0, 64.0, 100.0, 1000.0)
"""Ratios between positions of gain switches, and between units and their multiples."""


class Cause(enum.StrEnum):
    """What makes a sensitivity wrong by a factor."""

    GRAVITY = "gravity"
    """g in place of m/s², or the reverse: 9.81."""
    FACTOR_TWO = "factor-2"
    """Single-ended in place of differential, or peak to peak in place of peak."""
    GAIN_SWITCH = "gain-switch"
    """Another position of a gain switch, or another multiple of the unit."""
    CHANGED = "changed"
    """The sensor changed, or was carried away, in the test: no sensitivity is wrong."""


CAUSES: Mapping[Cause, str] = {
    Cause.GRAVITY: "g in place of m/s², or the reverse",
    Cause.FACTOR_TWO: "a factor of 2, as between single-ended and differential inputs",
    Cause.GAIN_SWITCH: "another position of a gain switch, or another multiple of the unit",
    Cause.CHANGED: "it changed in the test",
}
"""What makes a sensitivity wrong by a factor."""


@dataclass(frozen=True, slots=True)
class WrongGain:
    """A channel whose sensitivity the motion contradicts.

    Attributes
    ----------
    channel : int
        Column, from 0.
    gain : float
        Motion that the channel reads over that which the other sensors read.
    error : float
        Its standard error.
    against : tuple of int
        The sensors that agree; empty where no majority does, and `gain` is against `alternatives`.
    alternatives : tuple of float
        Each gain that may be the true one: `gain` alone, or one against every other sensor.
    """

    channel: int
    gain: float
    error: float
    against: tuple[int, ...]
    alternatives: tuple[float, ...]

    @property
    def cause(self) -> Cause | None:
        """What is likely to be wrong; None if the factor suggests nothing."""
        return likely_cause(self.gain, self.error)


def likely_cause(gain: float, error: float = 0.0) -> Cause | None:
    """Return what makes a channel read so many times the motion; None where nothing is known."""
    factor = abs(math.log(gain))
    near = max(math.log1p(TOLERANCE), 2 * error / gain)
    if abs(factor - math.log(2)) < near:
        return Cause.FACTOR_TWO
    if abs(factor - math.log(STANDARD_GRAVITY)) < near:
        return Cause.GRAVITY
    return Cause.GAIN_SWITCH if any(abs(factor - math.log(s)) < near for s in STEPS) else None


def wrong_gains(
    responses: Sequence[RelativeResponse],
    dims: tuple[int, ...],
    *,
    certified: Collection[int] = (),
) -> tuple[WrongGain, ...]:
    """Return the channels whose sensitivity the motion contradicts, in their order.

    Parameters
    ----------
    responses : sequence of RelativeResponse
        Of the pairs that can be compared.
    dims : tuple of int
        Channels of each sensor.
    certified : collection of int
        Columns whose sensitivity is certain by a certificate.

    Notes
    -----
    The sensors that agree with most others are right. Where two groups as large contradict each
    other, or all sensors do, every channel is doubted: each may be the only one that is wrong.
    """
    pairs = {pair: each for response in responses for pair, each in _both_ways(response)}
    sensors = sorted({sensor for pair in pairs for sensor in pair})
    starts = np.concatenate([[0], np.cumsum(dims)])
    trusted = {s for s in sensors if set(range(starts[s], starts[s + 1])) <= set(certified)}
    agreeing = {
        one: {one}
        | {
            other
            for other in sensors
            if (one, other) in pairs
            and (other, one) in pairs
            and not pairs[one, other].is_wrong().any()
            and not pairs[other, one].is_wrong().any()
        }
        for one in sensors
    }
    right = trusted or _majority(agreeing)
    found = []
    for sensor in sensors:
        others = [s for s in (right or sensors) if s != sensor and (s, sensor) in pairs]
        if not others or sensor in trusted:
            continue
        if right:
            options = [_mean([pairs[other, sensor] for other in others])]
        else:
            options = [pairs[other, sensor] for other in others]
        wrong = np.any([each.is_wrong() for each in options], axis=0)
        for place in np.flatnonzero(wrong).tolist():
            if starts[sensor] + place in certified:
                continue
            gains = tuple(float(each.gains[place]) for each in options)
            found.append(
                WrongGain(
                    channel=int(starts[sensor]) + place,
                    gain=float(np.exp(np.mean(np.log(gains)))),
                    error=max(float(each.errors[place]) for each in options),
                    against=tuple(others) if right else (),
                    alternatives=gains,
                )
            )
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class _Gains:
    """Gains of a sensor's channels against another sensor, and their errors."""

    gains: FloatArray
    errors: FloatArray

    def is_wrong(self) -> FloatArray:
        """Return for each channel whether it is off by more than the tolerance and its error."""
        off = np.abs(self.gains - 1)
        return np.asarray((off > TOLERANCE) & (off > CERTAIN * self.errors))


def _both_ways(response: RelativeResponse) -> list[tuple[tuple[int, int], _Gains]]:
    """Return the gains of the second sensor against the first, and the reverse.

    Errors as fractions are alike in both directions.
    """
    first, second = response.first, response.second
    errors = response.gain_errors / response.gains
    errors = np.where(np.isnan(errors), UNKNOWN_ERROR, errors)
    found = [((first, second), _Gains(response.gains, response.gains * errors))]
    if np.linalg.cond(response.matrix) < 1e6:
        back = np.linalg.norm(np.linalg.inv(response.matrix), axis=1)
        found.append(((second, first), _Gains(back, back * errors.max())))
    return found


def _mean(several: Sequence[_Gains]) -> _Gains:
    """Return the geometric mean of gains against several sensors, of the known ones if there are.

    Its error is not reduced by their number: all share the motion that the sensor did not see well.
    """
    gains, errors = (np.array([getattr(each, of) for each in several]) for of in _Gains.__slots__)
    known = CERTAIN * errors <= gains
    known |= ~known.any(axis=0)
    mean = np.exp(np.mean(np.log(gains), axis=0, where=known))
    return _Gains(mean, np.min(errors / gains, axis=0) * mean)


def _majority(agreeing: dict[int, set[int]]) -> set[int]:
    """Return the largest group that agrees; empty where another is as large, or none has two."""
    if not agreeing:
        return set()
    largest = max(agreeing.values(), key=len)
    if len(largest) < 2:
        return set()
    apart = [group for group in agreeing.values() if not group & largest]
    return set() if any(len(group) == len(largest) for group in apart) else largest
