"""When a test ends by itself, and who is told: the start form, targets, bell and command."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest
from textual.events import Key

from daq.bench.editing import with_values
from daq.bench.end_condition import EndCondition
from daq.caveats import Caveat, Caveats
from daq.devices.bench_file import load, parse
from daq.errors import BenchFileError, HuddleError
from daq.recording.sensor_state import SensorState
from daq.results.result import Result
from estimator.decision.verdict import Verdict
from tests.tui.application.screen_text import screen_text
from tests.tui.application.test_app import ended, opened, pressed, running, settled, shown
from tests.tui.example_snapshot import (
    LIMIT,
    SETTINGS,
    ProgressCallback,
    demo_bench,
    judged,
    made_now,
    made_snapshot,
)
from tui.application.messages import StatusUpdated
from tui.application.plan import TestPlan
from tui.application.state import TEST, State
from tui.application.view import status_line
from tui.commands.tui_controls import BenchControls, announce
from tui.wording.verdict_text import WORDS


@pytest.mark.parametrize(
    ("text", "plan"),
    [
        ("", EndCondition()),
        ("3h", EndCondition(10800.0)),
        ("5 %", EndCondition(cov=0.05)),
        ("decided, 90 min", EndCondition(5400.0, decided=True)),
    ],
)
def test_the_end_is_read_and_written_alike(text: str, plan: EndCondition) -> None:
    assert EndCondition.of_text(text) == plan
    assert EndCondition.of_text(plan.text) == plan


@pytest.mark.parametrize("text", ["soon", "120 %", "x %", "decided or so", "-3h"])
def test_what_is_no_end_is_refused_with_what_was_expected(text: str) -> None:
    with pytest.raises(ValueError, match="expected"):
        EndCondition.of_text(text)


async def test_the_form_takes_operator_note_and_end(told: ProgressCallback) -> None:
    async with opened(told) as (app, pilot):
        await pressed(pilot, app, "s")
        for key in (*"ann", "tab", *"hot", "tab"):  # in one burst, as from a serial line
            app.post_message(Key(key, "\t" if key == "tab" else key))
        await shown(pilot, app)
        entry = app.screen.query_one("#end")
        entry.value = "decided"  # type: ignore[attr-defined]
        await pressed(pilot, app, "enter")
        assert "the bench file has no limits" in screen_text(app)
        assert told.told == []
        entry.value = "10 %"  # type: ignore[attr-defined]
        await pilot.press("enter")
        await settled(pilot, app)
    assert told.plan is not None
    assert told.plan.note == "hot"
    assert told.plan.end == EndCondition(cov=0.1)
    assert told.plan.operator is not None
    assert told.plan.operator.endswith("ann")
    assert told.told == ["start", "mark run.h5 hot"]


def test_the_line_at_the_top_of_a_small_terminal_has_the_whole_verdict() -> None:
    bench = demo_bench(LIMIT)
    result = Result(made_snapshot(), SETTINGS, bench)
    verdict = result.verdict
    assert verdict is not None
    now = replace(made_now(), caveats=Caveats([Caveat.SIMULATED]))
    for decision in Verdict:
        state = State("pier", now=now, result=judged(result, replace(verdict, verdict=decision)))
        line = status_line(state, TEST, width=80).plain
        assert len(line) <= 78
        assert WORDS[decision] in line
        assert "2 Test" in line


async def test_with_limits_a_test_usually_ends_when_they_are_decided(
    told: ProgressCallback,
) -> None:
    told.bench = demo_bench(LIMIT)
    async with opened(told) as (app, pilot):
        await pressed(pilot, app, "s")
        (line,) = [line for line in screen_text(app).splitlines() if " ends " in line]
        assert "decided" in line


def test_operator_and_end_are_remembered_in_the_bench_file(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    limits = "[[limits]]\nname = 'x'\nmodel = 'nlnm'\n"
    path.write_text(f"# mine\n{demo_bench().text}\n{limits}", encoding="utf-8")
    bench = load(path)
    controls = BenchControls(path, bench, SETTINGS)
    before = path.read_text(encoding="utf-8")
    controls.remember(TestPlan(end=bench.usual_end))
    assert path.read_text(encoding="utf-8") == before
    for end in (EndCondition(5400.0, 0.1), EndCondition(decided=True), EndCondition(7200.0)):
        controls.remember(TestPlan("ann", "", end))
        again = load(path)
        assert (again.operator, again.usual_end, again.end) == ("ann", end, end)
    assert path.read_text(encoding="utf-8").startswith("# mine\n")


def test_decided_needs_limits_in_the_bench_file_too() -> None:
    text = with_values(demo_bench().text, {"recording": {"until": "decided"}})
    with pytest.raises(BenchFileError, match=r"recording.until = .*: expected \[\[limits\]\]"):
        parse(text)
    with pytest.raises(BenchFileError, match="a time as duration"):
        parse(text.replace("decided", "3h"))


def test_a_test_ends_on_a_verdict_that_is_surer_than_a_verdict_must_be() -> None:
    result = Result(made_snapshot(n_effective=2000.0), SETTINGS, demo_bench(LIMIT))
    assert result.verdict is not None
    assert (result.verdict.verdict, result.verdict.is_sure) == (Verdict.FAIL, True)
    end = EndCondition(decided=True)
    assert end.is_estimated
    assert result.is_reached(end)


async def test_the_end_and_each_lost_sensor_are_announced_once(told: ProgressCallback) -> None:
    async with opened(told, *running()) as (app, pilot):
        now = made_now()
        lost = replace(now.sensors[1], state=SensorState.DISCONNECTED, overdue_for=5.0)
        for _ in range(2):
            await shown(pilot, app, StatusUpdated(replace(now, sensors=(now.sensors[0], lost))))
        await shown(pilot, app, *ended())
        await app.workers.wait_for_complete()
    assert told.announced == ["trouble: lost: C", "trouble: lost: B", "ended: "]


def test_the_command_for_events_gets_the_event(tmp_path: Path) -> None:
    out = tmp_path / "out"
    said = "os.environ['HUDDLE_EVENT'] + os.environ['HUDDLE_TEXT']"
    script = f"import os; open({str(out)!r}, 'w').write({said})"
    announce(f'{sys.executable} -c "{script}"', "ended", " PASS", None)
    assert out.read_text() == "ended PASS"
    with pytest.raises(HuddleError, match="--on-event"):
        announce("/no/such/command", "ended", "", None)
    with pytest.raises(HuddleError, match="exit code 3"):
        announce(f'{sys.executable} -c "raise SystemExit(3)"', "ended", "", None)
