"""What is known of a verdict: wrong sensitivities, obstacles, what is not judged."""

from __future__ import annotations

import math
from collections.abc import Mapping

from daq.results.facts.fact import Fact
from estimator.checks.sensitivities import CAUSES, Cause
from estimator.decision.verdict import MIN_AVERAGES, Obstacle
from estimator.records import Hertz
from estimator.wording import Words, few, listed

_OBSTACLES: Mapping[Obstacle, tuple[str, str]] = {
    Obstacle.SENSORS_LOST: (
        "All sensors were lost before the end",
        "Check power and cables, and record again.",
    ),
    Obstacle.NO_SEGMENTS: (
        "There is no whole segment without a gap",
        "Record longer, or choose a shorter segment.",
    ),
    Obstacle.NO_ESTIMATE: (
        "{channels}: no estimate in a part of the limit",
        "Follow the advice on what is missing, and record again.",
    ),
    Obstacle.NO_CHANNEL: (
        "The recording has no channel that one of {limits} is for",
        "Correct its sensors and channels in the bench file.",
    ),
    Obstacle.OUTSIDE_SPECTRUM: (
        "The spectrum has no frequency of {limits}",
        "Use longer segments or another sampling rate.",
    ),
    Obstacle.NO_SHARED_MOTION: (
        "A sensor records none of the motion that the others share",
        "Follow the advice, and record again.",
    ),
    Obstacle.FAULTY_CHANNEL: (
        "{channels}: clipped or dead for a while, so the noise is lower",
        "Remove the cause and record again.",
    ),
    Obstacle.MODEL_MISFIT: (
        "{channels}: the model test fails, by more than the margin",
        "Follow the advice and record again.",
    ),
    Obstacle.CLOCKS: (
        "{channels}: errors of clocks are too large or not known",
        "Use one clock, or record longer (not --clocks nominal).",
    ),
    Obstacle.TOO_FEW_AVERAGES: (
        "The uncertainty of fewer than {averages:g} averages is not reliable",
        "Record longer.",
    ),
    Obstacle.SPANS_LIMIT: ("The uncertainty of {channels} spans the limit", ""),
}
"""What keeps a test from a decision, and what to do; sensitivities are facts of their own."""


class WrongSensitivity(Fact):
    """Channels of a sensor read more or less of the common motion than the other sensors.

    Attributes
    ----------
    gains, standard_errors : tuple of float
        Motion that each channel reads over that which the others read, and standard errors.
    against : tuple of str
        The sensors that agree; empty where no majority does.
    cause : Cause or None
        What is likely to be wrong.
    """

    gains: tuple[float, ...]
    standard_errors: tuple[float, ...]
    against: tuple[str, ...]
    cause: Cause | None = None

    @property
    def gain(self) -> float:
        """The geometric mean of the gains."""
        return math.exp(math.fsum(map(math.log, self.gains)) / len(self.gains))

    def _words(self) -> Words:
        who = listed(self.sensors if len(self.channels) > 1 else self.channels)
        cause = "" if self.cause is None else f" ({CAUSES[self.cause]})"
        if not self.against:
            text = f"{who} reads {self.gain:.3g} of the other sensors{cause}"
            return Words(
                f"{text}, and no two agree: correct the sensitivities",
                f"{text}, and no two of them agree.",
                "Correct the sensitivities, or give their certificates.",
            )
        text = f"{who} reads {self.gain:.3g} of {listed(self.against)}{cause}"
        if self.cause is Cause.CHANGED:
            return Words(f"{text}: record again", f"{text}.", "Record again.")
        do = "Correct its sensitivity, or give its certificate."
        return Words(f"{text}: correct its sensitivity", f"{text}.", do)


class LimitUndecided(Fact):
    """Something keeps `channels` (empty: all) from a decision on `limits`, by their names."""

    obstacle: Obstacle
    limits: tuple[str, ...]

    def _words(self) -> Words:
        text, do = _OBSTACLES[self.obstacle]
        line = text.format(
            channels=few(self.channels or ["the channels"]),
            limits=few(self.limits or ["the limits"]),
            averages=MIN_AVERAGES,
        )
        step = f": {do[0].lower()}{do[1:-1]}" if do else ""
        return Words(f"{line}{step}", f"{line[0].upper()}{line[1:]}.", do)


class LimitNotJudged(Fact):
    """A limit goes beyond the spectrum, and is not judged there.

    Attributes
    ----------
    limit : str
        Its name.
    covers, judged : (float, float)
        Lowest and highest frequency of the limit, and of its part that is judged, Hz.
    """

    limit: str
    covers: tuple[Hertz, Hertz]
    judged: tuple[Hertz, Hertz]

    def _words(self) -> Words:
        (low, high), (first, last) = self.covers, self.judged
        parts = [f"below {first:.3g} Hz"] if low < first else []
        parts += [f"above {last:.3g} Hz"] if last < high else []
        text = (
            f"Not judged: {self.limit} {listed(parts)}, where there is no estimate (the limit goes "
            f"from {low:.3g} to {high:.3g} Hz)"
        )
        return Words(text, f"{text}.")
