"""Benches with a mask, and the verdict on a snapshot by one."""

from __future__ import annotations

from importlib import resources

from daq.bench.loading import parse
from daq.bench.model import Bench
from daq.estimation.snapshot import Snapshot
from daq.results.decision.verdict import TestVerdict
from daq.results.result import Result
from tests.tui.example_snapshot import SETTINGS

MASK = """
[[limits]]
name = "data sheet"
frequency = [1.0, 30.0]
psd = [{psd}, {psd}]
{more}
"""


def bench_with(psd: float, more: str = "") -> Bench:
    text = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    return parse(text + MASK.format(psd=psd, more=more))


def verdict_on(snapshot: Snapshot, psd: float, more: str = "") -> TestVerdict:
    found = Result(snapshot, SETTINGS, bench_with(psd, more)).verdict
    assert found is not None
    return found
