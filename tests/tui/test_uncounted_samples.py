"""Samples that a sensor lost without counting them: events wherever a result is shown."""

from __future__ import annotations

from pathlib import Path

import huddle
from daq.recording.monitor import RecordingMonitor
from daq.recording.reader import Recording
from daq.results.result import Result
from daq.results.sources import sources
from tests.known_clocks import Scene, record, seconds_of
from tui.application.test_view.details import details
from tui.output.console import console
from tui.page.table import Table
from tui.report.contents import report_of


def test_samples_that_are_not_counted_are_events_of_the_result(tmp_path: Path) -> None:
    scene = Scene(rates=(50.0,) * 3, seconds=200.0, slips={1: [(70.0, 1), (130.0, 2)]})
    path = tmp_path / "r.h5"
    record(path, scene)
    result = huddle.estimate(path)
    assert [(each.sensor, each.kind) for each in result.events] == [("B", "uncounted")] * 2
    for event, (when, n) in zip(result.events, scene.slips[1], strict=True):
        assert abs(seconds_of(event.utc_ns) - when) < 15.0
        assert event.text.startswith(f"lost {n} sample")
        assert "check the buffers" in event.text
    made = result.to_dict()["diagnostics"]
    assert [each["text"] for each in made["events"]] == [each.text for each in result.events]
    report = report_of(
        Result(
            result.snapshot,
            result.settings,
            sources([path])[0].bench,
            recordings=(path,),
        )
    )
    (happened,) = (each for each in report.sections if each.title.startswith("The recording"))
    rows = [row for part in happened.parts if isinstance(part, Table) for row in part.rows]
    assert [(row[1], row[3]) for row in rows] == [("B", each.text) for each in result.events]
    now = RecordingMonitor(Recording.open(path)).status()
    screen = console()
    with screen.capture() as shown:
        screen.print(details(now, result.result, trouble=""), width=200)
    assert shown.get().count("uncounted") == 2
