"""What the application says of a snapshot: how far the test is, what is wrong with a sensor."""

from __future__ import annotations

from dataclasses import replace

import pytest

from daq.bench.units import decibels
from daq.results.result import Result
from tests.tui.example_snapshot import RATE, SETTINGS, diagnosed, made_now, made_snapshot
from tui.application.test_view.details import details
from tui.application.test_view.panels import (
    alerts,
    noise_in_band,
    progress_line,
    sensor_table,
)
from tui.application.test_view.plotted import Choice
from tui.output.console import console

CHOICE = Choice(methods=("three-sensor",))


def filled(since: dict[str, float]) -> int:
    """Return the full cells of the bar once sensors have sent for so many seconds since."""
    snapshot = made_snapshot(n_effective=100)
    before = {sensor.name: sensor.n_samples for sensor in snapshot.sensors}
    now = made_now(elapsed=100 + max(since.values()))
    now = replace(
        now,
        sensors=tuple(
            replace(s, n_samples=before[s.name] + round(RATE * since[s.name])) for s in now.sensors
        ),
    )
    settings = replace(SETTINGS, target_cov=0.15)
    return progress_line(now, Result(snapshot, settings), width=150).plain.count("━")


def test_the_bar_goes_on_while_all_sensors_send_and_stands_while_one_is_lost() -> None:
    fresh = filled({"A": 0, "B": 0, "C": 0})
    assert filled({"A": 100, "B": 101, "C": 102}) > fresh > 0
    assert filled({"A": 3600, "B": 0, "C": 3600}) == fresh


@pytest.mark.parametrize(
    ("reject", "said"),
    [(None, "are excluded"), (True, "are excluded"), (False, "are kept: do not")],
)
def test_what_becomes_of_clipped_segments_is_as_the_settings_say(
    reject: bool | None, said: str
) -> None:
    now = made_now()
    now = replace(now, sensors=(replace(now.sensors[0], is_clipping=True),))
    (alert,) = alerts(now, Result(made_snapshot(), replace(SETTINGS, reject=reject)))
    assert said in alert


def test_counts_are_grouped_alike() -> None:
    now = made_now()
    much = replace(now.sensors[0], n_samples=113481, n_gaps=1, n_missing=13793)
    now = replace(now, sensors=(much, *now.sensors[1:]))
    table = sensor_table(now, Result(made_snapshot(), SETTINGS), CHOICE, width=150)
    screen = console()
    with screen.capture() as said:
        screen.print(table)
        screen.print(details(now, None, trouble=""))
    assert said.get().count("113\u202f481") == 1
    assert said.get().count("13\u202f793") == 2


@pytest.mark.parametrize(("width", "error"), [(150, "±"), (40, "")], ids=["wide", "narrow"])
def test_names_of_channels_are_shown_whole_with_and_without_room_for_errors(
    width: int, error: str
) -> None:
    snapshot = diagnosed(channels=("X-1", "Y±2", "Z"))
    means = noise_in_band(Result(snapshot, SETTINGS), CHOICE)
    table = sensor_table(made_now(), Result(snapshot, SETTINGS), CHOICE, width=width)
    screen = console()
    with screen.capture() as said:
        screen.print(table, width=150)
    for number, name in enumerate(("X-1", "Y±2", "Z")):
        level = f"{decibels(float(means[number].mean[0])):.1f}".replace("-", "−")
        assert f"{name} {level}{error}" in said.get()
    assert said.get().count("±") == 3 + 9 * len(error)
