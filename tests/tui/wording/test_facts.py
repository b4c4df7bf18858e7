"""Facts, advice and flags: every kind has words, and every renderer shows the same words."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, combinations
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.linalg import block_diag

import huddle
from daq.clocks.clock_model import ClockSource
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Bridged, Octave, Snapshot
from daq.estimation.snapshot_diagnostics import SnapshotDiagnostics, Synchronisation
from daq.results.facts.all_facts import ranked
from daq.results.facts.fact import Fact, Finding
from daq.results.facts.methods import WITHOUT_ESTIMATE, MethodRefused
from daq.results.facts.model import ModelPasses
from daq.results.facts.recordings import _OF_CAVEATS, BlocksDamaged, SensorsSimulated
from daq.results.facts.segments import GapsBridged
from daq.results.result import Result
from daq.results.vocabulary import FLAG_WORDS
from estimator.checks.advice import Advice, Rank, Untested
from estimator.checks.count_limits import CountLimits
from estimator.self_noise.result import Flag
from estimator.spectra.segment_rejection import Reason
from tests.tui.example_snapshot import (
    SETTINGS,
    STRANGER,
    diagnosed,
    empty_snapshot,
    made_now,
    made_snapshot,
    rotation,
    said,
)
from tests.tui.night_recording import record
from tests.tui.report.written_report import assert_as_kept, result_of
from tests.tui.wording.advice_examples import EXAMPLES as ADVICE
from tests.tui.wording.advice_examples import LEADS, MISFIT, ROTATED, names
from tests.tui.wording.fact_examples import EXAMPLES, FINDINGS, kinds
from tui.application.result_view.result_text import result
from tui.application.state import State
from tui.application.test_view.panels import findings, sensor_table
from tui.application.test_view.plotted import Choice
from tui.output.console import console
from tui.output.diagnosis import details
from tui.output.json_document import document
from tui.output.json_values import json_text
from tui.report.contents import report_of
from tui.wording.facts import MOST_LINES, brief

ROOT = Path(__file__).parents[3]


def test_every_kind_has_an_example_and_a_name_of_its_own() -> None:
    assert {type(each) for each in EXAMPLES} == kinds()
    assert len({each.name for each in kinds()}) == len(kinds())


def test_every_kind_has_one_maker() -> None:
    """Decision 0027: what is made in two places is known in one and missing in another."""
    made = [
        each.group(1)
        for path in chain.from_iterable((ROOT / part).rglob("*.py") for part in ("daq", "tui"))
        for each in re.finditer(r"\b(\w+)\(\s*rank=", path.read_text("utf-8"))
    ]
    advice = {kind.__name__ for kind in kinds(Advice)}
    made = [each for each in made if each not in advice]
    made += [kind.__name__ for kind in _OF_CAVEATS.values()]
    assert set(made) == {kind.__name__ for kind in kinds()}
    assert {kind for kind in made if made.count(kind) > 1} == {"ChannelsStuck"}  # now, and earlier


@pytest.mark.parametrize("fact", EXAMPLES, ids=lambda fact: str(fact.name))
def test_words_are_a_line_and_sentences(fact: Fact) -> None:
    words = fact.words
    assert not words.line.endswith(".")
    assert "\n" not in words.line
    assert "nan" not in str(words)
    assert len(words.line) <= 140, words.line
    if fact.rank is not Rank.TO_KNOW and not isinstance(fact, Finding):
        assert words.explanation[0].isupper() or words.explanation.startswith(fact.method)


def test_all_words_of_all_kinds_are_as_kept() -> None:
    lines = (
        f"{fact.name}, {fact.rank}: {each}"
        for fact in (*EXAMPLES, *FINDINGS)
        for each in (fact.words.line, fact.words.explanation, fact.words.action)
        if each
    )
    assert_as_kept(lines, Path(__file__).parent / "words.txt")


def _diagnosed_with(**changes: object) -> Snapshot:
    """Return a snapshot with changes of its diagnostics."""
    whole = diagnosed()
    return replace(whole, diagnostics=replace(whole.diagnostics, **changes))  # type: ignore[arg-type]  # of several types


def _of_channels(column: int, factor: float) -> Snapshot:
    change = np.eye(9)
    change[column, column] = factor
    return diagnosed(change)


def _flagged(snapshot: Snapshot, flags: dict[Flag, tuple[slice, slice]]) -> Snapshot:
    results = {}
    for method, noise in snapshot.results.items():
        found = noise.flags.copy()
        for flag, at in flags.items():
            found[at] |= flag
        results[method] = replace(noise, flags=found)
    return replace(snapshot, results=results)


def _made() -> Iterator[tuple[str, Snapshot]]:
    """Yield results with something that the first has not, or without what it has."""
    whole = diagnosed()
    yield "whole", whole
    (noise, *_) = whole.results.values()
    refused = {"maximum-likelihood": "expected what is not there"}
    clocks = (replace(whole.clocks[0], refined=False, drifts=True), *whole.clocks[1:])
    yield "few averages", made_snapshot(n_effective=6.0)
    yield "clocks that matter", made_snapshot(clock_share=0.3)
    yield "a clock that drifts", replace(whole, clocks=clocks)
    yield "nothing yet", empty_snapshot()
    results = {"two-channel": replace(noise, method="two-channel")}
    yield "two channels", replace(whole, results=results)
    yield "young", replace(empty_snapshot(), refused=refused, elapsed=1.0)
    yield "refused while it runs", replace(made_snapshot(), refused=refused)
    yield "refused, old, none", replace(whole, results={}, refused=refused, closed=False)
    yield "refused, none", replace(whole, results={}, refused=refused)
    once = tuple(replace(each, n_gaps=1, n_missing=1) for each in whole.sensors)
    yield "one gap", replace(whole, sensors=once)
    turns = (rotation(-2 * angle) for angle in (0.0, 5.0, 9.0))
    yield "rotated the other way", diagnosed(block_diag(*turns))
    yield "reversed", _of_channels(5, -1)
    swapped = np.eye(9)
    swapped[6:8] = swapped[[7, 6]]
    yield "swapped", diagnosed(swapped)
    everywhere, one = slice(None), slice(4, 5)
    flags = {Flag.DEAD_CHANNEL: (everywhere, one), Flag.SINGULAR: (everywhere, slice(1))}
    yield "dead", _flagged(_of_channels(4, 0), flags)
    yield "pooled", _flagged(whole, {Flag.POOLED: (slice(20, 41), everywhere)})
    octaves = (
        Octave(0.0, 20.0, 20.0, 50, 47.0, {Reason.GAP: 1, Reason.TRANSIENT: 0}),
        Octave(20.1, 100.0, 10.0, 100, 94.0, {Reason.GAP: 2, Reason.TRANSIENT: 3}),
    )
    yield "octaves", replace(whole, octaves=octaves)
    yield "one octave", replace(whole, octaves=octaves[1:])
    many = (*whole.channels, *88 * whole.channels[-1:])
    yield "many channels", replace(whole, channels=many, results={})
    yield "clipped", _diagnosed_with(counts=CountLimits({3: 0.046}))
    yield "stood still", _diagnosed_with(stood_still={4: 30.0})
    yield "9 averages", diagnosed(n_effective=9.0)
    for n_factors in (0, 1, 4, 6):
        yield f"{n_factors} dimensions", diagnosed(n_factors=n_factors)
    for why in Untested:
        yield (
            f"untested, {why}",
            replace(made_snapshot(), diagnostics=SnapshotDiagnostics(untested=why)),
        )
    assert whole.diagnostics.diagnosis is not None
    stranger = replace(whole.diagnostics.diagnosis, advice=(STRANGER,))
    for late in (7e-3, 1e-5):
        left = Synchronisation(residual={"A": late, "B": 0.0, "C": 1e-7})
        yield f"{late} s late", _diagnosed_with(synchronisation=left)
        yield f"{late} s late, elsewhere", _diagnosed_with(synchronisation=left, diagnosis=stranger)


def test_the_facts_of_made_results_are_as_kept() -> None:
    """Of all but the first, what differs from it: ``+`` what it has not, ``-`` what it has."""
    lines: list[str] = []
    first: list[str] = []
    for name, snapshot in _made():
        facts = [f"{fact.rank}, {fact.name}: {fact}" for fact in Result(snapshot, SETTINGS).facts]
        lines += [f"{name}: + {fact}" for fact in facts if fact not in first]
        lines += [f"{name}: - {fact.partition(':')[0]}" for fact in first if fact not in facts]
        first = first or facts
    assert_as_kept(lines, Path(__file__).parent / "facts.txt")


def test_the_model_passes_only_where_every_clock_is_understood() -> None:
    snapshot = diagnosed()
    names = {each.name for each in Result(snapshot, SETTINGS).facts}
    first, *others = snapshot.clocks
    clocks = (replace(first, is_understood=False), *others)
    doubtful = {each.name for each in Result(replace(snapshot, clocks=clocks), SETTINGS).facts}
    passes = next(each.name for each in EXAMPLES if isinstance(each, ModelPasses))
    assert passes in names
    assert passes not in doubtful


def test_findings_of_one_kind_name_sensors_only_if_each_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    snapshot = diagnosed()
    for sensors, named in ((((0,), (2,)), ("A", "C")), (((0,), ()), ())):
        advice = tuple(replace(MISFIT, sensors=each) for each in sensors)
        diagnostics = replace(snapshot.diagnostics, dimensions=())
        monkeypatch.setattr(SnapshotDiagnostics, "advice", advice)
        facts = Result(replace(snapshot, diagnostics=diagnostics), SETTINGS).facts
        (found,) = (each for each in facts if isinstance(each, Finding))
        assert found.sensors == named


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("facts") / "night.h5")


def test_every_renderer_shows_every_kind(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Console, application, report, JSON and notebook take their facts from one function."""
    snapshot = diagnosed()
    monkeypatch.setattr("daq.results.result.facts_of", lambda *_: tuple(EXAMPLES))
    shown = {
        "console": printed(*details(snapshot, Result(snapshot, Settings()).facts)),
        "application": printed(result(state_of(snapshot), width=160)),
        "report": " ".join(
            str(report_of(result_of(SETTINGS, recorded, snapshot=snapshot))).split()
        ),
        "notebook": " ".join(map(str, Result(snapshot, Settings()).facts)),
    }
    entries = json.loads(json_text(document(Result(snapshot, SETTINGS))["facts"]))
    words_of = {fact.name: fact.words for fact in EXAMPLES}
    for renderer, text in shown.items():
        for words in words_of.values():
            assert squeezed(words.explanation) in squeezed(text), renderer
            assert squeezed(words.action) in squeezed(text), renderer
    assert {(entry["kind"], entry["rank"]) for entry in entries} == {
        (fact.name, fact.rank) for fact in EXAMPLES
    }
    for entry in entries:
        words = words_of[entry["kind"]]
        assert (entry["line"], entry["explanation"]) == (words.line, words.explanation)


def test_of_one_rank_what_concerns_most_of_the_band_asked_for_stands_first() -> None:
    bands = (2.0, 3.0), (15.0, 30.0), (5.0, 8.0), None
    fact = next(each for each in EXAMPLES if each.rank is Rank.DELAYS)
    facts = [replace(fact, band=band) for band in bands]
    asked = Result(diagnosed(), replace(SETTINGS, band=(1.0, 10.0)))
    found = [each.band for each in ranked(facts, asked)]
    assert found == [None, (5.0, 8.0), (2.0, 3.0), (15.0, 30.0)]


@pytest.mark.parametrize("fact", EXAMPLES, ids=lambda fact: str(fact.name))
def test_below_a_table_is_what_delays_or_invalidates(
    fact: Fact, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshot = diagnosed()
    monkeypatch.setattr("daq.results.result.facts_of", lambda *_: (fact,))
    live = [line.plain for line in findings(Result(snapshot, Settings()), width=400)]
    if fact.rank is Rank.TO_KNOW:
        assert len(live) == isinstance(fact, SensorsSimulated)
        assert brief(Result(snapshot, Settings()).facts) == [
            "Nothing to do. 1 fact: --details shows all"
        ]
    else:
        (line,) = live
        assert line.endswith(fact.words.line)
        assert brief(Result(snapshot, Settings()).facts) == [line]


def test_a_notebook_has_the_facts_of_the_result() -> None:
    model = huddle.simulate("fig9", duration="1min")
    found = huddle.self_noise(model, fs=model.fs, segment="2s")
    assert found.facts == found.result.facts
    assert set(found.advice) <= {str(each) for each in found.facts}


def test_below_a_table_there_are_at_most_three_lines_the_worst_first() -> None:
    ranks = {rank: number for number, rank in enumerate(Rank)}
    ordered = sorted(EXAMPLES, key=lambda each: ranks[each.rank])
    for n in range(1, len(ordered) + 1):
        lines = brief(ordered[:n])
        assert 1 <= len(lines) <= MOST_LINES
        assert lines[0].startswith("✗")
    assert lines[-1] == f"· {len(ordered) - 2} more facts: --details shows all"
    assert brief([]) == ["Nothing to do."]


def test_bridged_gaps_and_damaged_blocks_are_facts_of_the_result() -> None:
    """The signed report said "None excluded" where gaps were bridged, and nothing of damage."""
    snapshot = made_snapshot()
    leakage = np.full((len(snapshot.frequency), len(snapshot.channels)), -0.01)
    damaged = tuple(replace(each, n_damaged=2) for each in snapshot.sensors[:1])
    snapshot = replace(
        snapshot,
        sensors=(*damaged, *snapshot.sensors[1:]),
        bridged=Bridged(n_segments=3, lost=0.02, leakage=leakage),
    )
    bridged = Result(snapshot, SETTINGS).facts
    (blocks,) = [each for each in bridged if isinstance(each, BlocksDamaged)]
    assert (blocks.sensors, blocks.n_blocks) == (("A",), 2)
    (gaps,) = [each for each in bridged if isinstance(each, GapsBridged)]
    assert gaps.n_segments == 3
    assert gaps.leakage == pytest.approx(0.01)


def state_of(snapshot: Snapshot) -> State:
    return State("bench", result=Result(snapshot, SETTINGS))


def printed(*parts: object) -> str:
    screen = Console(width=160, record=True, file=io.StringIO())
    for part in parts:
        screen.print(part)
    return screen.export_text()


def squeezed(text: str) -> str:
    """Return text without blanks: renderers wrap it."""
    return "".join(text.split())


def test_a_method_that_waits_for_averages_invalidates_no_test_that_goes_on() -> None:
    ended = replace(made_snapshot(), results={}, refused={"three-sensor": "1 average"}, closed=True)
    for snapshot, rank in ((ended, Rank.INVALIDATES), (replace(ended, closed=False), Rank.TO_KNOW)):
        (refused,) = (
            each for each in Result(snapshot, SETTINGS).facts if isinstance(each, MethodRefused)
        )
        assert refused.rank is rank


# --- advice ----------------------------------------------------------------------------------


def test_every_kind_has_words() -> None:
    assert {type(advice) for advice in ADVICE} == kinds(Advice)


def test_what_to_do_about_a_misfit_is_for_these_sensors() -> None:
    three = MISFIT.words(names("a", "b", "c")).action
    assert "triaxial data" not in three
    assert "--dimension auto" not in three
    planar = MISFIT.words(names("a", "b", "c", n_channels=2)).action
    assert "If the motion has more than 2 dimensions, sensors of 2 channels must point" in planar
    assert "use triaxial data" in planar
    five = MISFIT.words(names(*"abcde")).action
    assert "5 sensors allow more dimensions (--dimension auto)" in five
    assert "--method auto" in MISFIT.words(names(*"abcde")).line
    axes = names(*"abcd", n_channels=1)  # --method auto is three-sensor for them
    assert "auto" not in MISFIT.words(axes).action + MISFIT.words(axes).line


def test_nobody_is_told_to_synchronise_a_polled_sensor() -> None:
    made = made_snapshot()
    *others, last = made.clocks
    clocks = (*others, replace(last, source=ClockSource.SAMPLE_INSTANTS))
    words = replace(LEADS, sensors=(1, 2)).words(replace(made, clocks=clocks).names)
    assert words.line == "B lags C by 20 ms: C is polled; let the host do less"
    assert "C is polled, without a clock to set" in words.action
    assert "synchronise" in LEADS.words(replace(made, clocks=clocks).names).line


@pytest.mark.parametrize("advice", ADVICE)
def test_alone_in_a_summary_it_is_what_it_is_alone(advice: Advice) -> None:
    who = names("a", "b", "c")
    fact = Finding(rank=Rank.TO_KNOW, findings=(advice,), names=who)
    assert fact.words == advice.words(who)


def test_of_very_many_pairs_the_worst_are_listed() -> None:
    sensors = tuple(f"S{number}" for number in range(15))
    advice = [
        replace(ROTATED, sensors=pair, angle_deg=float(n), horizontal_deg=float("nan"))
        for n, pair in enumerate(combinations(range(15), 2))
    ]
    line = str(advice[0].together(advice, names(*sensors)))
    assert line.startswith(
        "Sensors are rotated against each other (S13–S14 104.000°, S12–S14 103.000°"
    )
    assert "and less in 95 more pairs): no bias" in line
    assert line.count("°") == 10


# --- flags -----------------------------------------------------------------------------------


def test_every_flag_has_words_of_its_own() -> None:
    assert set(FLAG_WORDS) == set(Flag)
    assert len({words.short for words in FLAG_WORDS.values()}) == len(Flag)
    assert len({words.long for words in FLAG_WORDS.values()}) == len(Flag)


@pytest.mark.parametrize("flag", Flag)
def test_table_and_remarks_take_their_words_from_one_place(flag: Flag) -> None:
    snapshot = made_snapshot()
    noise = snapshot.results["three-sensor"]
    flags = noise.flags.copy()
    flags[:, 4] = flag  # B.Y
    flags[3:, 5] = 0
    results = {"three-sensor": replace(noise, flags=flags)}
    snapshot = replace(snapshot, results=results)
    choice = Choice(methods=("three-sensor",))
    table = sensor_table(made_now(), Result(snapshot, SETTINGS), choice, width=150)
    screen = console()
    with screen.capture() as shown:
        screen.print(table, width=150)
    without = bool(flag & WITHOUT_ESTIMATE)
    assert (f"Y {FLAG_WORDS[flag].short}" in shown.get()) == without
    line = f"three-sensor: B.Y: {FLAG_WORDS[flag].long}, at all frequencies."
    assert any(each.startswith(line) for each in said(snapshot)) == (
        without or flag is Flag.NOT_CONVERGED
    )
