"""The right thing first: what the first lines of a test say, and what they never say together."""

from __future__ import annotations

from dataclasses import replace
from textwrap import wrap

import pytest

from daq.estimation.snapshot import Snapshot
from daq.results.decision.end import Goal, Remaining
from daq.results.result import Result
from estimator.checks.advice import Rank
from estimator.checks.advice_on_model import ModelMisfit
from estimator.decision.verdict import Obstacle, Verdict
from tests.daq.results.decision.benches import bench_with
from tests.tui.example_snapshot import SETTINGS, advised, diagnosed, empty_snapshot, made_snapshot
from tests.tui.wording.fact_examples import EXAMPLES, FINDINGS
from tui.application.test_view.panels import advice, findings, known_to
from tui.application.test_view.plotted import Choice
from tui.commands.estimate import show_result
from tui.notebook import text
from tui.report.noise import verdict
from tui.wording.facts import NOTHING_TO_DO, brief
from tui.wording.verdict_text import REPAIR, Decision, facts_below, how_long, in_tone

ALONE = ModelMisfit(
    rank=Rank.INVALIDATES, sensors=(), band=(0.5, 8.3), statistic=30.0, n_factors=3,
    worst_statistic=30.0, worst_band=(0.5, 8.3), p_value=0.0, unexplained=0.6, error=0.6,
    is_wrong=True, largest_error=0.6,
)  # fmt: skip


def misfit(*, closed: bool = True) -> Snapshot:
    """Return a sound test whose model fails below 8.3 Hz."""
    return replace(advised(diagnosed(), ALONE), closed=closed)


TESTS = {
    "sound": diagnosed(),
    "misfit": misfit(),
    "short": made_snapshot(n_effective=15.0, closed=True),
    "long": made_snapshot(n_effective=5000.0, closed=True),
}
LEVELS = (1e-7, 7e-12, 3e-12, 1e-12, 1e-15)


@pytest.mark.parametrize("psd", LEVELS)
@pytest.mark.parametrize("name", TESTS)
def test_the_first_line_answers_is_it_good_and_what_next(
    name: str, psd: float, capsys: pytest.CaptureFixture[str]
) -> None:
    result = Result(TESTS[name], SETTINGS, bench_with(psd))
    show_result(result, json=None, csv=None)
    lines = capsys.readouterr().out.splitlines()
    assert result.verdict is not None
    decision = Decision.of(result)
    assert decision is not None
    word = {Verdict.PASS: "PASS", Verdict.FAIL: "FAIL", Verdict.NOT_DECIDED: "NOT DECIDED"}
    assert lines[0] == str(decision)
    assert lines[0].startswith(f"{word[decision.state]}: ")
    assert decision.next_step.endswith(".")
    is_good = decision.state is Verdict.PASS
    assert is_good or not any(NOTHING_TO_DO in line for line in lines)
    assert not is_good or "Record" not in lines[0]
    assert sum(decision.next_step in line for line in lines) == 1 + is_good * (
        NOTHING_TO_DO in "".join(lines[1:])
    )
    assert text.text(result).splitlines()[0].startswith(lines[0][:90])
    assert verdict(result).text.startswith(lines[0])
    needed = {each.rank for each in result.facts if each.needs_action}
    assert (decision.next_step == NOTHING_TO_DO) == (is_good and not needed)
    is_bad = decision.state is Verdict.FAIL
    assert (decision.next_step == REPAIR) == (is_bad and Rank.INVALIDATES not in needed)


def test_the_tests_above_have_all_verdicts() -> None:
    found = {
        decided.verdict
        for each in TESTS.values()
        for psd in LEVELS
        if (decided := Result(each, SETTINGS, bench_with(psd)).verdict) is not None
    }
    assert found == set(Verdict)


def test_a_fact_outside_the_band_is_not_the_first_line() -> None:
    """The first line was "at 0–8.3 Hz: wrong by 60 %", with --band 8.6:15 where all was right."""
    whole = Result(misfit(), replace(SETTINGS, band=None)).facts
    assert brief(whole)[0].startswith("✗ The sensors do not share one motion at 0.5–8.3 Hz")
    asked = Result(misfit(), replace(SETTINGS, band=(8.6, 15.0), target_cov=None))
    (line,) = brief(asked.facts)
    assert line.startswith(NOTHING_TO_DO)
    assert "outside your band" in line
    assert str(asked.facts[-1]).startswith("Outside your band: The model test fails at 0.5–8.3")
    limited = Result(misfit(), asked.settings, bench_with(1e-9))  # from 1 to 30 Hz
    assert brief(limited.facts)[0].startswith("✗ The sensors do not share one motion")


@pytest.mark.parametrize("seconds", [0.0, 40.0])
def test_enough_is_never_recorded_of_a_test_that_is_not_decided(seconds: float) -> None:
    found = Result(diagnosed(n_effective=50.0), SETTINGS, bench_with(1e-12)).verdict
    assert found is not None
    sure = replace(found, verdict=Verdict.PASS)
    open_ = replace(sure, verdict=Verdict.NOT_DECIDED, prediction=None)
    left = Remaining(Goal.DECISION, seconds, verdict=open_)
    assert "Enough" not in how_long(left, None)
    assert how_long(replace(left, seconds=0.0, verdict=sure), None).startswith("Enough is recorded")


@pytest.mark.parametrize("n_effective", [0.0, 5.0])
def test_a_young_test_has_nothing_yellow(n_effective: float) -> None:
    """Every test began with a yellow "the model test needs averages"."""
    young = diagnosed(n_effective=n_effective) if n_effective else empty_snapshot()
    young = replace(young, closed=False)
    result = Result(young, SETTINGS, bench_with(1e-12))
    assert findings(Result(young, SETTINGS), width=200) == []
    assert advice(Result(young, SETTINGS), Choice()).tone != "doubtful"
    assert result.verdict is not None
    assert result.verdict.verdict is Verdict.NOT_DECIDED
    assert findings(Result(diagnosed(n_effective=5.0), SETTINGS), width=200)  # it has ended


def test_a_verdict_is_yellow_once_time_alone_does_not_decide() -> None:
    found = Result(made_snapshot(n_effective=15.0), SETTINGS, bench_with(3e-12)).verdict
    assert found is not None
    assert found.verdict is Verdict.NOT_DECIDED
    assert in_tone("", found, grows=True).tone == "quiet"
    assert in_tone("", found, grows=False).tone == "doubtful"


def test_scatter_is_not_called_how_well_the_noise_is_known() -> None:
    """It said "known to 3.3 %" beside +1.35 −4.08 dB."""
    reached = Result(diagnosed(), SETTINGS).precision(0.05)
    assert known_to(reached).startswith("worst c.o.v. ")
    assert known_to(replace(reached, cov=19.0)) == "worst c.o.v. above 1000 %, wanted 5 %"


def test_a_test_that_lacks_a_sensor_is_not_decided_for_that_reason() -> None:
    found = Decision.of(
        Result(replace(diagnosed(), not_estimated=("D",)), SETTINGS, bench_with(1e-7))
    )
    assert found is not None
    assert found.state is Verdict.NOT_DECIDED
    assert found.reason == (
        "NOT DECIDED: 9 channels are below data sheet, the others have no result."
    )


@pytest.mark.parametrize("verdict", Verdict)
def test_the_first_line_names_the_weightiest_fact_and_fits_in_two_lines(verdict: Verdict) -> None:
    result = Result(misfit(), SETTINGS, bench_with(7e-12))
    assert result.verdict is not None
    assert result.verdict.verdict is Verdict.FAIL
    obstacles = (Obstacle.MODEL_MISFIT,) if verdict is Verdict.NOT_DECIDED else ()
    result.__dict__["verdict"] = replace(result.verdict, verdict=verdict, obstacles=obstacles)
    named = []
    facts = [*EXAMPLES, *FINDINGS]
    for fact in facts:
        result.__dict__["facts"] = (fact,)
        decision = Decision.of(result)
        assert decision is not None
        assert len(wrap(str(decision), 80)) <= 2, str(decision)
        if decision.fact is fact:
            assert decision.next_step == f"{fact.words.line}."
            named.append(fact)
        assert len([line for line in facts_below(result) if fact.words.line in line]) == (
            fact.needs_action and decision.fact is not fact
        )
    usual = [each for each in facts if each.needs_action]
    if verdict is Verdict.FAIL:
        usual = [each for each in usual if each.rank is Rank.INVALIDATES]
    assert named == usual
