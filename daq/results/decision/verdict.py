"""What a huddle test says of each channel beside each limit of its bench file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import field

from daq.bench.units import decibels
from daq.results.decision.facts import LimitNotJudged, LimitUndecided, WrongSensitivity
from daq.results.facts.fact import Fact
from estimator.checks.advice import Rank
from estimator.decision.decision_time import INTERVAL_FACTOR
from estimator.decision.verdict import Obstacle, Prediction, Verdict
from estimator.records import Hertz, dataclass


@dataclass(frozen=True, slots=True)
class LimitResult:
    """One channel beside one limit, in the third-octave band where it does worst; PSD in unit²/Hz.

    NaN throughout where there is no estimate in any band of the limit.

    Attributes
    ----------
    limit, sensor, channel : str
        Name.
    method : str
        Method that judges.
    frequency : float
        Centre of the band, Hz.
    noise_psd : float
        Mean noise in the band, one-sided.
    low, high : float
        Its interval, which holds for all channels and bands together.
    limit_psd : float
        The limit at that frequency.
    verdict : Verdict
        On this limit.
    covers : (float, float)
        From and to which frequency the limit goes, Hz.
    judged : (float, float)
        From and to which of them it was judged: as far as the spectrum goes, and something is
        known. Hz; NaN where none was.
    obstacle : Obstacle or None
        What keeps the limit from a decision; None where it is decided.
    """

    limit: str
    sensor: str
    channel: str
    method: str
    frequency: Hertz
    noise_psd: float
    low: float = field(metadata={"key": "noise_psd_low"})
    high: float = field(metadata={"key": "noise_psd_high"})
    limit_psd: float
    verdict: Verdict
    covers: tuple[float, float] = field(metadata={"key": "limit_hz", "items": {"type": "number"}})
    judged: tuple[Hertz, Hertz]
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
    def is_sure(self) -> bool:
        """Whether the verdict holds with an interval `INTERVAL_FACTOR` times as wide."""
        if self.verdict is Verdict.PASS:
            bound = self.noise_psd + INTERVAL_FACTOR * (self.high - self.noise_psd)
            return bound < self.limit_psd
        bound = self.noise_psd - INTERVAL_FACTOR * (self.noise_psd - self.low)
        return self.verdict is Verdict.FAIL and bound > self.limit_psd

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
        When a longer recording of the same kind decides surely; None where something else is
        missing, or the verdict is sure.
    sensitivities : tuple of WrongSensitivity
        Sensors, or channels, whose sensitivity the motion contradicts.
    k : float
        Coverage factor of the intervals, in standard deviations of a normal distribution: they
        hold for all channels, limits and bands together with a probability of 95 %.
    """

    verdict: Verdict
    limits: tuple[LimitResult, ...]
    obstacles: tuple[Obstacle, ...] = ()
    prediction: Prediction | None = None
    sensitivities: tuple[WrongSensitivity, ...] = ()
    k: float = math.nan

    __test__ = False  # for pytest

    @property
    def is_sure(self) -> bool:
        """Whether the test is decided with more than its own interval.

        A test that may end at any of many looks gets as many chances of a wrong verdict. Its
        intervals therefore count as `INTERVAL_FACTOR` times as wide: at the three to four standard
        deviations of a verdict on many bands this makes a single look ten times less likely to be
        wrong.
        """
        if self.verdict is Verdict.FAIL:
            return any(each.is_sure for each in self.having(Verdict.FAIL))
        return self.verdict is Verdict.PASS and all(each.is_sure for each in self.limits)

    def having(self, verdict: Verdict) -> list[LimitResult]:
        """Return the channels and limits of one verdict."""
        return [each for each in self.limits if each.verdict is verdict]


def facts_of_verdict(found: TestVerdict) -> Iterator[Fact]:
    """Yield what is known of a verdict: wrong sensitivities, obstacles, what is not judged."""
    yield from found.sensitivities
    for obstacle in found.obstacles if found.verdict is Verdict.NOT_DECIDED else ():
        if obstacle is Obstacle.SENSITIVITY:
            continue  # those are facts
        concerned = [each for each in found.limits if each.obstacle is obstacle]
        yield LimitUndecided(
            rank=Rank.DELAYS,
            channels=tuple(dict.fromkeys(each.name for each in concerned)),
            obstacle=obstacle,
            limits=tuple(dict.fromkeys(each.limit for each in concerned)),
        )
    for limit, covers, judged in dict.fromkeys(
        (each.limit, each.covers, each.judged) for each in found.limits
    ):
        if covers[0] < judged[0] or judged[1] < covers[1]:
            yield LimitNotJudged(rank=Rank.TO_KNOW, limit=limit, covers=covers, judged=judged)
