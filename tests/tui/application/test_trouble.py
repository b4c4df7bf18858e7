"""What the application shows when something is wrong, and what stray keys cannot do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from daq.errors import HuddleError
from daq.recording.sensor_state import SensorState
from estimator.wording import clock_time
from tests.daq.results.decision.benches import bench_with
from tests.tui.application.screen_text import resized, screen_text
from tests.tui.application.test_app import (
    NARROW,
    WIDE,
    ended,
    opened,
    pressed,
    running,
    settled,
    shown,
    view,
)
from tests.tui.example_snapshot import (
    STRANGER,
    ProgressCallback,
    advised,
    diagnosed,
    made_now,
    made_snapshot,
    waiting_now,
)
from tui.application.app import HuddleApp
from tui.application.messages import ErrorReported, Progress, StatusUpdated
from tui.application.plan import TestPlan


@dataclass
class Refusing(ProgressCallback):
    """Controls whose recorder does not start."""

    def start(self, plan: TestPlan) -> Path:
        """Refuse."""
        del plan
        raise HuddleError(
            "sensor A at /dev/ttyUSB0: no answer\nsensor C at /dev/ttyUSB2: no such port"
        )


async def test_starting_over_a_result_is_asked_first(
    told: ProgressCallback, tmp_path: Path
) -> None:
    path = tmp_path / "old.h5"  # which is not there: nothing else comes
    async with opened(told, path=path) as (app, pilot):
        await app.workers.wait_for_complete()
        await shown(pilot, app, *running())
        await shown(pilot, app, *ended())
        await pressed(pilot, app, "s")
        assert "start a test; old.h5 is kept" in screen_text(app)
        await pilot.press("s", "y", "tab", "x", "escape")  # none of them starts
        assert told.told == []
        await pilot.press("s", "enter")
        await app.workers.wait_for_complete()
    assert told.told == ["start"]


async def test_why_no_recording_started_stays_on_the_screen(tmp_path: Path) -> None:
    async with opened(Refusing(tmp_path / "run.h5")) as (app, pilot):
        await app.workers.wait_for_complete()
        await pilot.press("s", "enter")
        await settled(pilot, app)
        await pilot.press("escape", "2", "d", "escape", "1")
        text = screen_text(app)
        assert "sensor A at /dev/ttyUSB0: no answer" in text
        assert "sensor C at /dev/ttyUSB2: no such port" in text
        assert "connecting" not in text


async def test_a_red_row_of_the_check_list_keeps_a_test_from_starting_unless_confirmed(
    told: ProgressCallback,
) -> None:
    told.wrong = ("B.X reads 0.102 of A and C (g in place of m/s²)", "C.Z is reversed")
    async with opened(told) as (app, pilot):
        for answer in ("escape", "y"):
            await pilot.press("s", "enter")
            await settled(pilot, app)
            text = screen_text(app)
            assert all(f"✗ {line}" in text for line in told.wrong)
            assert told.told == []
            await pilot.press(answer)
            await settled(pilot, app)
            if answer == "escape":
                await pilot.press("1")
                assert "▲ C.Z is reversed" in screen_text(app)  # and what is wrong stays there
    assert told.told == ["start"]


async def test_a_recorder_that_is_gone_leaves_no_sensor_live(told: ProgressCallback) -> None:
    async with opened(told, *running()) as (app, pilot):
        assert "● live" in screen_text(app)
        assert "Waits for C." in screen_text(app)
        await shown(pilot, app, ErrorReported("run.h5: the recorder ended", ended=True))
        text = screen_text(app)
    assert "Waits" not in text
    assert "● live" not in text
    assert text.count("■ not recorded") == 3


async def test_states_and_progress_are_there_before_the_first_estimate(
    told: ProgressCallback,
) -> None:
    """Of a recording of hours the first estimate takes a while."""
    async with opened(told) as (app, pilot):
        await shown(pilot, app, StatusUpdated(made_now(elapsed=7200.0)), Progress(300, 1000))
        text = screen_text(app)
        assert "● live" in text
        assert "○ silent 0:12" in text
        assert "reading what was recorded: 30%" in text
        assert clock_time(7200.0) in text
        ended = replace(made_now(elapsed=7200.0), closed=True)
        await shown(pilot, app, StatusUpdated(ended), Progress(1000, 1000))
        assert "all segments are read; assumptions are tested" in screen_text(app)
        await shown(pilot, app, StatusUpdated(waiting_now()))
        assert screen_text(app).count("○ waiting") == 3


async def test_the_target_is_judged_by_the_chosen_method_whatever_curve_is_shown(
    told: ProgressCallback,
) -> None:
    snapshot = made_snapshot()
    three_channel = snapshot.results["three-channel"]
    sure = replace(three_channel, cov=three_channel.cov * 1e-3)
    snapshot = replace(snapshot, results={**snapshot.results, "three-channel": sure})
    async with opened(told, *running(snapshot), size=WIDE) as (app, pilot):
        for _ in range(3):
            text = await pressed(pilot, app, "e")
            assert "c.o.v. 46 %" in text
            assert "target reached" not in text
        assert view(app).choice.methods != ("three-sensor",)


async def test_what_the_diagnosis_finds_is_shown_while_recording(told: ProgressCallback) -> None:
    snapshot = replace(advised(diagnosed(), STRANGER), closed=False)
    live = tuple(replace(s, overdue_for=0.0, state=made_now().sensors[0].state)
                 for s in made_now().sensors)  # fmt: skip
    now = replace(made_now(), sensors=live)
    async with opened(told, *running(snapshot, now), size=WIDE) as (app, pilot):
        text = screen_text(app)
        assert "✗ A records none of the motion that B and C share: check its input" in text
        assert text.count("no shared motion") == 3
        await resized(pilot, NARROW)
        await shown(pilot, app)
        assert "✗ A records none of the motion that B and C share" in screen_text(app)


async def test_the_verdict_so_far_is_shown_with_how_long_to_record(
    told: ProgressCallback,
) -> None:
    told.bench = bench_with(8e-12)
    async with opened(told, *running(n_effective=60.0), size=WIDE) as (app, pilot):
        assert screen_text(app).count("NOT DECIDED") == 2  # beside the time, and with what to do
        await resized(pilot, NARROW)
        await shown(pilot, app)
        assert "recording  1:40  NOT DECIDED" in screen_text(app)
        await resized(pilot, WIDE)
        now = made_now(closed=True)
        await shown(pilot, app, *running(now=now, n_effective=5000.0, closed=True))
        text = screen_text(app)
    assert "✗ FAIL: 1 of 9 channels above data sheet: C.Z." in text
    assert "C.Z fails 'data sheet'" in text
    assert "✓ +9." in next(line for line in text.splitlines() if line.startswith("  A.X"))


async def test_a_sensor_moved_during_a_test_is_named_by_the_last_minute(
    told: ProgressCallback,
) -> None:
    """After 1000 s together, 100 s without C in the motion are lost in the averages."""
    before = replace(advised(diagnosed(n_effective=1000.0)), closed=False, elapsed=1000.0)
    alone = before.csm.copy()
    alone[:, 6:, :6] = alone[:, :6, 6:] = 0
    n_new = before.n_segments // 10
    n_segments = before.n_segments + n_new
    csm = (before.n_segments * before.csm + n_new * alone) / n_segments
    now = replace(before, csm=csm, n_segments=n_segments, n_effective=1100.0, elapsed=1100.0)
    same = replace(now, csm=before.csm)
    told.bench = bench_with(1e-12)
    app = HuddleApp(told)
    for second, is_named in ((same, False), (now, True)):
        async with app.run_test(size=WIDE) as pilot:
            for each in (before, second):
                await shown(pilot, app, *running(each, made_now(elapsed=1100.0)))
            words = "C records none of the motion that A and B share"
            text = screen_text(app)
            assert (words in text) == is_named
            assert ("FAIL" in text, "NOT DECIDED" in text) == (not is_named, is_named)
            await app.workers.wait_for_complete()
        app = HuddleApp(told)
    assert [each for each in told.announced if words in each] == [
        f"trouble: {words}: check its input, rate or place"
    ]


async def test_an_alert_that_grows_by_a_line_is_shown_whole(tmp_path: Path) -> None:
    """Its second line was cut: the height followed the number of alerts, not of lines."""
    silent = made_now()
    *others, lost = silent.sensors
    lost = replace(lost, state=SensorState.DISCONNECTED)
    async with opened(ProgressCallback(tmp_path / "run.h5"), size=NARROW) as (app, pilot):
        await shown(pilot, app, *running(now=silent))
        await shown(pilot, app, StatusUpdated(replace(silent, sensors=(*others, lost))))
        await pilot.pause()
        assert "reconnects automatically" in " ".join(screen_text(app).split())
