"""The facts of an estimate on times that are wrong, or may be."""

from __future__ import annotations

from typing import Any

from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.results.facts.clocks import (
    ClockNotUnderstood,
    ClockSet,
    RatesNominal,
    SamplesUncounted,
    StatedTimesDrift,
    StatedTimesUnchecked,
)
from daq.results.result import Result

_WRONG = (
    ClockNotUnderstood
    | ClockSet
    | RatesNominal
    | SamplesUncounted
    | StatedTimesDrift
    | StatedTimesUnchecked
)


def clock_facts(snapshot: Snapshot) -> list[Any]:
    """Return the facts on times, the worst first; each test knows which kind it expects."""
    return [fact for fact in Result(snapshot, Settings()).facts if isinstance(fact, _WRONG)]
