"""Whether a growing recording has what was wanted of it: a precision, or a decision."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.results.decision.limits import judge
from daq.results.precision import precision
from estimator.decision.verdict import Verdict

if TYPE_CHECKING:
    from daq.bench.end_condition import EndCondition
    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.results.decision.verdict import LimitResult, TestVerdict

INTERVAL_FACTOR = 1.25
"""How much wider than the interval of a verdict the one is that ends a test."""


def is_reached(
    end: EndCondition, bench: Bench | None, snapshot: Snapshot, settings: Settings
) -> bool:
    """Return whether a test is to end now by its live estimate.

    Its duration is the recorder's business.
    """
    if end.cov is not None and precision(snapshot, settings).cov <= end.cov:
        return True
    if not end.decided:
        return False
    verdict = judge(bench, snapshot, settings)
    return verdict is not None and is_surely_decided(verdict)


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
