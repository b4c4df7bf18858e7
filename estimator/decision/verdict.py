"""The verdict of a huddle test: pass, fail or not decided, and what keeps it from a decision."""

from __future__ import annotations

import enum
import math
from dataclasses import field

from estimator.records import NOT_IN_JSON, dataclass


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
    NO_CHANNEL = "no-channel"
    """The recording has none of the channels that a limit is for."""
    OUTSIDE_SPECTRUM = "outside-spectrum"
    """The limit has no frequency in common with the spectrum."""
    NO_SHARED_MOTION = "no-shared-motion"
    """A sensor records none of the motion that the others share: no noise can be told from it."""
    FAULTY_CHANNEL = "faulty-channel"
    """The channel is clipped or was dead for a while: its noise is lower than the estimate."""
    SENSITIVITY = "sensitivity"
    """The motion contradicts the channel's sensitivity, and the verdict depends on it."""
    MODEL_MISFIT = "model-misfit"
    """One common motion does not explain the averages: the estimate may be too far off."""
    CLOCKS = "clocks"
    """The clocks may have added what is above the limit, or taken it away, or are not known."""
    TOO_FEW_AVERAGES = "too-few-averages"
    """With so few averages the interval cannot be trusted."""
    SPANS_LIMIT = "spans-limit"
    """The limit lies within the interval: a longer recording narrows it."""


MIN_AVERAGES = 20.0
"""Averages below which the far tails of the interval have not been verified by simulation."""
CLOSE = 1.3
"""Length of a test over the predicted one up to which the prediction is a close one."""
REMOVED_BY_TIME = frozenset({Obstacle.TOO_FEW_AVERAGES, Obstacle.SPANS_LIMIT})
"""Obstacles that a longer recording removes."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """How long a recording takes to decide.

    Attributes
    ----------
    seconds : float or None
        Total length after which a test that ends once it is decided is as likely to have ended as
        not; None where `longest` is not long enough.
    earliest : float or None
        Length before which it has ended with a probability of 10 %.
    latest : float or None
        Length before which it has ended with a probability of 90 %.
    longest : float
        Longest recording considered, in seconds.
    resolution_db : float
        Half the width of the interval in that recording, in dB, where the noise is closest to the
        limit.
    slowest : int
        Which of the channels beside their limits takes longest to pass, or fails first.
    is_pass : bool
        Whether it is rather a pass that decides.
    frequency : float
        Centre of the band where it does, in Hz.
    is_bounded : bool
        Whether the longest would decide if scatter alone made intervals wide.
    """

    seconds: float | None
    longest: float = field(metadata={"type": "number"})
    resolution_db: float
    earliest: float | None
    latest: float | None
    slowest: int = field(metadata=NOT_IN_JSON)
    is_pass: bool = field(metadata=NOT_IN_JSON)
    frequency: float = field(default=math.nan, metadata=NOT_IN_JSON)
    is_bounded: bool = field(default=False, metadata=NOT_IN_JSON)

    @property
    def is_close(self) -> bool:
        """Whether the length is right within 30 % with a probability of 80 %."""
        if self.seconds is None or self.earliest is None or self.latest is None:
            return False
        return self.earliest >= self.seconds / CLOSE and self.latest <= CLOSE * self.seconds
