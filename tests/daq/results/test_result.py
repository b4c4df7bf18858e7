"""A result derives each quantity once, whoever asks, and however often."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from daq.estimation import contributions
from daq.results import band_summary, result, standing
from daq.results.decision import limits
from daq.results.facts.fact import Finding
from daq.results.result import Result
from estimator.checks.advice import Rank
from estimator.checks.advice_on_noise import DisturbedSegments
from tests.daq.results.decision.benches import bench_with
from tests.tui.example_snapshot import SETTINGS, diagnosed
from tui.commands.estimate import show_result
from tui.output.json_document import document

ONCE = (
    (limits, "judge"),
    (result, "facts_of"),
    (result, "facts_of_verdict"),
    (result, "effect_by_sensor"),
    (band_summary, "band_of"),
    (band_summary, "judged_method"),
    (band_summary, "data_means"),
    (band_summary, "without_partners"),
    (contributions, "_unexplained"),  # of `may_share`
    (standing, "coherency"),  # of `pair_coherence`
)


def test_an_estimate_derives_each_quantity_once(monkeypatch: pytest.MonkeyPatch) -> None:
    counts: Counter[str] = Counter()

    def counted(module: object, name: str) -> None:
        derive = getattr(module, name)

        def count(*args: object, **options: object) -> object:
            counts[name] += 1
            return derive(*args, **options)

        monkeypatch.setattr(module, name, count)

    for module, name in (*ONCE, (contributions, "_dimensions")):
        counted(module, name)
    found = Result(contributions.with_contributions(diagnosed()), SETTINGS, bench_with(1e-9))
    for _ in range(2):
        show_result(found, json=None, csv=None, diagnostics=True)
        document(found)
    methods = len(found.snapshot.results)
    assert methods > 1
    once = {name for _, name in ONCE} - {"effect_by_sensor"}  # nothing here shows the clocks
    assert counts == dict.fromkeys(once, 1) | {"_dimensions": methods}  # of `contributions`


def test_means_of_a_band_are_made_once() -> None:
    found = Result(diagnosed(), SETTINGS)
    assert found.means("three-sensor") is found.means("three-sensor", found.band)
    assert found.means("three-sensor", (2.0, 3.0)) is not found.means("three-sensor")


def test_segments_that_lower_the_noise_are_disturbed_where_nothing_leaks() -> None:
    """Without leakage, less than no excess was taken for leakage, and not said."""
    snapshot = diagnosed()
    disturbed = DisturbedSegments(
        rank=Rank.DELAYS, sensors=(1,), n_disturbed=7, n_segments=240, times=(295.0,),
        excess=-0.1, channel=4,
    )  # fmt: skip
    found = snapshot.diagnostics.diagnosis
    assert found is not None
    found = replace(found, advice=(*found.advice, disturbed))
    changed = replace(snapshot, diagnostics=replace(snapshot.diagnostics, diagnosis=found))
    facts = Result(changed, SETTINGS).facts
    assert disturbed in [
        each for fact in facts if isinstance(fact, Finding) for each in fact.findings
    ]
