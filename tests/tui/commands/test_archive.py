"""``huddle archive``: begun, killed, resumed, on a cluster, and what it shows."""

from __future__ import annotations

import csv
import gc
import json
import shutil
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from daq.archive.answers import answer
from daq.archive.changes import Interval
from daq.archive.store import Store
from daq.bench.masks.mask_file import masks_named
from daq.estimation.snapshot import Snapshot
from daq.protocols.block import HostTime
from daq.python_process import python_command
from tests import command as commands
from tests import known_clocks
from tests.daq.archive.day_files import append, write_station
from tests.daq.archive.months import (
    HOUR_NS,
    SETTINGS,
    START_NS,
    assert_same,
    content,
    fill,
    record,
    store_for,
    three,
)
from tests.known_clocks import Oscillator, Scene
from tests.tui.schemas import validate
from tests.waiting import finish, wait_until
from tui.commands.main import app
from tui.output.archive.tables import course_table
from tui.page import drawing
from tui.report.figures import archive
from tui.report.figures.archive import days_figure, density_figure

OPTIONS = ("--segment", "10s", "--method", "three-sensor")
PLAIN = ("--equalise", "off", "--bridge", "0")
"""As the spectra of archives are."""
CLUSTER = """
import asyncio, sys
from distributed import Scheduler, Worker

async def serve():
    local = {"host": "127.0.0.1", "dashboard": False}
    async with Scheduler(port=0, scheduler_file=sys.argv[1], **local) as scheduler:
        async with Worker(scheduler.address, nthreads=1, **local):
            await scheduler.finished()

asyncio.run(serve())
"""
"""A scheduler and a worker in one process, which takes half the time of two."""


def huddle(*arguments: object, code: int = 0) -> Result:
    return commands.huddle("archive", *arguments, code=code, terminal_width=200)


def refused(*arguments: object) -> str:
    """Return what is said of options that do not go together, or not with the archive."""
    ended = CliRunner().invoke(app, ["archive", *map(str, arguments)], terminal_width=200)
    assert ended.exit_code in {2, 3}, ended.output
    return " ".join(ended.stderr.split())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder of three recordings and their archive."""
    made = tmp_path_factory.mktemp("recordings")
    three(made)
    huddle(made, *OPTIONS)
    return made


@pytest.mark.long
def test_the_archive_beside_the_recordings_answers_what_the_estimate_says(
    folder: Path, tmp_path: Path
) -> None:
    days = tmp_path / "days.csv"
    again = huddle(folder, "--json", "-", "--csv", days)
    assert "0 recordings to take, 3 in the archive already" in again.stderr
    found = json.loads(again.stdout)
    files = sorted(map(str, folder.glob("*.h5")))
    direct = commands.huddle("estimate", *files, *OPTIONS, *PLAIN, "--json", "-")
    wanted = json.loads(direct.stdout)
    assert found["pooled"]["segments"] == wanted["segments"]
    for one, other in zip(found["pooled"]["channels"], wanted["channels"], strict=True):
        psd, low, high = (
            np.array([each[key] for each in (one, other)], dtype=float)
            for key in ("noise_psd", "noise_psd_low", "noise_psd_high")
        )
        np.testing.assert_allclose(psd[0], psd[1], rtol=1e-9)
        wider = np.stack([low[1] - low[0], high[0] - high[1]]) / psd[1]
        assert np.nanmin(wider) > -1e-9  # by what stretches estimated alone scatter
        assert np.nanmax(wider) < 0.1
    validate("archive-2", found)
    assert found["days"]["date"] == ["2026-08-31", "2026-09-01"]
    assert np.shape(found["days"]["noise_psd"]) == (2, len(found["bands_hz"]), 6)
    assert found["archive"] == {
        "stretch_s": 3600, "recordings": 3, "problems": [], "doubted": [],
    }  # fmt: skip
    rows = list(csv.reader(days.read_text(encoding="utf-8").splitlines()))
    assert rows[0][6] == "noise PSD ((m/s²)²/Hz)"
    assert len(rows) == 1 + 2 * len(found["bands_hz"]) * 6
    assert float(rows[1][6]) == found["days"]["noise_psd"][0][0][0]


def test_what_is_wrong_is_named_and_the_rest_is_shown(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "huddle-archive", tmp_path / "store")
    bad = tmp_path / "bad.h5"
    bad.write_text("nothing")
    result = huddle(bad, "--store", tmp_path / "store", code=3)
    assert "bad.h5" in result.stderr
    assert "Noise by day" in result.stdout
    assert "not decided: 2 days" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--segment", "20s"], "--segment 20.0 (the archive: 10.0)"),
        (["--stretch", "day"], "--stretch day (the archive: hour)"),
        (["--equalise", "auto"], "--equalise auto (the archive: off)"),
        (["--exclude", "0s/60s"], "--exclude 0s/60s (the archive: none)"),
        (["--stretch", "week"], "expected hour or day"),
        (["--time-zone", "Mars"], "Europe/London"),
        (["--thin-hours"], "give --thin-after DAYS"),
    ],
)
def test_wrong_options_are_refused(folder: Path, arguments: list[str], message: str) -> None:
    before = content(Store.open(folder / "huddle-archive"))  # type: ignore[arg-type]  # there is one
    assert message in refused(folder, "--store", folder / "huddle-archive", *arguments)
    assert content(Store.open(folder / "huddle-archive")) == before  # type: ignore[arg-type]


def test_a_noise_model_that_has_no_unit_of_the_sensors_is_refused_before_work(
    tmp_path: Path,
) -> None:
    path = record(tmp_path / "counts.h5", hours=0.05, unit="counts")
    result = huddle(path, *OPTIONS, "--models", "nlnm", "--out", tmp_path / "figures", code=2)
    assert "'m/s²' cannot be turned into 'counts'" in " ".join(result.stderr.split())
    assert [each.name for each in tmp_path.iterdir()] == ["counts.h5"]


def test_without_recordings_and_archive_there_is_nothing_to_do(tmp_path: Path) -> None:
    result = huddle("--store", tmp_path / "none", code=2)
    assert "give recordings to begin one" in result.stderr


@pytest.mark.long
def test_killed_and_started_again_it_goes_on(folder: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    command = [*python_command("tui"), "archive", str(folder), "--store", str(store), *OPTIONS]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, **quiet) as process:  # type: ignore[call-overload]
        wait_until(lambda: any(store.glob("*/*.h5")), "the first recording in the archive")
        process.send_signal(signal.SIGKILL)
    huddle(folder, "--store", store)
    assert_same(Store.open(store), Store.open(folder / "huddle-archive"))  # type: ignore[arg-type]


@pytest.mark.long
def test_the_workers_of_a_cluster_write_the_same_values(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    store = tmp_path / "store"
    code, said = on_cluster(tmp_path, folder, "--store", store, *OPTIONS)
    assert code == 0, said
    assert "dashboard: http" in said
    assert_same(Store.open(store), Store.open(folder / "huddle-archive"))  # type: ignore[arg-type]  # there is one


@pytest.mark.long
def test_the_workers_of_a_cluster_take_days_of_all_stations(
    sds: Path, whole: tuple[Path, Result], tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    store = tmp_path / "store"
    code, errors = on_cluster(tmp_path, f"sds://{sds}", "--store", store, *DAYS)
    assert code == 0, errors
    assert errors.count("dashboard: http") == 1
    for name in ("XX.ABC", "XX.DEF"):
        assert_same(Store.open(store / name), Store.open(whole[0] / name))  # type: ignore[arg-type]  # there are
    assert huddle("--store", store).stdout == whole[1].stdout


def on_cluster(folder: Path, *arguments: object) -> tuple[int, str]:
    """Archive by a scheduler and a worker of Dask; returns exit code and standard error."""
    address = folder / "scheduler.json"
    with ExitStack() as stack:
        process = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-P", "-c", CLUSTER, str(address)],
                cwd=folder,
                stderr=subprocess.DEVNULL,
            )
        )
        stack.callback(process.kill)
        wait_until(lambda: address.exists() and address.read_text().endswith("}"), "a scheduler")
        scheduler = json.loads(address.read_text())["address"]
        command = [*python_command("tui"), "archive", *map(str, arguments)]
        with subprocess.Popen(
            [*command, "--scheduler", scheduler],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as huddle_command:
            code, _, said = finish(huddle_command)
    return code, said


@pytest.mark.long
def test_a_web_server_is_no_scheduler(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        command = [*python_command("tui"), "archive", str(folder), "--scheduler", address]
        with subprocess.Popen(
            [*command, "--store", str(tmp_path / "store"), *OPTIONS],
            stderr=subprocess.PIPE,
            text=True,
        ) as huddle_command:
            connection, _ = server.accept()
            with connection:
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n")
            server.close()
            code, _, said = finish(huddle_command)
    assert code == 3
    assert "no Dask scheduler answers" in said


@pytest.mark.long
def test_figures_show_the_density_and_the_days(folder: Path, tmp_path: Path) -> None:
    huddle("--store", folder / "huddle-archive", "-o", tmp_path, "--models", "nlnm")
    names = ["density", "recorded", "spectrogram", "days"]
    names += [f"channel-{sensor}.{channel}" for sensor in "ABC" for channel in "XY"]
    written = {f"{name}.{kind}" for name in names for kind in ("png", "svg", "pdf")}
    written.add("figures.npz")
    with np.load(tmp_path / "figures.npz", allow_pickle=False) as arrays:
        assert list(arrays["channels"]) == ["A.X", "A.Y", "B.X", "B.Y", "C.X", "C.Y"]
        assert arrays["spectrogram"].shape == (2, len(arrays["fine_hz"]) - 1, 6)
        # the motion is 28 dB above the noise
        gap = arrays["recorded_mode_db"] - arrays["noise_mode_db"]
        assert np.abs(gap - 28).max() < 4
        assert np.all(arrays["recorded_p10_db"] <= arrays["recorded_p90_db"])
    assert {path.name for path in tmp_path.iterdir() if path.stat().st_size > 5000} == written


@pytest.mark.long
def test_figures_have_a_panel_a_channel_with_what_was_found(tmp_path: Path) -> None:
    paths = [
        record(
            tmp_path / f"{day}.h5",
            hours=0.3,
            begin_ns=START_NS + 24 * day * HOUR_NS,
            seed=day,
            noise=20.0 if day < 5 else 40.0,
        )
        for day in range(10)
    ]
    store = store_for(tmp_path / "store", paths[0], stretch="day")
    assert fill(store, paths) == []
    kept: list[int] = []  # spectra of days that have ended, as recordings are taken

    def count(_: int, __: int) -> None:
        kept.append(sum(isinstance(each, Snapshot) for each in gc.get_objects()))

    gc.collect()
    found = answer(store, store.entries()[0], SETTINGS, progress=count)
    assert kept == [kept[0]] * 10
    for course in found.courses[:6]:
        assert [each.begin for each in course.segments] == [0, 5]
        assert course.steps[0].value == pytest.approx(20 * np.log10(2), abs=0.5)
    narrow = Interval(0.5, 0.49998, 0.50002)  # narrower than the last digit: not "±0.0000"
    exact = [
        replace(each, segments=(*each.segments[:-1], replace(each.segments[-1], drift=narrow)))
        for each in found.courses
    ]
    rows = course_table(replace(found, courses=tuple(exact))).rows
    assert [row[4] for row in rows] == ["0.5000 ±<0.0001"] * 6
    days = days_figure(found)
    titles = [axes.get_title() for axes in days.axes]
    assert titles == ["A.X", "A.Y", "B.X", "B.Y", "C.X", "C.Y"]
    for axes in days.axes:
        labels = axes.get_legend_handles_labels()[1]
        assert {"mean and drift of a segment", "change beyond uncertainty"} <= set(labels)
    low = found.levels.low.copy()
    low[2] = np.nan  # from zero: drawn to the bottom, which is not far below
    from_zero = days_figure(replace(found, levels=replace(found.levels, low=low)))
    lowest = 10 * np.log10(found.levels.mean[:, 0].min(axis=0))
    assert [axes.get_ylim()[0] for axes in from_zero.axes] == pytest.approx(list(lowest - 10))
    density = density_figure(found, masks_named("nlnm,nhnm"))
    assert [axes.get_title() for axes in density.axes[:6]] == titles
    with drawing.look():
        for figure in (days, density):
            figure.draw_without_rendering()
            (key,) = figure.legends
            box = key.get_window_extent()
            assert box.x0 >= 0
            assert box.x1 <= figure.bbox.width
            assert box.y0 >= max(axes.title.get_window_extent().y1 for axes in figure.axes[:6])


def test_a_recording_whose_clock_is_not_understood_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(rates=(20.0,) * 3, seconds=200.0)
    known_clocks.record(tmp_path / "good.h5", scene)
    fast = (Oscillator(), Oscillator(400.0), Oscillator())
    monkeypatch.setattr(known_clocks, "_ORIGIN", HostTime(0, 1_468_458_600 * 10**9))  # later
    known_clocks.record(tmp_path / "bad.h5", replace(scene, clocks=fast))
    said = huddle(tmp_path, *OPTIONS, "--json", tmp_path / "a.json")
    assert "the clock of B is not understood in it (bad.h5)" in " ".join(said.output.split())
    document = json.loads((tmp_path / "a.json").read_text("utf-8"))
    (left,) = document["archive"]["doubted"]
    bad = str((tmp_path / "bad.h5").resolve())
    assert left == {"source": bad, "clocks": ["B"]}
    validate("archive-2", document)
    facts = {each["kind"]: each for each in document["facts"]}
    assert list(facts) == [
        "recordings-left-out", "changes-undecided", "changes-not-tested", "stretches-left-out",
        "nights-not-compared",
    ]  # fmt: skip
    fact = facts["recordings-left-out"]
    assert (fact["rank"], fact["sensors"]) == ("delays", ["B"])
    assert fact["numbers"] == {"recordings": [bad]}
    assert fact["action"].startswith("Check whether samples are lost")
    assert facts["changes-undecided"]["numbers"] == {"n_days": 1, "needed": 8}


DAYS = ("--segment", "60s", "--method", "three-sensor")


@pytest.fixture(scope="module")
def sds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write day files of two stations, and of one with a single sensor."""
    root = tmp_path_factory.mktemp("sds")
    write_station(root, "ABC", days=1.6, seed=1)
    write_station(root, "DEF", days=1.0, seed=2)
    write_station(root, "ONE", days=0.1, seed=3, locations=("",))
    return root


@pytest.fixture(scope="module")
def whole(sds: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """Archive the day files; tests change no store. Also what the command said."""
    store = tmp_path_factory.mktemp("whole") / "store"
    said = huddle(f"sds://{sds}", "--store", store, *DAYS)
    return store, said


def test_stations_have_an_archive_each_and_a_line_in_the_table(
    sds: Path, whole: tuple[Path, Result], tmp_path: Path
) -> None:
    store, said = whole
    assert "2 stations: 3 days to take, 0 in the archive already" in said.stderr
    assert "left aside, with one sensor: XX.ONE" in said.stderr
    lines = [line.split() for line in said.stdout.splitlines()]
    assert [line[:5] for line in lines[1:]] == [
        ["XX.ABC", "3", "2", "2026-01-01", "2026-01-02"],
        ["XX.DEF", "3", "1", "2026-01-01", "2026-01-01"],
    ]
    assert (store / "XX.ABC" / "2026" / "2026-01-02.h5").exists()
    again = huddle(f"sds://{sds}", "--store", store)
    assert "2 stations: 0 days to take, 3 in the archive already" in again.stderr
    assert huddle("--store", store).stdout == again.stdout == said.stdout
    one = huddle("--store", store / "XX.ABC", "--json", "-")
    assert json.loads(one.stdout)["days"]["date"] == ["2026-01-01", "2026-01-02"]
    every = huddle("--store", store, "--json", "-", "--csv", tmp_path / "days.csv")
    document = json.loads(every.stdout)
    validate("archive-stations-1", document)
    assert [each["station"] for each in document["stations"]] == ["XX.ABC", "XX.DEF"]
    assert document["stations"][0]["answer"] == json.loads(one.stdout)
    rows = list(csv.DictReader((tmp_path / "days.csv").read_text("utf-8").splitlines()))
    days = {(row["station"], row["date"]) for row in rows}
    assert days == {("XX.ABC", "2026-01-01"), ("XX.ABC", "2026-01-02"), ("XX.DEF", "2026-01-01")}
    psd = document["stations"][1]["answer"]["days"]["noise_psd"][0][0][0]
    assert float(next(r for r in rows if r["station"] == "XX.DEF")["noise PSD (unit²/Hz)"]) == psd


@pytest.mark.long
def test_figures_of_stations_have_a_folder_each(
    whole: tuple[Path, Result], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As PNG alone; another test has all formats."""
    monkeypatch.setattr("tui.report.figures.archive._KINDS", archive._KINDS[:1])  # noqa: SLF001
    huddle("--store", whole[0], "-o", tmp_path)
    for name in ("XX.ABC", "XX.DEF"):
        assert (tmp_path / name / "days.png").stat().st_size > 5000
        assert (tmp_path / name / "figures.npz").exists()


def test_a_single_station_is_answered(sds: Path, tmp_path: Path) -> None:
    said = huddle(f"sds://{sds}", "--sta", "DEF", "--store", tmp_path, *DAYS, "--json", "-")
    document = json.loads(said.stdout)
    assert document["archive"]["recordings"] == 1
    assert document["pooled"]["segments"] == 2879
    validate("archive-2", document)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sta", "ONE"], "one sensor each: XX.ONE; expected two or more"),
        (["--sta", "NO"], "no miniSEED files found for these codes and times"),
        (["--file-overlap", "0.5"], "expected refuse, first or last"),
        (["--group", "LAB"], "--group LAB: expected NAME=PATTERN"),
        (["--group", "../x=XX.*"], "expected NAME=PATTERN"),
        (["--response", "no.xml"], "no.xml: no such file"),
        (["--start", "2026-01-02", "--end", "2026-01-01"], "expected a time after --start"),
        (["--unit", "m/s²"], "'counts'"),
    ],
)
def test_what_cannot_be_taken_of_waveform_files_is_refused_before_work(
    sds: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    assert message in refused(f"sds://{sds}", "--store", tmp_path / "store", *DAYS, *arguments)
    assert not (tmp_path / "store").exists()


def test_channels_without_a_response_are_named_before_work(sds: Path, tmp_path: Path) -> None:
    obspy = pytest.importorskip("obspy")
    path = tmp_path / "stations.xml"
    obspy.read_inventory().write(str(path), "STATIONXML")
    options = ("--response", path, "--store", tmp_path / "store", "--sta", "ABC")
    result = huddle(f"sds://{sds}", *options, *DAYS, code=3)
    for location in ("00", "10", "20"):
        assert f"no response for XX.ABC.{location}.LHZ" in result.stderr
    assert not (tmp_path / "store").exists()


def test_options_of_waveform_files_are_not_for_recordings(folder: Path, tmp_path: Path) -> None:
    result = huddle(
        folder, "--store", tmp_path / "store", "--group", "LAB=XX.*", "--net", "XX", code=2
    )
    assert "--net, --group: for waveform files" in result.stderr


def test_damage_in_a_file_is_named_and_the_day_is_taken(tmp_path: Path) -> None:
    root = tmp_path / "sds"
    write_station(root, days=0.5)
    path = append(root, "ABC", "10", 20_454 * 86400 * 10**9, np.arange(3, dtype=np.int32))
    content = bytearray(path.read_bytes())
    content[2048:2056] = b"\xff" * 8
    path.write_bytes(content)
    result = huddle(f"sds://{root}", "--store", tmp_path / "store", *DAYS, code=3)
    assert f"XX.ABC 2026-01-01: {path}" in " ".join(result.stderr.split())
    assert "Noise by day" in result.stdout


@pytest.mark.long
def test_days_of_stations_survive_kills_of_the_command(
    sds: Path, whole: tuple[Path, Result], tmp_path: Path
) -> None:
    store = tmp_path / "store"
    command = [*python_command("tui"), "archive", f"sds://{sds}", "--store", str(store), *DAYS]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([*command, "--jobs", "2"], **quiet) as process:  # type: ignore[call-overload]
        wait_until(lambda: any(store.glob("*/*/*.h5")), "the first day in the archive")
        process.send_signal(signal.SIGKILL)
    result = huddle(f"sds://{sds}", "--store", store, "--jobs", "2")
    assert "0 days to take" not in result.stderr
    for name in ("XX.ABC", "XX.DEF"):
        assert_same(Store.open(store / name), Store.open(whole[0] / name))  # type: ignore[arg-type]  # there are
