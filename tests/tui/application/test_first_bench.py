"""The first bench: what answers on ports, until a test runs, is left and is found again."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from textual.pilot import Pilot
from textual.widgets import Input

from daq.bench.model import Bench
from daq.devices.bench_file import load, parse
from daq.devices.interface import DeviceInformation
from daq.errors import NotConnectedError
from daq.estimation.settings import Settings
from daq.preflight.device_check import DiscoveredDevice, network_ports
from daq.preflight.preview import SensorPreview
from daq.recording.control import ask
from daq.recording.reader import Recording
from tests.tui.application.screen_text import assert_looks_as_before, screen_text
from tests.tui.demo_bench import DEMO, demo_devices
from tests.tui.example_snapshot import demo_bench
from tests.waiting import limit
from tui.application.app import HuddleApp
from tui.application.bench_view.sensors import tapped
from tui.application.first_bench import FirstBenchApp, FirstBenchScreen, NetworkForm
from tui.commands.tui_controls import BenchControls, ComputerControls
from tui.runs.first_bench import draft
from tui.simulation.devices import simulated

SIZES = {"small": (80, 24), "middle": (120, 36), "wide": (200, 60)}
PORTS = tuple(f"/dev/ttyUSB{n}" for n in range(4))


def motion(seed: int, *, tap: float = 0.0) -> np.ndarray:
    """10 s of three channels at 200 Hz; a tap is a short burst half a second ago."""
    values = np.random.default_rng(seed).normal(size=(2000, 3)) * 1e-5
    values[1900:1910] += tap * 1e-5
    values[:, 2] += 9.8
    return values


@dataclass
class Prepared:
    """A computer with four ports: three with devices, of which B is tapped."""

    path: Path
    text: str = ""
    ports: Sequence[str] = PORTS
    taps: tuple[float, ...] = (8.0, 40.0, 10.0)
    is_shown: threading.Event = field(default_factory=threading.Event)
    is_late: threading.Event = field(default_factory=threading.Event)
    trouble: str = ""
    listed: tuple[tuple[str, str], ...] = ()
    writes_text: bool = False
    asked: list[str] = field(default_factory=list)
    targets: list[str] = field(default_factory=list)

    def listed_ports(self) -> Sequence[tuple[str, str]]:
        """Return what was prepared."""
        return self.listed

    def network_ports(self, target: str) -> Sequence[str]:
        """Note it."""
        self.targets.append(target)
        return ()

    def find_devices(self, port: str) -> Sequence[DiscoveredDevice]:
        """Return a device on any port but the last; the first one answers after the others."""
        self.asked.append(port)
        if port == PORTS[-1]:
            self.is_late.set()
            return ()
        if port == PORTS[0]:
            self.is_late.wait(limit())
        if self.writes_text:
            columns = {"delimiter": ",", "columns": [0, 1, 2], "baud_rate": 9600}
            return [DiscoveredDevice("text", port, columns, remark="'1,2,3'")]
        about = DeviceInformation("", "A352AD10", f"S{port[-1]}", "1.4", 200.0, 25.0)
        return [DiscoveredDevice("epson", port, {"baud_rate": 460800}, about)]

    def read(
        self,
        bench: Bench,
        show: Callable[[tuple[SensorPreview, ...]], None],
        ended: threading.Event,
    ) -> None:
        """Show all sensors once."""
        show(
            tuple(
                SensorPreview(
                    sensor,
                    None,
                    motion(n, tap=tap),
                    measured_rate=100.02 if self.writes_text else None,
                    trouble="" if n else self.trouble,
                )
                for n, (sensor, tap) in enumerate(zip(bench.sensors, self.taps, strict=False))
            )
        )
        self.is_shown.set()
        ended.wait(limit())

    def save(self, text: str) -> None:
        """Write it."""
        parse(text, self.path)
        self.path.write_text(text, encoding="utf-8")


@pytest.mark.parametrize("name", SIZES)
async def test_pictures(tmp_path: Path, name: str) -> None:
    controls = Prepared(tmp_path / "lab.toml", draft(tmp_path / "lab.toml"))
    controls.path = controls.path.relative_to(tmp_path)
    app = FirstBenchApp(controls)
    async with app.run_test(size=SIZES[name]) as pilot:
        await until(pilot, controls.is_shown.is_set)
        await until(pilot, lambda: "◀ tapped" in screen_text(app))
        await assert_looks_as_before(pilot, f"{name}-first-bench")
        await pilot.press("enter", "tab", "tab", "tab", "3")
        await assert_looks_as_before(pilot, f"{name}-first-bench-form")


async def test_two_names_two_limits_and_the_file_is_written(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    controls = Prepared(path, draft(path))
    app = FirstBenchApp(controls)
    async with app.run_test(size=SIZES["small"]) as pilot:
        await until(pilot, controls.is_shown.is_set)
        await pilot.press("n", *"quiet", "enter")
        await until(pilot, lambda: "quiet: no host answers" in screen_text(app))
        assert controls.targets == ["quiet"]
        await pilot.press("enter", *"Ann", "tab", "end", "backspace", "L", "tab", "tab")
        await pilot.press(*"nl", "enter")
        await until(pilot, lambda: "expected one of nlnm" in screen_text(app))
        await pilot.press(*"nm;3", "enter")
        await until(pilot, lambda: app.return_value is not None)
    assert app.return_value == path
    bench = load(path)
    assert bench.operator == "Ann"
    assert [sensor.name for sensor in bench.sensors] == ["A", "B", "L"]
    assert [each.name for each in bench.limits] == ["nlnm", "limit"]
    assert bench.usual_end.decided


async def test_a_sensor_in_trouble_says_why_and_ports_are_searched_again(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    controls = Prepared(path, draft(path), trouble="sensor 'A' on /dev/ttyUSB0: no answer")
    controls.listed = (("can://can0", "epson-can: socketcan, up"),)
    app = FirstBenchApp(controls)
    async with app.run_test(size=SIZES["small"]) as pilot:
        await until(pilot, lambda: "▲ sensor 'A' on /dev/ttyUSB0: no answer" in screen_text(app))
        await until(pilot, lambda: "epson-can: socketcan, up; a adds it" in screen_text(app))
        controls.asked.clear()
        await pilot.press("r")
        await until(pilot, lambda: controls.asked == [PORTS[-1]])  # the others are known


async def test_what_a_device_does_not_state_is_asked_for(tmp_path: Path) -> None:
    typed = {"A": "1e6", "B": "1", "C": "2e6"}  # B sends physical units
    path = tmp_path / "lab.toml"
    controls = Prepared(path, draft(path), writes_text=True)
    app = FirstBenchApp(controls)
    async with app.run_test(size=SIZES["middle"]) as pilot:
        for name in "ABC":
            await until(pilot, lambda n=name: f"{n}: state its sensitivity" in screen_text(app))  # type: ignore[misc]
            await until(pilot, lambda: screen_text(app).count("● live") >= 2)
            await pilot.press("enter")
            await until(pilot, lambda n=name: f"sensor {n}, driver text" in screen_text(app))  # type: ignore[misc]
            app.screen.query_one("#sensitivity", Input).value = typed[name]
            await pilot.press("enter")
        await until(pilot, lambda: "enter goes on" in screen_text(app))
        await pilot.press("enter", "enter")
        await until(pilot, lambda: app.return_value is not None)
    assert load(path).sampling_rate == 100.0
    assert load(path).estimate.band == (1.0, 40.0)
    for sensor in load(path).sensors:
        assert sensor.sampling_rate == 100.0
        assert [(c.name, c.sensitivity) for c in sensor.channels] == [
            (channel, float(typed[sensor.name])) for channel in ("c0", "c1", "c2")
        ]


async def test_two_sensors_are_a_bench_and_what_they_need_is_said(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    controls = Prepared(path, draft(path), ports=PORTS[1:], taps=(0.0, 0.0))
    app = FirstBenchApp(controls)
    async with app.run_test(size=SIZES["small"]) as pilot:
        await until(pilot, controls.is_shown.is_set)
        await until(
            pilot,
            lambda: (
                "2 sensors need changing motion · tap one: its row lights up · enter goes on"
                in screen_text(app)
            ),
        )
        await pilot.press("enter", "enter")
        await until(pilot, lambda: app.return_value is not None)
    assert len(load(path).sensors) == 2


def test_a_row_lights_up_for_the_sensor_that_is_tapped_and_for_no_other() -> None:
    felt = {"A": 9.0, "B": 30.0, "C": 12.0}
    bench = demo_bench()
    sensors = [
        SensorPreview(bench.sensor(name), None, motion(seed, tap=tap))
        for seed, (name, tap) in enumerate(felt.items())
    ]
    assert tapped(sensors) == "B"
    quiet = [SensorPreview(bench.sensors[0], None, motion(seed)) for seed in range(100)]
    assert [tapped([each]) for each in quiet] == [""] * 100
    dead = replace(quiet[0], samples=np.zeros((2000, 3)))
    assert tapped([dead, replace(quiet[1], samples=quiet[1].samples[:100])]) == ""


async def test_hosts_that_accept_connections_are_searched() -> None:
    async def hang_up(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.close()

    async with await asyncio.start_server(hang_up, "127.0.0.1", 0) as server:
        there = server.sockets[0].getsockname()[1]
        async with await asyncio.start_server(hang_up, "127.0.0.1", 0) as other:
            gone = other.sockets[0].getsockname()[1]
        found = await network_ports("127.0.0.1/32", numbers=(there, gone))
        assert found == [f"socket://127.0.0.1:{there}"]
        assert await network_ports("/dev/pts/3") == ["/dev/pts/3"]
    with pytest.raises(NotConnectedError, match="at most 1024 hosts"):
        await network_ports("10.0.0.0/8")


MOST_KEYS = 25


@pytest.mark.parametrize("key", ["question_mark", "f1"])
async def test_help_says_what_the_keys_do(tmp_path: Path, key: str) -> None:
    app = FirstBenchApp(Prepared(tmp_path / "lab.toml"))
    async with app.run_test(size=SIZES["small"]) as pilot:
        await pilot.press(key)
        await pilot.pause()
        for said in ("n          search a port", "del        leave", "ctrl+p     all commands"):
            assert said in screen_text(app)
        await pilot.press(key)
        assert isinstance(app.screen, FirstBenchScreen)


async def test_the_palette_does_what_the_keys_do(tmp_path: Path) -> None:
    controls = Prepared(tmp_path / "lab.toml")
    app = FirstBenchApp(controls)
    async with app.run_test(size=SIZES["small"]) as pilot:
        commands = {each.title: each for each in app.get_system_commands(app.screen)}
        assert {"Go on", "Network", "Search", "Edit", "Add", "Remove", "Theme"} <= set(commands)
        await pilot.press("ctrl+p", *"Network", "enter")
        await until(pilot, lambda: isinstance(app.screen, NetworkForm))


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")
async def test_from_cables_to_a_specimen_of_the_certificate_in_few_keys(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    keys: list[str] = []

    async def press(pilot: Pilot[Any], *some: str) -> None:
        keys.extend(some)
        await pilot.press(*some)

    with simulated(parse(DEMO), speed=8.0) as reachable:
        ports = [sensor.port for sensor in reachable.sensors]
        first = FirstBenchApp(ComputerControls(path, ports, draft(path)))
        async with first.run_test(size=SIZES["small"]) as pilot:
            await until(pilot, lambda: screen_text(first).count("● live") == 3)
            for size in reversed(SIZES.values()):
                await pilot.resize_terminal(*size)
                await until(pilot, lambda: screen_text(first).count("● live") == 3)
                assert "q Quit" in screen_text(first)
            await press(pilot, "enter", *"Ann", "tab", "tab", *"E N U", "tab", "3", "enter")
            await until(pilot, lambda: first.return_value is not None)
        bench = load(path)
        assert bench.simulation == {"speed": 8.0, "clock": reachable.simulated_clock}
        assert [sensor.port for sensor in bench.sensors] == ports
        assert all(sensor.serial_number for sensor in bench.sensors)
        controls = BenchControls(path, bench, Settings.of(bench))
        app = HuddleApp(controls)
        async with app.run_test(size=SIZES["small"]) as opened:
            await press(opened, "s", "enter")
            await until(opened, lambda: app.state.now is not None and app.state.now.elapsed > 0)
            assert app.state.now is not None
            assert app.state.now.until.decided
            for size in SIZES.values():
                await opened.resize_terminal(*size)
                await until(opened, lambda: "● recording" in screen_text(app))
            judged_by = None if app.state.result is None else app.state.result.bench
            assert judged_by is None or judged_by.operator == "Ann"
            await until(opened, lambda: "i Issue" in screen_text(app))
            await press(opened, "i", "enter")
            await until(opened, lambda: certificates(tmp_path) == 1)
        controls.release()
    assert len(keys) <= MOST_KEYS, keys


def certificates(folder: Path) -> int:
    """Return how many certificates have been made."""
    return len(list(folder.rglob("*.pdf")))


# --- on simulated wires: close, find again, mark, stop ---------------------------------------


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Path]:
    """Yield a bench file that reaches three simulated accelerometers."""
    with demo_devices(tmp_path, speed=8.0) as path:
        yield path


async def until(pilot: Pilot[Any], reached: Callable[[], bool]) -> None:
    """Let the application run until something is the case."""
    deadline = time.monotonic() + limit()
    while not reached():
        assert time.monotonic() < deadline, screen_text(pilot.app)
        await pilot.pause(0.2)


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")
async def test_closing_leaves_the_recorder_running_and_it_is_found_again(bench: Path) -> None:
    settings = replace(Settings.of(load(bench)), methods=("three-sensor", "three-channel"))
    controls = BenchControls(bench, load(bench), settings)
    first = HuddleApp(controls)
    async with first.run_test(size=(80, 24)) as pilot:
        assert load(bench).recording.duration is not None
        await pilot.press("s", "tab", "tab", *["backspace"] * 9, "enter")  # until x stops it
        await until(
            pilot, lambda: first.state.snapshot is not None and first.state.snapshot.n_segments > 2
        )
        assert first.state.now is not None
        assert first.state.now.until.duration is None
        assert load(bench).recording.duration is None  # remembered
        await pilot.press("q")
    (recorder,) = controls.started
    assert not recorder.ended
    assert ask(recorder.out, "status")

    second = HuddleApp(BenchControls(bench, load(bench), settings))
    async with second.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: second.state.snapshot is not None)
        await pilot.press("m", *"here", "enter")
        await until(pilot, lambda: all(w.group != "control" for w in second.workers))
        await pilot.press("x", "x", "enter", "y")
        await until(
            pilot, lambda: second.state.snapshot is not None and second.state.snapshot.closed
        )
        snapshot = second.state.snapshot
        assert snapshot is not None
        assert {"three-sensor", "three-channel"} <= set(snapshot.results)
        await until(pilot, lambda: "No limits in the bench file" in screen_text(second))
        await until(pilot, lambda: all(w.group != "follow" for w in second.workers))
        await pilot.press("w")
        await until(pilot, lambda: recorder.out.with_suffix(".html").exists())
    recorder.wait()
    controls.release()
    with Recording.open(recorder.out) as recording:
        assert recording.closed
        marks = [event.text for event in recording.events if event.kind == "mark"]
        assert [mark.split(" (")[0] for mark in marks] == ["here"]
        assert {"three-sensor", "three-channel"} == set(recording.results())
