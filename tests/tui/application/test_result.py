"""The Result view: verdict, margins, comparison with an earlier recording, another estimate."""

from __future__ import annotations

import threading
from dataclasses import replace
from importlib import resources
from json import loads
from pathlib import Path

import pytest
from textual.pilot import Pilot
from textual.widgets import Input

from daq.results.result import Result
from tests.tui.application.screen_text import assert_looks_as_before, screen_text
from tests.tui.application.test_app import (
    NARROW,
    WIDE,
    ended,
    opened,
    pressed,
    running,
    settled,
    shown,
)
from tests.tui.example_snapshot import (
    LIMIT,
    SETTINGS,
    ProgressCallback,
    demo_bench,
    made_snapshot,
)
from tui.application.app import HuddleApp
from tui.application.forms.estimate import as_changes
from tui.application.messages import ReferenceReady, SensorsNoted, SnapshotReady, StatusUpdated
from tui.application.reference import reference_of
from tui.application.state import RECORDINGS, RESULT, Reference
from tui.commands.tui_controls import save_result
from tui.output.results import curves_csv
from tui.simulation.write_recording import simulate_recording


@pytest.fixture
def told(tmp_path: Path) -> ProgressCallback:
    return ProgressCallback(tmp_path / "run.h5", bench=demo_bench(LIMIT))


def earlier(folder: Path, **changes: object) -> Reference:
    """Return a reference of which one channel was quieter."""
    snapshot = made_snapshot(n_effective=1500.0, closed=True)
    noise = snapshot.results["three-sensor"]
    scale = [0.5] + 8 * [1.0]
    quieter = replace(
        noise, noise_psd=noise.noise_psd * scale, low=noise.low * scale, high=noise.high * scale
    )
    snapshot = replace(snapshot, results={"three-sensor": quieter}, **changes)  # type: ignore[arg-type]
    return Reference(folder / "lab-8.h5", Result(snapshot, SETTINGS))


async def at_result(pilot: Pilot[None], app: HuddleApp) -> None:
    """Let a test end."""
    await shown(pilot, app, *running())
    await shown(pilot, app, *ended())
    assert app.current_mode == RESULT


@pytest.mark.parametrize(("name", "size"), [("narrow", NARROW), ("wide", WIDE)])
async def test_pictures(told: ProgressCallback, name: str, size: tuple[int, int]) -> None:
    async with opened(told, size=size) as (app, pilot):
        await at_result(pilot, app)
        await assert_looks_as_before(pilot, f"{name}-result-limits")
        await shown(pilot, app, ReferenceReady(earlier(told.folder)))
        await assert_looks_as_before(pilot, f"{name}-result-compared")
        await pressed(pilot, app, "2")
        await assert_looks_as_before(pilot, f"{name}-test-compared")


async def test_a_narrow_screen_leaves_out_columns_and_cuts_no_names(told: ProgressCallback) -> None:
    """A survey's channels were three times "XX.TST5.00.B…", and margins lacked their ends."""
    async with opened(told, size=NARROW) as (app, pilot):
        await shown(pilot, app, *running())
        snapshot = made_snapshot(n_effective=2000, closed=True)
        channels = tuple(
            replace(each, sensor=f"XX.TST5.0{each.sensor}", channel=f"BH{each.channel}")
            for each in snapshot.channels
        )
        found = Result(replace(snapshot, channels=channels), SETTINGS, demo_bench(LIMIT))
        await shown(pilot, app, ended()[0], SnapshotReady(found))
        text = screen_text(app)
    assert {f"XX.TST5.0{sensor}.BH{channel}" for sensor in "AB" for channel in "XYZ"} <= {
        *text.split()
    }
    assert "margin, dB" in text
    assert "worst c.o.v." not in text


async def test_what_cannot_be_compared_says_why_and_c_ends_it(told: ProgressCallback) -> None:
    async with opened(told, size=WIDE) as (app, pilot):
        await at_result(pilot, app)
        await shown(pilot, app, ReferenceReady(earlier(told.folder, unit="m/s")))
        assert "cannot be compared: units differ: m/s² and m/s" in screen_text(app)
        await pressed(pilot, app, "c")
        assert "compared" not in screen_text(app)
        await pilot.press("c")
        assert app.current_mode == RECORDINGS  # to choose one


async def test_another_estimate_starts_from_the_settings_shown(told: ProgressCallback) -> None:
    async with opened(told, path=told.path) as (app, pilot):
        await at_result(pilot, app)
        await pressed(pilot, app, "e")
        assert "three-sensor,three-channel" in screen_text(app)
        await pilot.press("tab", *"4s", "enter")
        await settled(pilot, app)
    wanted = as_changes(SETTINGS) | {"segment": 4.0}
    assert told.told == [f"about run.h5 {wanted}"]


def test_the_reference_is_estimated_with_the_settings_of_what_is_shown(tmp_path: Path) -> None:
    path = tmp_path / "old.h5"
    bench = Path(str(resources.files("tui.resources").joinpath("demo.toml")))
    simulate_recording(str(bench), out=path, duration=20.0, json=None)
    settings = replace(SETTINGS, segment=1.0)
    found = reference_of(path, settings, lambda *_: (None, None), ended=threading.Event())
    assert found is not None
    assert found.result.snapshot.results.keys() == set(SETTINGS.methods)
    assert found.result.snapshot.frequency[1] == 1.0
    ended = threading.Event()
    ended.set()
    assert reference_of(path, settings, lambda *_: (None, None), ended=ended) is None


async def test_the_estimate_and_the_screen_are_saved(told: ProgressCallback) -> None:
    async with opened(told, path=told.path, notifications=True) as (app, pilot):
        await at_result(pilot, app)
        await pilot.press("v")
        await app.workers.wait_for_complete()
    assert told.told == ["save run.h5 9"]
    assert "FAIL" in told.path.with_suffix(".svg").read_text(encoding="utf-8")


def test_csv_and_json_are_those_of_the_commands(tmp_path: Path) -> None:
    snapshot = made_snapshot()  # growing: nothing is said of its file
    csv, json = save_result(tmp_path / "run.h5", Result(snapshot, SETTINGS), folder=tmp_path)
    assert csv.read_text(encoding="utf-8") == curves_csv(snapshot)
    found = loads(json.read_text(encoding="utf-8"))
    assert len(found["results"]) == len(snapshot.results)
    beside = csv.with_name("run.csv-metadata.json")
    (said,) = loads(beside.read_text(encoding="utf-8"))["notes"]
    assert (said["simulated"], said["recordings"]) == ("false", "[]")


async def test_how_sensors_have_changed_stands_with_the_result_by_itself(
    told: ProgressCallback,
) -> None:
    line = "A S4254475: +0.7 ± 0.2 dB since 25 October, 3 tests (1–20 Hz)"
    async with opened(told, *ended()) as (app, pilot):
        app.state = replace(app.state, path=told.path)
        await shown(pilot, app, SensorsNoted(told.path.with_name("other.h5"), ("of another",)))
        await shown(pilot, app, SensorsNoted(told.path, (line,)))
        await pilot.press("3")
        text = screen_text(app)
    assert line in text
    assert "of another" not in text


async def test_a_comparison_says_where_a_name_is_another_sensor_now(
    told: ProgressCallback, tmp_path: Path
) -> None:
    async with opened(told, size=WIDE) as (app, pilot):
        status, snapshot = ended()
        assert isinstance(status, StatusUpdated)
        sensors = tuple(replace(s, serial_number=f"S{s.name}") for s in status.now.sensors)
        before = replace(earlier(tmp_path), serial_numbers={"A": "SA", "B": "S7", "C": ""})
        now = replace(status.now, sensors=sensors)
        await shown(pilot, app, StatusUpdated(now), snapshot, ReferenceReady(before))
        await pilot.press("3")
        text = screen_text(app)
    assert text.count("was another sensor in") == 1
    assert "B was another sensor in" in text
    assert "S7, now SB" in text


async def test_i_asks_who_authorises_and_issues_or_makes_a_specimen(
    told: ProgressCallback,
) -> None:
    async with opened(told, path=told.path) as (app, pilot):
        await at_result(pilot, app)
        assert "i Issue" in screen_text(app)
        await pressed(pilot, app, "i")
        assert "certificate of run.h5" in screen_text(app)
        assert "Empty: a specimen, watermarked" in screen_text(app)
        await pilot.press("enter")
        await app.workers.wait_for_complete()
        for keys in (
            ("i", *"Ada", "tab", *"finer", "tab", *"no", "enter"),
            ("i", "escape"),
            ("i", *"Nobody", "enter"),
        ):
            await pressed(pilot, app, *keys[:1])
            kept = app.screen.query_one("#by", Input).value
            assert kept == ("Ada" if "escape" in keys or "N" in keys else "")
            await pilot.press(*keys[1:])
            await settled(pilot, app)
        assert "sensors were simulated" in screen_text(app)
        assert "Make a specimen instead?" in screen_text(app)
        await pilot.press("y")
        await app.workers.wait_for_complete()
    assert [each for each in told.told if each.startswith("certify")] == [
        "certify run.h5 {'by': '', 'reason': '', 'despite': ''}",
        "certify run.h5 {'by': 'Ada', 'reason': 'finer', 'despite': 'no'}",
        "certify run.h5 {'by': '', 'reason': '', 'despite': ''}",
    ]
