"""``huddle import``: what a person and a program are told."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from daq.bench.estimate_settings import EstimateSettings
from daq.recording.reader import Recording
from tests.command import huddle, words_of
from tests.daq.formats.test_sources import START, STEP, counts, write_records
from tui.commands.main import app
from tui.output.exit_codes import ExitCode
from tui.runs.estimate_settings import chosen_for_files


@pytest.mark.usefixtures("needs_obspy")
def test_the_rest_is_imported_and_what_is_not_is_listed(tmp_path: Path) -> None:
    for channel in ("HHZ", "VMZ"):
        write_records(tmp_path / "a", counts(600, 1), channel=channel)
    (tmp_path / "b").write_text("no waveforms")
    sources = [str(tmp_path / "a"), str(tmp_path / "b")]
    found = huddle("import", *sources, "-o", tmp_path / "a.h5", "--json", "-", code=3)
    document = json.loads(found.stdout)
    assert [sensor["n_samples"] for sensor in document["sensors"]] == [600]
    assert document["left_aside"] == {"XX.ABC.00.VMZ": "state of health"}
    assert "unknown format" in document["problems"][0]
    assert "left aside (state of health): XX.ABC.00.VMZ" in found.stderr
    assert "not imported: " in found.stderr


def test_columns_and_the_unit_of_samples_are_said_on_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("".join(f"{k / 100},{k % 7},{k % 5}\n" for k in range(300)))
    command = ["import", str(tmp_path / "a.csv"), "-o", str(tmp_path / "a.h5")]
    assert "--columns 'time [s],X [m/s²],Y [m/s²]'" in words_of(*command, code=3)
    huddle(*command, "--columns", "time,X,Y [m/s]", "--sample-unit", "g")
    with Recording.open(tmp_path / "a.h5") as recording:
        (sensor,) = recording.sensors
        assert [(each.name, each.unit) for each in sensor.channels] == [("X", "g"), ("Y", "m/s")]


def test_overlap_is_a_choice_of_files_or_a_number_for_segments(tmp_path: Path) -> None:
    write_records(tmp_path / "a", counts(600, 1))
    write_records(tmp_path / "b", counts(600, 2))
    files = [str(tmp_path / "a"), str(tmp_path / "b")]

    def run(*options: str) -> int:
        (tmp_path / "a.h5").unlink(missing_ok=True)
        return CliRunner().invoke(app, ["import", *options, "-o", str(tmp_path / "a.h5")]).exit_code

    assert run(*files) == ExitCode.TROUBLE
    assert run(*files, "--overlap", "last") == ExitCode.DONE
    with Recording.open(tmp_path / "a.h5") as recording:
        np.testing.assert_array_equal(recording.sensors[0].counts()[:, 0], counts(600, 2))
    assert run(files[0], "--overlap", "0.75") == ExitCode.DONE
    with Recording.open(tmp_path / "a.h5") as recording:
        assert recording.bench is not None
        assert recording.bench.estimate.overlap == 0.75
    assert run(*files, "--overlap", "most") == ExitCode.USAGE
    assert run(files[0], "--start", "noon") == ExitCode.USAGE
    assert run(files[0], "--start", "2026-11-21", "--end", "2026-11-20") == ExitCode.USAGE


def test_of_one_sensor_at_two_rates_the_higher_is_imported(tmp_path: Path) -> None:
    for channel, step in (("HHZ", 1), ("BHZ", 5), ("HHN", 1), ("LDO", 100)):
        samples = counts(1000 // step, step)
        options = {"step_ns": STEP * step, "rate": 100.0 / step}
        write_records(tmp_path / "a", samples, channel=channel, **options)  # type: ignore[arg-type]  # a dictionary of floats
    select = ["--channels", "?H?"]
    arguments = ["import", str(tmp_path / "a"), "-o", str(tmp_path / "a.h5"), *select]
    found = huddle(*arguments)
    assert "left aside (20 Hz, where HH has 100 Hz): XX.ABC.00.BHZ" in found.stdout
    with Recording.open(tmp_path / "a.h5") as recording:
        (sensor,) = recording.sensors
        assert [channel.name for channel in sensor.channels] == ["HHN", "HHZ"]
        assert (sensor.sampling_rate, sensor.n_samples) == (100.0, 1000)


def test_the_rate_of_files_without_times_and_that_of_a_sensor_are_one_option(
    tmp_path: Path,
) -> None:
    (tmp_path / "a.csv").write_text("A.X,B.X\n" + "1,2\n3,5\n" * 500, encoding="utf-8")
    start = ["import", tmp_path / "a.csv", "-o", tmp_path / "a.h5", "--columns", "A.X,B.X"]
    huddle(*start, "--sampling-rate", "0", code=ExitCode.USAGE)
    huddle(*start, "--sampling-rate", "100", "--sampling-rate", "B=99.5")
    with Recording.open(tmp_path / "a.h5") as recording:
        assert {each.sampling_rate for each in recording.sensors} == {100.0}
        assert recording.bench is not None
        assert recording.bench.estimate.sampling_rates == {"B": 99.5}


def test_a_bench_file_is_compared_with_the_files(tmp_path: Path) -> None:
    path, bench = tmp_path / "a.csv", tmp_path / "a.toml"
    path.write_text("A.X,B.X\n" + "1,2\n3,5\n" * 500, encoding="utf-8")
    sensor = '[[sensors]]\nname="{}"\ndriver="text"\nport="/dev/tty{}"\n'
    sensor += 'channels=[{{name="X", sensitivity=1}}]\n'
    text = 'name="a"\nsampling_rate=200\n' + "".join(sensor.format(n, n) for n in "AB")
    bench.write_text(text, encoding="utf-8")
    given = ("import", path, "--bench", bench, "--sampling-rate", "100", "-o", tmp_path / "a.h5")
    assert "100 Hz as in the file, not 200 Hz as in the bench file" in huddle(*given).output
    limit = '[[limits]]\nname="l"\nfrequency=[1, 2]\npsd=[1, 1]\nsensors=["Q"]\n'
    bench.write_text(text + limit, encoding="utf-8")
    assert 'limits["l"].sensors' in huddle(*given, code=ExitCode.USAGE).stderr


def test_files_without_a_date_are_said_to_begin_together(tmp_path: Path) -> None:
    rows = "X\n" + "1\n3\n" * 500
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text(rows, encoding="utf-8")
    (tmp_path / "both.csv").write_text("A.X,B.X\n" + "1,2\n3,5\n" * 500, encoding="utf-8")
    given = ("--sampling-rate", "100")
    two = [tmp_path / "a.csv", tmp_path / "b.csv"]
    found = huddle("import", *two, *given, "-o", tmp_path / "two.h5")
    assert "no date in the files of a, b: taken to begin at the same instant" in found.stderr
    dated = "time,C.X\n2026-11-30T00:00:00Z,1\n2026-11-30T00:00:00.01Z,3\n"
    (tmp_path / "c.csv").write_text(dated, encoding="utf-8")
    found = huddle("import", two[0], tmp_path / "c.csv", *given, "-o", tmp_path / "mixed.h5")
    assert "no date in the files of a: taken to begin in 1970" in found.stderr
    assert "1970" not in found.stdout
    found = huddle("import", tmp_path / "both.csv", *given, "-o", tmp_path / "one.h5")
    assert "no date in" not in found.stderr


def test_what_single_channels_lack_is_printed(tmp_path: Path) -> None:
    write_records(tmp_path / "a", counts(600, 1), channel="HHZ")
    write_records(tmp_path / "b", counts(200, 2), channel="HHN", start=START + 100 * STEP)
    write_records(tmp_path / "c", counts(100, 3), channel="HHN", start=START + 500 * STEP)
    sources = [str(tmp_path / each) for each in "abc"]
    found = huddle("import", *sources, "-o", tmp_path / "a.h5")
    assert "missing where other channels have samples: HHN 3s in 2 pieces" in found.stdout
    with Recording.open(tmp_path / "a.h5") as recording:
        (sensor,) = recording.sensors
        assert sensor.n_samples == 600
        assert sensor.absent.tolist() == [[0, 0, 100], [0, 300, 500]]


def waves(path: Path, unit: str = "m/s") -> list[str]:
    """Write a CSV file of three sensors in this unit, 100 s at 20 Hz, and return its name."""
    rng = np.random.default_rng(3)
    motion = rng.standard_normal(2000)
    columns = [motion + 0.1 * rng.standard_normal(2000) for _ in "ABC"]
    lines = [f"time (s),{','.join(f'{name}.Z ({unit})' for name in 'ABC')}"]
    lines += [
        ",".join([f"{row / 20:.2f}", *(f"{column[row]:.6f}" for column in columns)])
        for row in range(2000)
    ]
    path.write_text("\n".join(lines), encoding="utf-8")
    return [str(path)]


def invoked(*words: str) -> dict[str, Any]:
    found = huddle(*words, "--json", "-")
    return dict(json.loads(found.stdout), stderr=found.stderr)


def test_an_estimate_of_files_is_that_of_their_recording(tmp_path: Path) -> None:
    files = waves(tmp_path / "a.csv")
    out = str(tmp_path / "a.h5")
    imported = invoked("import", *files, "-o", out)
    assert imported["chosen"] == {"unit": "unit m/s² (samples: m/s)"}
    assert "chosen for the estimate: unit m/s² (samples: m/s)" in imported["stderr"]
    directly, stored = invoked("estimate", *files), invoked("estimate", out)
    assert directly["settings"] == stored["settings"]
    assert directly["settings"]["unit"] == "m/s²"
    assert (directly["method"], directly["channels"]) == (stored["method"], stored["channels"])
    assert "chosen for the estimate: unit m/s²" in directly["stderr"]


def test_an_option_takes_the_place_of_what_is_chosen(tmp_path: Path) -> None:
    found = invoked("estimate", *waves(tmp_path / "a.csv"), "--unit", "mm/s", "--end", "50s")
    assert found["settings"]["unit"] == "mm/s"
    assert "chosen" not in found["stderr"]


def test_octaves_keep_the_short_segment_of_the_highest_octave() -> None:
    suggested = EstimateSettings(segment=1000.0)
    assert chosen_for_files(suggested).segment == 1000
    assert chosen_for_files(suggested, octaves=True).segment == 10
    assert chosen_for_files(suggested, octaves=True, segment=50.0).segment == 50


@pytest.mark.parametrize("command", ["report", "calibrate", "plot", "repair", "watch"])
def test_commands_of_recordings_name_the_import(tmp_path: Path, command: str) -> None:
    files = waves(tmp_path / "a b.csv")
    assert f"huddle import '{files[0]}' --out 'a b.h5'" in words_of(command, *files, code=3)


@pytest.mark.parametrize("command", ["check", "plan", "run", "record", "verify", "web", "tui"])
def test_commands_of_benches_name_the_import(tmp_path: Path, command: str) -> None:
    files = waves(tmp_path / "a.csv")
    found = huddle(command, *files, code=2)
    assert f"not a bench file (.toml); convert it to a recording: huddle import {files[0]}" in (
        found.stderr
    )


def test_a_recording_takes_no_response(tmp_path: Path) -> None:
    out = str(tmp_path / "a.h5")
    invoked("import", *waves(tmp_path / "a.csv"), "-o", out)
    huddle("estimate", out, "--channels", "Z", code=2)
