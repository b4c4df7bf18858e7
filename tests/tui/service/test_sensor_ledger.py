"""The ledger of sensors: tests of any bench by serial number, with noise that numpy made."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from typer.testing import CliRunner

from daq.bench.loading import load, parse
from daq.caveats import NO_CAVEATS, Caveat, Caveats
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.protocols.block import HostTime
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.results.result import Result
from tests.command import huddle, words_of
from tui.commands.main import app
from tui.service.history.ledger import ledger_path, noise_of, noted, record_test, sensor_tests
from tui.web.months import Months

RATE, SECONDS = 64.0, 1200
SETTINGS = Settings(segment=2.0, methods=("three-sensor",), band=(1.0, 16.0))
DAY = 86400 * 10**9
BEGUN = 1_792_886_400 * 10**9  # 25 October 2026
SENSOR = """
[[sensors]]
name = "{name}"
driver = "text"
port = "/dev/tty{name}"
channels = [{{name = "X", sensitivity = 1.0}}, {{name = "Y", sensitivity = 1.0}}]
"""
BENCH = "sampling_rate = 64.0\n" + "".join(SENSOR.format(name=name) for name in "ABC")


@pytest.fixture(autouse=True)
def ledger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    place = tmp_path / "data" / "sensors.sqlite"
    monkeypatch.setenv("HUDDLE_SENSORS", str(place))
    return place


def recorded(
    folder: Path, *, bench: str, day: int, louder_db: float = 0.0, serials: str = "123"
) -> Path:
    """Return a recording in which the noise of the sensor of serial number S1 is louder."""
    rng = np.random.default_rng(day)
    motion = 10 * rng.standard_normal((round(RATE * SECONDS), 2))
    about = parse(f'name = "{bench}"\n{BENCH}', "bench.toml")
    layouts = [
        SensorLayout(
            s.name,
            s.channels,
            RATE,
            np.dtype("<f8"),
            clock="one",
            serial_number=f"S{serials[n]}" if serials else "",
            firmware=f"1.{day}",
            temperature=20.0 + day,
        )
        for n, s in enumerate(about.sensors)
    ]
    path = folder / f"{bench}-{day}.h5"
    created = HostTime(0, BEGUN + day * DAY)
    with ArrayWriter(path, about, sensors=layouts, created=created) as writer:
        for n, sensor in enumerate(about.sensors):
            scale = 10 ** (louder_db / 20) if serials[n : n + 1] == "1" else 1.0
            writer.samples(sensor.name, motion + scale * rng.standard_normal((len(motion), 2)))
    return path


def recorded_test(path: Path) -> list[str]:
    return noted(path, Result(estimate([path], SETTINGS), SETTINGS))


def test_a_sensor_is_known_again_on_another_bench_by_its_serial_number(tmp_path: Path) -> None:
    first = recorded(tmp_path, bench="lab", day=0)
    assert recorded_test(first) == []
    assert len(recorded_test(recorded(tmp_path, bench="lab", day=10))) == 3
    moved = recorded(tmp_path, bench="office", day=31, louder_db=3.0, serials="312")
    result = Result(estimate([moved], SETTINGS), SETTINGS)
    found = {each.serial_number: each for each in record_test(moved, result)}
    assert [found[serial].sensor for serial in ("S1", "S2", "S3")] == ["B", "C", "A"]
    assert {each.n_tests for each in found.values()} == {3}
    for serial, louder_db in (("S1", 3.0), ("S2", 0.0), ("S3", 0.0)):
        drift = found[serial]
        assert 0.05 < drift.error < 1.0
        assert abs(drift.db - louder_db) < drift.error
    lines = noted(moved, result)  # the test is there once
    assert lines[1].startswith("B S1: +")
    assert "dB since 25 October" in lines[1]
    assert lines[1].endswith("3 tests (1–16 Hz)")
    assert len({started for _, started, *_ in noise_of("S1")}) == 3


def test_history_shows_a_sensor_over_all_benches(tmp_path: Path) -> None:
    for day, bench in enumerate(["lab", "office"]):
        recorded_test(recorded(tmp_path, bench=bench, day=day))
    told = huddle("history", "--sensor", "S2", "--band", "1:16", "--json", "-")
    series = json.loads(told.stdout)["series"]
    assert {(each["channel"], len(each["runs"])) for each in series} == {("X", 2), ("Y", 2)}
    assert [run["bench"] for run in series[0]["runs"]] == ["lab", "office"]
    tests = json.loads(told.stdout)["tests"]
    assert [(t["bench"], t["firmware"], t["temperature"]) for t in tests] == [
        ("lab", "1.0", 20.0),
        ("office", "1.1", 21.0),
    ]
    assert tests[0]["sensitivities"] == {"X": 1.0, "Y": 1.0}
    shown = CliRunner().invoke(app, ["history", "--sensor", "S2"]).output
    assert "1.1" in shown
    assert "21.0" in shown
    label = tmp_path / "S2.svg"
    huddle("history", "--sensor", "S2", "--label", label)
    drawn = ET.parse(label)  # noqa: S314 - our own
    words = [each.text for each in drawn.iter("{http://www.w3.org/2000/svg}text")]
    assert words[:2] == ["S2", "2026-10-26, 1 to 16 Hz"]
    assert len(words) == 4  # two channels
    assert "no test in the ledger" in words_of("history", "--sensor", "S9", code=2)
    huddle("history", code=2)


@pytest.mark.parametrize("caveats", [NO_CAVEATS, Caveats([Caveat.SIMULATED])])
def test_tests_with_the_same_caveats_are_compared(caveats: Caveats, tmp_path: Path) -> None:
    def test_of(day: int) -> list[str]:
        path = recorded(tmp_path, bench="lab", day=day)
        return noted(path, Result(replace(estimate([path], SETTINGS), caveats=caveats), SETTINGS))

    test_of(0)
    assert len(test_of(1)) == 3
    assert [each.caveats for each in sensor_tests("S1")] == [caveats, caveats]
    assert {each for *_, each in noise_of("S1")} == {caveats}


def test_the_page_of_sensors_shows_their_tests_on_other_benches(tmp_path: Path) -> None:
    for day, bench in enumerate(["lab", "office"]):
        recorded_test(recorded(tmp_path, bench=bench, day=day))
    path = tmp_path / "yard.toml"
    about = BENCH.replace('name = "A"', 'name = "A"\nserial_number = "S2"')
    path.write_text(f'name = "yard"\n{about}', encoding="utf-8")
    shown = Months(load(path)).sensors()
    assert not shown["found"]
    assert {(row[0], row[5]) for row in shown["everywhere"].rows} == {("S2", "2")}


def test_without_serial_numbers_or_a_ledger_nothing_is_kept(
    tmp_path: Path, ledger: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recorded(tmp_path, bench="lab", day=0, serials="")
    assert recorded_test(path) == []
    assert not ledger.exists()
    monkeypatch.setenv("HUDDLE_SENSORS", "off")
    assert ledger_path() is None
    assert recorded_test(recorded(tmp_path, bench="lab", day=1)) == []


def test_a_ledger_that_cannot_be_written_spoils_no_test(
    tmp_path: Path, ledger: Path, caplog: pytest.LogCaptureFixture
) -> None:
    ledger.parent.mkdir()
    ledger.write_bytes(b"no database" * 100)
    path = recorded(tmp_path, bench="lab", day=0)
    assert recorded_test(path) == []
    assert "the ledger of sensors has not got this test" in caplog.text
    with pytest.raises(sqlite3.DatabaseError):
        noise_of("S1")
