"""What is wanted of a test: when it ends by itself, and what is noted of it. No Textual here."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from daq.bench.durations import format_duration, parse_duration
from daq.results.decision.verdict import Verdict
from daq.results.precision import precision
from tui.output.formatting import percent

if TYPE_CHECKING:
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.results.decision.verdict import LimitResult, TestVerdict

INTERVAL_FACTOR = 1.25
"""How much wider than the interval of a verdict the one is that ends a test."""


@dataclass(frozen=True, slots=True)
class TestPlan:
    """What was entered when a test was started.

    Attributes
    ----------
    operator : str or None
        None: that of the bench file.
    note : str
        Recorded as a mark at the start.
    duration : float or None
        Seconds after which the recorder ends by itself.
    cov : float or None
        Scatter of the noise at one frequency with which the test ends.
    until_decided : bool
        Whether the test ends once it is decided against the limits.
    """

    operator: str | None = None
    note: str = ""
    duration: float | None = None
    cov: float | None = None
    until_decided: bool = False

    __test__ = False  # for pytest

    @property
    def ends_by_estimate(self) -> bool:
        """Whether the test ends by what the live estimate says."""
        return self.until_decided or self.cov is not None

    def is_reached(
        self, snapshot: Snapshot, settings: Settings, verdict: TestVerdict | None
    ) -> bool:
        """Return whether the test is to end now; its duration is the recorder's business."""
        if self.cov is not None and precision(snapshot, settings).cov <= self.cov:
            return True
        return self.until_decided and verdict is not None and is_surely_decided(verdict)


def is_surely_decided(found: TestVerdict) -> bool:
    """Return whether a verdict is decided with more than its own interval.

    A test that may end at any of many looks gets as many chances of a wrong verdict. Its intervals
    therefore count as `INTERVAL_FACTOR` times as wide: at the three to four standard deviations of
    a verdict on many bands this makes a single look ten times less likely to be wrong.
    """
    if found.verdict is Verdict.FAIL:
        return any(each.verdict is Verdict.FAIL and _is_sure(each) for each in found.limits)
    return found.verdict is Verdict.PASS and all(_is_sure(each) for each in found.limits)


def _is_sure(result: LimitResult) -> bool:
    if result.verdict is Verdict.PASS:
        bound = result.noise_psd + INTERVAL_FACTOR * (result.high - result.noise_psd)
        return bound < result.limit_psd
    bound = result.noise_psd - INTERVAL_FACTOR * (result.noise_psd - result.low)
    return bound > result.limit_psd


def parse_end(text: str) -> TestPlan:
    """Return a plan from text such as ``3h``, ``5 %``, ``decided``, or ``decided, 3h``.

    Raises
    ------
    ValueError
        With what was expected.
    """
    plan = TestPlan()
    for part in (part.strip() for part in text.split(",") if part.strip()):
        if part == "decided":
            plan = replace(plan, until_decided=True)
        elif part.endswith("%"):
            plan = replace(plan, cov=_share(part))
        else:
            plan = replace(plan, duration=parse_duration(part))
    return plan


def _share(text: str) -> float:
    try:
        value = float(text.removesuffix("%")) / 100
    except ValueError:
        value = 0.0
    if not 0 < value < 1:
        raise ValueError(f"{text}: expected a precision between 0 and 100 %, such as 5 %")
    return value


def end_text(plan: TestPlan) -> str:
    """Return when a test ends, as `parse_end` reads it."""
    parts = ["decided"] if plan.until_decided else []
    parts += [] if plan.cov is None else [percent(plan.cov)]
    parts += [] if plan.duration is None else [format_duration(plan.duration)]
    return ", ".join(parts)
