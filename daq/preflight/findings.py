"""The check list before a test: its rows, and what they can find."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from estimator.checks.sensitivities import Cause


class Check(enum.StrEnum):
    """What is checked, in the order of the list."""

    PORTS = "ports"
    IDENTITY = "identity"
    RATES = "rates"
    CHANNELS = "channels"
    LEVELS = "levels"
    HUM = "hum"
    MOTION = "motion"
    SENSITIVITIES = "sensitivities"
    POLARITY = "polarity"
    CLOCKS = "clocks"
    DISK = "disk"


class CheckOutcome(enum.StrEnum):
    """What a row of the list says."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_CHECKED = "not-checked"
    """It could not be checked, or what was seen may be right or wrong."""


class Problem(enum.StrEnum):
    """What a check finds, or why it could not be made."""

    TROUBLE = "trouble"
    """The sensor does not answer."""
    NO_SAMPLES = "no-samples"
    """It answers, and sends no samples."""
    WRONG_DEVICE = "wrong-device"
    """It is another one than the bench file names."""
    RATE = "rate"
    """It samples at another rate than the bench file says."""
    MISSING = "missing"
    """Samples are missing."""
    CLIPPING = "clipping"
    """Samples are at the end of the range."""
    WRAPPING = "wrapping"
    """The counts wrap: a value beyond one end of the range continues at the other end."""
    REPEATS = "repeats"
    """The device repeats its readings: it is polled faster than it refreshes them."""
    STUCK_BIT = "stuck-bit"
    """A bit of the counts never changes, or codes between others never occur."""
    NEAR_FULL_SCALE = "near-full-scale"
    """Samples are near the full scale of the data sheet."""
    DEAD = "dead"
    """A channel does not change."""
    HUM = "hum"
    """A channel has much more power at the frequency of mains than the other sensors."""
    CLOCK = "clock"
    """The clock is off by more than a clock should be."""
    SENSITIVITY = "sensitivity"
    """A channel reads more or less of the common motion than the other sensors."""
    ALONE = "alone"
    """It shares no motion with sensors that share one."""
    SWAPPED = "swapped"
    """Two channels have traded places."""
    REVERSED = "reversed"
    """A channel is reversed."""
    REFLECTED = "reflected"
    """No way to turn the sensor explains what it measures: some channels are swapped or reversed.
    """
    DISK_FULL = "disk-full"
    """The disk has no room for the recording."""

    OFFSET = "offset"
    """At rest it measures neither gravity nor nothing."""
    COMMON_HUM = "common-hum"
    """Mains are most of the power of all sensors: hum, or motion of machines."""
    NO_SERIAL_NUMBER = "no-serial-number"
    """The device states no serial number."""
    NOT_IN_FILE = "not-in-file"
    """The bench file has no serial number."""
    NO_FULL_SCALE = "no-full-scale"
    """Neither driver nor data sheet say what the full scale is."""
    UNCOUNTED = "uncounted"
    """The device states neither a counter nor times: missing samples would not be seen."""
    UNEVEN = "uneven"
    """Samples arrive too unevenly for the rate to be known well."""
    LEFT_OUT = "left-out"
    """It sends nothing: the other checks leave it out, and those that `text` names are moot."""
    TOO_FEW_SAMPLES = "too-few-samples"
    """It has not sent enough samples."""
    TOO_SLOW = "too-slow"
    """Its sampling rate is too low for this check."""
    TOO_FEW_SENSORS = "too-few-sensors"
    """Fewer than three sensors can be compared."""
    NOT_COMPARABLE = "not-comparable"
    """The sensor's motion and that of the others are too weak, or too different, to be compared."""
    DISK_UNKNOWN = "disk-unknown"
    """The free space is not known."""


@dataclass(frozen=True, slots=True)
class CheckFinding:
    """One problem of one sensor, or of one of its channels.

    Attributes
    ----------
    problem : Problem
    sensor : str
        Empty where the whole bench is meant.
    channel : str
        Empty where the whole sensor is meant; two that have traded places: ``X and Y``.
    value : float
        Rate in Hz, missing samples, frequency of hum, error of the clock in ppm, scatter of
        arrivals in s, acceleration at rest in m/s², correlation, gain, share of the full scale, or
        bytes that are free, bits, or rate of new readings in Hz; NaN where there is none.
    wanted : float
        Rate of the bench file in Hz, or bytes that the recording takes; NaN where there is none.
    text : str
        Of the error that was raised, or the checks that are moot.
    against : tuple of str
        Sensors that agree with each other, and not with this one.
    cause : Cause or None
        What is likely to be wrong with a sensitivity.
    """

    problem: Problem
    sensor: str = ""
    channel: str = ""
    value: float = math.nan
    wanted: float = math.nan
    text: str = ""
    against: tuple[str, ...] = ()
    cause: Cause | None = None


@dataclass(frozen=True, slots=True)
class CheckRow:
    """One row of the list: a check that passed, or one finding of it."""

    check: Check
    finding: CheckFinding | None = None

    @property
    def outcome(self) -> CheckOutcome:
        """What the row says."""
        if self.finding is None:
            return CheckOutcome.PASSED
        return (
            CheckOutcome.NOT_CHECKED if self.finding.problem in UNDECIDED else CheckOutcome.FAILED
        )


UNDECIDED = frozenset(list(Problem)[list(Problem).index(Problem.OFFSET) :])
"""What may be right or wrong, or says why a check could not be made."""
