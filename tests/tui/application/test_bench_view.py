"""The Bench view: sensors live before a test, what is wrong, and ready."""

from __future__ import annotations

import io
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from textual.pilot import Pilot
from textual.widgets import Input

from daq.devices.bench_file import load
from daq.devices.interface import DeviceInformation
from daq.preflight.preview import SensorPreview
from tests.tui.application.screen_text import assert_looks_as_before, screen_text
from tests.tui.application.test_app import NARROW, WIDE, opened, pressed, settled, shown
from tests.tui.application.test_first_bench import until
from tests.tui.example_snapshot import SETTINGS, ProgressCallback, demo_bench
from tests.waiting import limit
from tui.application.app import HuddleApp
from tui.application.bench_view.sensors import (
    SPECTRUM_POINTS,
    SPECTRUM_SEGMENT,
    channel_traces,
    sensor_states,
    sensors_of_bench,
    spectra,
    trace,
)
from tui.application.bench_view.view import SITES
from tui.application.state import State
from tui.commands.tui_controls import BenchControls

MOTION = np.random.default_rng(1).normal(size=(2000, 3)).cumsum(axis=0) * 1e-4
SOUND = tuple(
    SensorPreview(
        sensor,
        DeviceInformation(sensor.name, "A352AD10", f"S{n}", "1.4", 200.0, 25.0),
        MOTION + 1e-6 * np.random.default_rng(n).normal(size=(2000, 3)),
        last_ns=10**10,
        measured_rate=200.0 + n / 10,
    )
    for n, sensor in enumerate(demo_bench().sensors)
)


@dataclass
class Reading:
    """Shows sensors once, and waits until nobody wants more."""

    sensors: tuple[SensorPreview, ...]
    begun: threading.Event = field(default_factory=threading.Event)
    is_over: threading.Event = field(default_factory=threading.Event)

    def __call__(
        self, show: Callable[[tuple[SensorPreview, ...]], None], ended: threading.Event
    ) -> None:
        """Show them."""
        show(self.sensors)
        self.begun.set()
        ended.wait(limit())
        self.is_over.set()


@pytest.fixture
def told(tmp_path: Path) -> ProgressCallback:
    return ProgressCallback(tmp_path / "run.h5", bench=demo_bench(), sensors=Reading(SOUND))


@asynccontextmanager
async def live(
    told: ProgressCallback, *sensors: SensorPreview, size: tuple[int, int] = NARROW
) -> AsyncIterator[tuple[HuddleApp, Pilot[None], Reading]]:
    """Run an application that reads these sensors, and has shown them."""
    told.sensors = reading = Reading(sensors or SOUND)
    async with opened(told, size=size) as (app, pilot):
        await pilot.press("p")
        reading.begun.wait(limit())
        await shown(pilot, app)
        yield app, pilot, reading


@pytest.mark.parametrize(("name", "size"), [("narrow", NARROW), ("wide", WIDE)])
async def test_pictures(told: ProgressCallback, name: str, size: tuple[int, int]) -> None:
    async with live(told, size=size) as (app, pilot, reading):
        await assert_looks_as_before(pilot, f"{name}-bench")
        await pilot.press("p")
        reading.is_over.wait(limit())
        await shown(pilot, app)
        assert "last 10 s" not in screen_text(app)


async def test_limits_are_changed_in_a_form_also_those_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(f"# mine\n{demo_bench().text}", encoding="utf-8")
    (tmp_path / "sheet.csv").write_text("frequency (Hz), noise (µg/√Hz)\n1, 3\n30, 2\n")
    bench = load(path)
    async with opened(BenchControls(path, bench, SETTINGS)) as (app, pilot):
        said = await pressed(pilot, app, "l", "tab", "space", "u")
        assert "directions for the 3 channels of A" in said
        await pressed(pilot, app, "backspace", "backspace", "tab", *"sheet.csv")
        assert "decided, " in screen_text(app)
        await pilot.press("enter")
        await settled(pilot, app)
        assert app.state.bench is not None
        assert [limit.name for limit in app.state.bench.limits] == ["sheet"]
        await pilot.press("l", "tab", "tab", "end", *";nlnm", "enter")
        await app.workers.wait_for_complete()
    changed = load(path)
    assert [limit.name for limit in changed.limits] == ["sheet", "nlnm"]
    assert changed.limits[0].psd == (9.0, 4.0)
    assert path.read_text(encoding="utf-8").startswith("# mine\n")


def test_channels_of_several_units_have_each_its_own() -> None:
    first, second, _ = SOUND
    channels = tuple(replace(each, unit="V") for each in second.sensor.channels)
    other = replace(second, sensor=second.sensor.model_copy(update={"channels": channels}))
    header, *rows = channel_traces((first, other), width=100).plain.splitlines()
    assert header.split() == ["channel", "mean", "RMS", "peak", "last", "10", "s"]
    units = [row.split()[2:7:2] for row in rows]
    assert units[0] == units[1] == units[2]
    assert units[3] == units[4] == units[5]
    assert all(unit.endswith("m/s²") for unit in units[0])
    assert all(unit.endswith("V") for unit in units[3])


async def test_faults_are_named_with_what_to_do_and_keep_it_from_ready(
    told: ProgressCallback,
) -> None:
    a, b, c = SOUND
    dead = a.samples.copy()
    dead[:, 1] = 1.0
    gone = replace(c, samples=c.samples[:0], trouble="sensor 'C' on /dev/ttyUSB2: no answer")
    faulty = replace(a, samples=dead), replace(b, is_clipping=True), gone
    async with live(told, *faulty) as (app, _, _):
        text = screen_text(app)
    for said in (
        "A.Y does not change: nothing is connected, or it is dead",
        "B is clipping: reduce the motion",
        "sensor 'C' on /dev/ttyUSB2: no answer",
        "not ready: put A, B and C right first",
        "▲ trouble",
    ):
        assert said in text


@pytest.mark.parametrize("key", ["2", "s"])
async def test_the_ports_are_released_before_a_test_and_with_the_view(
    told: ProgressCallback, key: str
) -> None:
    async with live(told) as (app, pilot, reading):
        await pressed(pilot, app, key, *(["enter"] if key == "s" else []))
        assert reading.is_over.wait(limit())


async def test_reading_that_fails_is_not_shown_as_going_on(told: ProgressCallback) -> None:
    """The line below said "reading the sensors", and "nothing wrong is seen" above it."""

    def fails(show: Callable[[tuple[SensorPreview, ...]], None], ended: threading.Event) -> None:
        show(SOUND)
        del ended
        raise OSError("no such bench")

    told.sensors = fails
    async with opened(told) as (app, pilot):
        await pressed(pilot, app, "1", "p")
        await app.workers.wait_for_complete()
        await shown(pilot, app)
        assert "reading the sensors" not in screen_text(app)


async def test_reading_goes_on_under_help_and_after_a_dialog(told: ProgressCallback) -> None:
    async with live(told) as (app, pilot, reading):
        for opens in ("question_mark", "ctrl+p"):
            await pressed(pilot, app, opens)
            assert not reading.is_over.is_set()
            await pilot.press("escape")
        told.sensors = again = Reading(SOUND)
        await pressed(pilot, app, "s")
        assert reading.is_over.wait(limit())
        assert "● live" not in screen_text(app)
        await pilot.press("escape")
        await until(pilot, again.begun.is_set)
        await shown(pilot, app)
        assert screen_text(app).count("● live") == 3
        await pilot.press("p")
        assert again.is_over.wait(limit())


def test_a_silent_or_frozen_sensor_is_not_called_live() -> None:
    silent = replace(SOUND[0], age=75.2)
    assert "○ silent 1m15s" in sensor_states([silent], width=100).plain
    assert "○ frozen" in sensor_states(SOUND, width=100, is_frozen=True).plain


async def test_frozen_traces_stay(told: ProgressCallback) -> None:
    async with live(told) as (app, pilot, _):
        assert "frozen: f goes on" in await pressed(pilot, app, "f")


async def test_a_sensor_is_found_named_checked_as_typed_changed_and_removed(
    told: ProgressCallback,
) -> None:
    async with opened(told) as (app, pilot):

        async def press(*keys: str) -> str:
            await pilot.press(*keys)
            await settled(pilot, app)
            return " ".join(screen_text(app).split())

        assert "No such" not in await press("a")
        assert "found nothing" in await press(*"/dev/nothing", "enter")
        assert "new sensor, driver epson" in await press(*["backspace"] * 7, *"tty9", "enter")
        assert app.screen.query_one("#serial_number", Input).value == "S9"
        app.screen.query_one("#setting-temperature_stabilisation", Input).focus()
        assert "temperature_stabilisation " in await press("home")  # whole, the longest of all
        app.screen.query_one("#name", Input).focus()
        assert "port" in await press("D")  # what a field means is with the cursor
        sensitivity = app.screen.query_one("#sensitivity", Input)
        for name, value in (("channels", "X Y Z"), ("sensitivity", "1 2")):
            app.screen.query_one(f"#{name}", Input).value = value
        sensitivity.focus()
        assert "2 for 3 channels; expected 1 or 3" in await press("end")
        sensitivity.value = "0"
        assert "expected counts" in await press("end")
        sensitivity.value = "1710799.9 1 -1"
        baud = app.screen.query_one("#setting-baud_rate", Input)
        baud.focus()
        assert "baud" in await press("end")
        baud.value = "12"
        assert "baud_rate = 12" in await press("enter")  # refused, and said why
        baud.value = "460800"
        await press("enter")
        assert told.bench is not None
        added = told.bench.sensors[-1]
        assert (added.name, added.port, added.serial_number) == ("D", "/dev/tty9", "S9")
        assert [channel.sensitivity for channel in added.channels] == [1710799.9, 1, -1]
        await press("up", "e")
        app.screen.query_one("#model", Input).value = "M-A370"
        await press("enter")
        assert told.bench.sensors[-1] == added.model_copy(update={"model": "M-A370"})
        await press("delete", "n")
        assert len(told.bench.sensors) == 4
        await press("delete", "y")
    assert [sensor.name for sensor in told.bench.sensors] == ["A", "B", "C"]
    assert told.told == ["save bench"] * 3


async def test_what_certificates_say_is_asked_for_checked_and_kept_in_the_bench_file(
    told: ProgressCallback,
) -> None:
    given = {
        "operator": "Ada",
        "laboratory-name": "Pier Metrology",
        "laboratory-address": "1 Quiet Lane",
        "laboratory-country": "Germany",
        "customer-name": "Slow Waves & Sons",
        "customer-email": "buyer@waves.example",
        "certificate-procedure": "QP-17, issue 3",
        "certificate-received": "20.11.2026",
        "certificate-condition": 'no damage, "as new"',
        "certificate-decision_rule": "simple-acceptance",
        "certificate-guard_band": "0.5",
    }
    async with opened(told) as (app, pilot):

        async def typed(**values: str) -> str:
            for name, value in values.items():
                app.screen.query_one(f"#{name}", Input).value = value
            app.screen.query_one(f"#{next(iter(values))}", Input).focus()
            await pilot.press("end", "enter")
            await settled(pilot, app)
            return " ".join(screen_text(app).split())

        await pilot.press("c")
        assert "ISO 3166" in await typed(**given)
        assert "date" in await typed(**{"laboratory-country": "DE"})
        assert told.told == []
        await typed(**{"certificate-received": "2026-11-20"})
        assert told.told == ["save bench"]
        await pilot.press("c")
        assert app.screen.query_one("#laboratory-name", Input).value == "Pier Metrology"
        assert app.screen.query_one("#certificate-received", Input).value == "2026-11-20"
        await typed(**{"customer-email": ""})
    bench = told.bench
    assert bench is not None
    assert bench.operator == "Ada"
    assert (bench.laboratory.name, bench.laboratory.country) == ("Pier Metrology", "DE")
    assert (bench.customer.name, bench.customer.email) == ("Slow Waves & Sons", "")
    assert bench.certificate.received == date(2026, 11, 20)
    assert bench.certificate.condition == 'no damage, "as new"'
    assert (bench.certificate.decision_rule, bench.certificate.guard_band) == (
        "simple-acceptance",
        0.5,
    )


def test_why_a_test_did_not_start_is_on_the_row_of_the_sensor() -> None:
    failure = "sensor 'B' on /dev/ttyUSB1: busy: another program has it open\nno disk left"
    screen = Console(width=NARROW[0], file=io.StringIO())
    screen.print(sensors_of_bench(State("lab", demo_bench(), failure=failure)))
    assert isinstance(screen.file, io.StringIO)
    rows = screen.file.getvalue().splitlines()
    assert [row.split()[0] for row in rows if "▲ busy" in row] == ["B"]


def test_a_trace_shows_the_range_of_the_values() -> None:
    rising = trace(np.arange(80.0), width=4)
    assert rising == "⣀⠤⠒⠉"
    assert trace(np.zeros(80), width=4) == "⠤⠤⠤⠤"
    assert trace(np.tile([0.0, 1.0], 40), width=2) == "⣿⣿"
    assert trace(np.array([1.0]), width=3) == "   "


async def test_hum_is_seen_in_spectra_beside_noise_models_before_a_test(
    told: ProgressCallback,
) -> None:
    a, b, c = SOUND
    rate = a.sensor.sampling_rate
    at = np.arange(len(a.samples)) / rate
    hum = 1e-3 * np.sin(2 * np.pi * 50 * at)[:, None]
    async with live(told, a, replace(b, samples=b.samples + hum), c) as (app, pilot, reading):
        text = await pressed(pilot, app, "g")
        assert "NHNM" in text
        assert "NLNM" in text
        assert "● live" in text  # the states of the sensors stay
        assert "last 10 s" not in text
        await pressed(pilot, app, "g")
        assert "last 10 s" in screen_text(app)
    drawn = {each.label: each for each in spectra(reading.sensors, SITES)}
    near = np.abs(10 ** drawn["A"].log_frequency - 50) < 1
    assert (drawn["B"].level_db[near].max() - drawn["A"].level_db[near].max()) > 10
    width = 50 * np.log(rate / 2 * SPECTRUM_SEGMENT) / SPECTRUM_POINTS  # Hz of the point there
    expected = 10 * np.log10(1e-6 / 2 / width)  # the mean square of the sine, in that band
    assert drawn["B"].level_db[near].max() == pytest.approx(expected, abs=1.5)
