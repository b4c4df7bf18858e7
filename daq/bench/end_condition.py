"""When a test ends by itself: after a time, at a precision, or when its limits are decided.

The condition belongs to the recording: `huddle record` writes it there and obeys it. A window or a
service that is closed and opened again changes nothing.
"""

from __future__ import annotations

from dataclasses import replace

from daq.bench.durations import format_duration, parse_duration
from estimator.records import dataclass


@dataclass(frozen=True, slots=True)
class EndCondition:
    """When a test ends by itself: at the first of the conditions; without any, never.

    Attributes
    ----------
    duration : float or None
        In seconds.
    cov : float or None
        Coefficient of variation of the noise in the worst third of an octave of the band.
    decided : bool
        Whether the test ends once all limits are met, or one is not.
    """

    duration: float | None = None
    cov: float | None = None
    decided: bool = False

    @property
    def is_estimated(self) -> bool:
        """Whether the end depends on the live estimate."""
        return self.decided or self.cov is not None

    @property
    def estimated(self) -> EndCondition:
        """The part that depends on the live estimate."""
        return replace(self, duration=None)

    @property
    def text(self) -> str:
        """The condition as `of_text` reads it: ``decided, 5 %, 3h``; empty without any."""
        parts = ["decided"] if self.decided else []
        parts += [] if self.cov is None else [f"{self.cov * 100:.4g} %"]
        parts += [] if self.duration is None else [format_duration(self.duration)]
        return ", ".join(parts)

    @classmethod
    def of_text(cls, text: str) -> EndCondition:
        """Return a condition from text such as ``3h``, ``5 %``, ``decided``, or ``decided, 3h``.

        Raises
        ------
        ValueError
            With what was expected.
        """
        found = cls()
        for part in (part.strip() for part in text.split(",") if part.strip()):
            if part == "decided":
                found = replace(found, decided=True)
            elif part.endswith("%"):
                found = replace(found, cov=_share(part))
            else:
                found = replace(found, duration=parse_duration(part))
        return found


NEVER = EndCondition()
"""A test without an end of its own: somebody stops it."""


def _share(text: str) -> float:
    try:
        value = float(text.removesuffix("%")) / 100
    except ValueError:
        value = 0.0
    if not 0 < value < 1:
        raise ValueError(f"{text}: expected a precision between 0 and 100 %, such as 5 %")
    return value
