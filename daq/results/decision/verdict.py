"""The verdict of a huddle test: pass, fail or not decided, and what keeps it from a decision."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from daq.bench.units import decibels


class Verdict(enum.StrEnum):
    """Whether the noise is within the limits."""

    PASS = "pass"  # noqa: S105 - no password
    """All of the interval is below the limit: of every channel at every frequency judged."""
    FAIL = "fail"
    """All of the interval is above the limit: of a channel at some frequency."""
    NOT_DECIDED = "not-decided"
    """Neither: the interval spans the limit, or something is missing."""


class Obstacle(enum.StrEnum):
    """What keeps a limit from being decided."""

    SENSORS_LOST = "sensors-lost"
    """Every sensor was lost before the end of the recording."""
    NO_SEGMENTS = "no-segments"
    """The recording has no whole segment without gaps."""
    NO_ESTIMATE = "no-estimate"
    """The method that judges gives no noise for the channel in a band of the limit."""
    OUTSIDE_SPECTRUM = "outside-spectrum"
    """The limit has no frequency in common with the spectrum."""
    NO_SHARED_MOTION = "no-shared-motion"
    """A sensor records none of the motion that the others share: no noise can be told from it."""
    FAULTY_CHANNEL = "faulty-channel"
    """The channel is clipped or was dead for a while: its noise is lower than the estimate."""
    MODEL_MISFIT = "model-misfit"
    """One common motion does not explain the averages: the estimate may be too far off."""
    CLOCKS = "clocks"
    """The clocks may have added what is above the limit, or taken it away, or are not known."""
    TOO_FEW_AVERAGES = "too-few-averages"
    """With so few averages the interval cannot be trusted."""
    SPANS_LIMIT = "spans-limit"
    """The limit lies within the interval: a longer recording narrows it."""


REMOVED_BY_TIME = frozenset({Obstacle.TOO_FEW_AVERAGES, Obstacle.SPANS_LIMIT})
"""Obstacles that a longer recording removes."""


@dataclass(frozen=True, slots=True)
class LimitResult:
    """One channel beside one limit, in the band where it does worst; PSD in unit²/Hz.

    NaN throughout where there is no estimate in any band of the limit.

    Attributes
    ----------
    limit, sensor, channel, method : str
    frequency : float
        Centre of the band, Hz.
    noise_psd, low, high : float
        Mean over the band, and its interval, which holds for all channels and bands together.
    limit_psd : float
    verdict : Verdict
    covers, judged : (float, float)
        From and to which frequency the limit goes, and to which of them it was judged: as far as
        the spectrum goes, and something is known. Hz; NaN where none was.
    obstacle : Obstacle or None
        None where the limit is decided.
    """

    limit: str
    sensor: str
    channel: str
    method: str
    frequency: float
    noise_psd: float
    low: float
    high: float
    limit_psd: float
    verdict: Verdict
    covers: tuple[float, float]
    judged: tuple[float, float]
    obstacle: Obstacle | None = None

    @property
    def name(self) -> str:
        """Sensor and channel, as in ``A.X``: to be read, not to be taken apart."""
        return f"{self.sensor}.{self.channel}"

    @property
    def known(self) -> bool:
        """Whether there is an estimate in a band of the limit."""
        return math.isfinite(self.limit_psd)

    @property
    def margin_db(self) -> float:
        """How far the noise is below the limit, in dB; NaN where it came out below zero."""
        return decibels(self.limit_psd) - decibels(self.noise_psd)

    @property
    def margin_low_db(self) -> float:
        """The margin at the upper end of the interval, in dB: the least it may be."""
        return decibels(self.limit_psd) - decibels(self.high)

    @property
    def margin_high_db(self) -> float:
        """The margin at the lower end of the interval, in dB; infinite if that is not above 0."""
        if self.known and self.low <= 0:
            return math.inf
        return decibels(self.limit_psd) - decibels(self.low)


@dataclass(frozen=True, slots=True)
class Prediction:
    """How long a recording takes to decide.

    Attributes
    ----------
    seconds : float or None
        Total length that decides with a probability of 90 %; None where `longest` does not.
    longest : float
        The longest recording considered, in seconds.
    resolution_db : float
        Half the width of the interval in that recording, in dB, where the noise is closest to the
        limit.
    """

    seconds: float | None
    longest: float
    resolution_db: float


@dataclass(frozen=True, slots=True)
class TestVerdict:
    """What a huddle test says of the limits of its bench file.

    Attributes
    ----------
    verdict : Verdict
    limits : tuple of LimitResult
        Every channel beside every limit that is for it.
    obstacles : tuple of Obstacle
        What keeps the test from a decision, in the order of the enumeration.
    prediction : Prediction or None
        Where a longer recording of the same kind would decide; None where something else is
        missing.
    """

    verdict: Verdict
    limits: tuple[LimitResult, ...]
    obstacles: tuple[Obstacle, ...] = ()
    prediction: Prediction | None = None

    __test__ = False  # for pytest

    def having(self, verdict: Verdict) -> list[LimitResult]:
        """Return the channels and limits of one verdict."""
        return [each for each in self.limits if each.verdict is verdict]
