"""What the application says of a snapshot: its clocks, how far the test is, what is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daq.bench.units import decibels
from daq.devices.bench_file import parse
from daq.estimation.snapshot_diagnostics import (
    SnapshotDiagnostics,
    Synchronisation,
)
from daq.results.clock_effect import effect, effect_by_sensor
from daq.results.result import Result
from tests.tui.demo_bench import DEMO
from tests.tui.example_snapshot import (
    RATE,
    SETTINGS,
    diagnosed,
    empty_snapshot,
    made_now,
    made_snapshot,
)
from tui.application.test_view.clocks import clock_line, drift_lines, drift_title
from tui.application.test_view.details import details
from tui.application.test_view.panels import (
    alerts,
    noise_in_band,
    progress_line,
    sensor_table,
)
from tui.application.test_view.plot import TimeAxis
from tui.application.test_view.plotted import Choice
from tui.commands.demo import compare
from tui.output.console import console
from tui.page.blocks import Paragraph
from tui.page.table import Table
from tui.report.evidence import clocks_section
from tui.simulation.devices import scenario_of


def test_effect_is_the_share_of_the_band_s_noise() -> None:
    snapshot = made_snapshot()
    share = np.zeros_like(snapshot.data_psd)
    share[2:41, 3] = 0.2  # the band is 1 to 20 Hz, in steps of 0.5 Hz
    share[41:, 4] = 0.9  # above it
    snapshot = replace(snapshot, diagnostics=SnapshotDiagnostics(Synchronisation(noise_bias=share)))
    shares = effect(Result(snapshot, SETTINGS))
    np.testing.assert_allclose(shares, [0, 0, 0, 0.2, 0, 0, 0, 0, 0], atol=1e-12)


def test_effect_is_not_known_where_no_frequency_tells() -> None:
    snapshot = made_snapshot(clock_share=np.nan)
    assert np.isnan(effect(Result(snapshot, SETTINGS))).all()
    assert set(map(np.isnan, effect_by_sensor(Result(snapshot, SETTINGS)).values())) == {True}


@pytest.mark.parametrize(
    ("share", "said", "tone"),
    [
        (0.0004, "no effect on noise (<0.1 %)", "good"),
        (0.004, "negligible, 0.4 % of the noise", "good"),
        (0.03, "small, 3.0 % of the noise", "doubtful"),
        (0.22, "they matter here, 22 % of the noise", "bad"),
    ],
)
def test_words_and_tone_say_whether_clocks_matter(share: float, said: str, tone: str) -> None:
    start, words = clock_line(Result(made_snapshot(clock_share=share), SETTINGS), width=100)
    assert start.endswith(": ")
    assert (words, words.tone) == (said, tone)


def test_line_says_most_where_there_is_room() -> None:
    snapshot = made_snapshot()
    wide, narrow = (clock_line(Result(snapshot, SETTINGS), width=w)[0] for w in (120, 60))
    assert "A +5.9, B −9.1, C +4.0 ppm, within 0.6 µs, by motion" in wide
    assert "A" not in narrow
    assert "within 0.6 µs" in narrow
    assert len("".join(clock_line(Result(snapshot, SETTINGS), width=78))) <= 78


def test_clocks_that_are_one_or_unknown() -> None:
    snapshot = made_snapshot()
    shared = tuple(clock.shared_by("lab") for clock in snapshot.clocks)
    _, one = clock_line(Result(replace(snapshot, clocks=shared), SETTINGS), width=78)
    assert one == "clocks: all sensors share one"
    _, unknown = clock_line(Result(replace(snapshot, clocks=()), SETTINGS), width=78)
    assert unknown == "clocks: not known yet"
    _, early = clock_line(
        Result(replace(empty_snapshot(), diagnostics=SnapshotDiagnostics()), SETTINGS), width=100
    )
    assert early == "effect not known yet"


def test_drift_is_what_a_constant_rate_leaves() -> None:
    lines = drift_lines(made_snapshot(), chosen="B", n_points=200)
    assert [line.label for line in lines] == ["A", "C", "B"]  # the chosen one on top
    *straight, bent = lines
    for line in straight:
        assert np.abs(line.y).max() < 1e-6
    assert bent.x[-1] == pytest.approx(59 / 60)
    assert np.ptp(bent.y) == pytest.approx(20, rel=0.01)  # µs
    assert len(drift_lines(made_snapshot(), chosen="B", n_points=20)[0].x) <= 30


def test_drift_is_against_the_reference_where_motion_measures_it() -> None:
    snapshot = made_snapshot()
    late = snapshot.drift.copy()
    late[:, 1:] += 100e-6 * np.sin(late[:, [0]])  # the host was, and took them all for late
    swinging = replace(snapshot, drift=late)
    for told, before in zip(
        drift_lines(swinging, chosen="B", n_points=200),
        drift_lines(snapshot, chosen="B", n_points=200),
        strict=True,
    ):
        np.testing.assert_allclose(told.y, before.y, atol=1e-6)
    assert "behind A," in drift_title(swinging)
    alone = tuple(replace(clock, refined=False) for clock in snapshot.clocks)
    by_arrivals = replace(swinging, clocks=alone)
    assert "behind the computer," in drift_title(by_arrivals)
    assert len(drift_title(by_arrivals)) <= 58  # of sixty columns
    assert min(np.ptp(line.y) for line in drift_lines(by_arrivals, chosen="", n_points=60)) > 150


@pytest.mark.parametrize("share", [0.004, 0.03, 0.07, 0.22])
def test_report_and_application_judge_clocks_alike(share: float) -> None:
    snapshot = made_snapshot(clock_share=share)
    late = replace(snapshot.clocks[0], residual=7e-6)  # against the host
    snapshot = replace(snapshot, clocks=(late, *snapshot.clocks[1:]))
    section = clocks_section(Result(snapshot, SETTINGS))
    verdict = next(part for part in section.parts if isinstance(part, Paragraph))
    assert clock_line(Result(snapshot, SETTINGS), width=100)[1].tone == verdict.tone
    (table,) = (part for part in section.parts if isinstance(part, Table))
    left = table.header.index("error (µs rms)")
    assert [row[left] for row in table.rows] == ["–", "0.40", "0.60"]
    said = next(p.text for p in section.parts if isinstance(p, Paragraph) and "Drift" in p.text)
    assert "that of A," in said


@pytest.mark.parametrize(("share", "added"), [(0.0, 0.0), (0.1, 0.4), (3.0, 1.0)])
def test_demo_allows_for_what_clocks_add(share: float, added: float) -> None:
    scenario = scenario_of(parse(DEMO))
    exact, ours = (
        compare(Result(made_snapshot(clock_share=each), SETTINGS), scenario)
        for each in (0.0, share)
    )
    noise = {(e.sensor, e.channel): e.noise_psd for e in exact if e.method == "three-sensor"}
    for before, after in zip(exact, ours, strict=True):
        wanted = added * noise[after.sensor, after.channel]  # by either method
        assert after.added_by_clocks == pytest.approx(wanted, rel=1e-6, abs=1e-20)
        assert after.noise_psd_high == before.noise_psd_high
        if after.method == "three-sensor":  # many of the other's are above the bound
            assert before.noise_psd_low - after.noise_psd_low == pytest.approx(
                wanted, rel=1e-6, abs=1e-20
            )


@pytest.mark.parametrize("minutes", [0.4, 1.7, 2.4, 14.0, 31.0, 240.0, 900.0, 6e3, 9e4])
def test_labels_of_time_have_room_in_sixty_columns(minutes: float) -> None:
    axis = TimeAxis()
    ticks, labels = axis.get_ticks_and_labels(0.08, minutes)
    assert 2 <= len(ticks) <= 6
    assert sum(len(label) + 1 for label in labels) <= 49


# --- panels ----------------------------------------------------------------------------------


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
