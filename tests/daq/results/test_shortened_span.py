"""A sensor that begins late, or ends early, shortens the estimate: the result says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.results.facts.recordings import SpanShortened
from daq.results.result import Result
from estimator.checks.advice import Rank
from tests.daq.clocks.recordings import Sensor, write

SETTINGS = Settings(segment=2.0)
RATE, SECONDS = 10.0, 1200.0


def estimated(path: Path, *, begin: float = 0.0, end: float = SECONDS) -> Snapshot:
    """Return the estimate of three sensors, of which C has samples from `begin` to `end`, in s."""
    rng = np.random.default_rng(5)
    motion = 1e3 * rng.standard_normal((round(RATE * SECONDS), 1))
    sensors = {}
    for name in "ABC":
        counts = np.rint(motion + 10.0 * rng.standard_normal(motion.shape)).astype(np.int32)
        first, last = (round(RATE * t) for t in ((begin, end) if name == "C" else (0.0, SECONDS)))
        own = first / RATE if name == "C" else 0.0
        sensors[name] = Sensor(counts[first:last], RATE, start=own, utc=True)
    return estimate([write(path, sensors)], SETTINGS)


def shortened(snapshot: Snapshot) -> list[SpanShortened]:
    return [fact for fact in Result(snapshot, SETTINGS).facts if isinstance(fact, SpanShortened)]


@pytest.mark.parametrize(
    ("begin", "end", "seconds", "rank"),
    [
        (200.0, 1200.0, 200.0, Rank.DELAYS),
        (0.0, 1050.0, 150.0, Rank.DELAYS),
        (100.0, 1200.0, 100.0, Rank.TO_KNOW),
    ],
)
def test_what_others_have_beyond_a_sensor_is_said(
    tmp_path: Path, begin: float, end: float, seconds: float, rank: Rank
) -> None:
    snapshot = estimated(tmp_path / "r.h5", begin=begin, end=end)
    (fact,) = shortened(snapshot)
    assert snapshot.elapsed == pytest.approx(SECONDS - seconds, abs=3.0)
    assert (fact.sensors, fact.at_end, fact.rank) == (("C",), end < SECONDS, rank)
    assert fact.unused == pytest.approx(seconds, abs=1.0)


def test_less_than_a_minute_is_no_fact(tmp_path: Path) -> None:
    assert shortened(estimated(tmp_path / "r.h5", begin=50.0, end=1150.0)) == []
