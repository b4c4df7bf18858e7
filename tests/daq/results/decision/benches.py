"""Benches with a mask, and the verdict on a snapshot by one."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources

from daq.bench.loading import parse
from daq.bench.model import Bench
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.results.decision.verdict import TestVerdict
from daq.results.result import Result
from tests.tui.example_snapshot import SETTINGS

PLAIN = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
"""Without limits."""
MASK = """
[[limits]]
name = "data sheet"
frequency = {frequency}
psd = {psd}
{more}
"""


def bench_with(
    psd: float | Sequence[float], more: str = "", *, frequency: Sequence[float] = (1.0, 30.0)
) -> Bench:
    """Return a bench with a mask of one or several values."""
    values = [psd] * len(frequency) if isinstance(psd, float) else [*psd]
    return parse(PLAIN + MASK.format(frequency=[*frequency], psd=values, more=more))


def verdict_on(
    snapshot: Snapshot,
    psd: float | Sequence[float],
    more: str = "",
    *,
    frequency: Sequence[float] = (1.0, 30.0),
    settings: Settings = SETTINGS,
) -> TestVerdict:
    """Return the verdict by such a bench: there is one."""
    found = Result(snapshot, settings, bench_with(psd, more, frequency=frequency)).verdict
    assert found is not None
    return found
