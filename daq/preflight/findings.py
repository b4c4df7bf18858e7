"""What the checks before a test can find."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass


class Problem(enum.StrEnum):
    """What a check finds."""

    TROUBLE = "trouble"
    """The sensor does not answer, or is another one."""
    NO_SAMPLES = "no-samples"
    """It answers, and sends no samples."""
    RATE = "rate"
    """It samples at another rate than the bench file says."""
    MISSING = "missing"
    """Samples are missing."""
    CLIPPING = "clipping"
    """Samples are at the end of the range."""
    DEAD = "dead"
    """A channel does not change."""
    HUM = "hum"
    """Most of a channel's power is at the frequency of mains."""
    CLOCK = "clock"
    """The clock is off by more than a clock should be."""
    UNEVEN = "uneven"
    """Samples arrive too unevenly for the clock to be known well."""
    OFFSET = "offset"
    """At rest it measures neither gravity nor nothing."""
    ALONE = "alone"
    """It shares no motion with sensors that share one."""
    SWAPPED = "swapped"
    """Two channels have traded places."""
    REVERSED = "reversed"
    """A channel is reversed."""
    REFLECTED = "reflected"
    """No way to turn the sensor explains what it measures: some channels are swapped or reversed.
    """


@dataclass(frozen=True, slots=True)
class Finding:
    """One problem of one sensor, or of one of its channels.

    Attributes
    ----------
    problem : Problem
    sensor : str
    channel : str
        Empty where the whole sensor is meant; two that have traded places: ``X and Y``.
    value : float
        Rate in Hz, missing samples, frequency of hum, error of the clock in ppm, scatter of
        arrivals in s, acceleration at rest in m/s², or correlation; NaN where there is none.
    text : str
        Of the error that was raised.
    """

    problem: Problem
    sensor: str
    channel: str = ""
    value: float = math.nan
    text: str = ""

    @property
    def prevents(self) -> bool:
        """Whether a test is of no use before it is put right."""
        return self.problem not in CAUTIONS


CAUTIONS = {Problem.HUM, Problem.MISSING, Problem.CLOCK, Problem.UNEVEN, Problem.OFFSET}
"""What a test can be made in spite of."""
