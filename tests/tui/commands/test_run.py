"""A huddle test over simulated wires, through the command: live equals offline, kill -9, Ctrl-C."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.bench.end_condition import EndCondition
from daq.bench.loading import dump
from daq.devices.bench_file import parse
from daq.python_process import python_command
from daq.recording.reader import Recording
from daq.recording.repair import verify
from tests.command import huddle, words_of
from tests.waiting import finish, wait_until

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals and SIGKILL")

SHORT = ("--duration", "6s", "--segment", "0.5s")


def start(*arguments: str, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        python_command("tui", *arguments),
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_samples(process: subprocess.Popen[str], path: Path, n_samples: int) -> None:
    """Return when this many samples of every sensor are committed to a file, or to one below."""

    def are_committed() -> bool:
        if process.poll() is not None:
            pytest.fail(f"it ended before that: {process.communicate()}")
        for file in path.rglob("*.h5") if path.is_dir() else (path,):
            if file.exists():
                with Recording.open(file) as recording:
                    if min(sensor.n_samples for sensor in recording.sensors) >= n_samples:
                        return True
        return False

    wait_until(are_committed, f"{n_samples} samples of every sensor in {path}")


def estimate(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(huddle("estimate", str(path), "--json", "-").stdout)
    return found


@pytest.mark.long
def test_result_of_a_run_is_that_of_its_file(bench: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.h5"
    page = tmp_path / "page.html"
    wanted = ("--duration", "14s", "--out", str(out), "--json", "-", "--report", str(page))
    done = huddle("run", str(bench), *wanted)
    assert "self-noise" in page.read_text(encoding="utf-8")
    assert f"{page} written" in done.stderr
    live, offline = json.loads(done.stdout), estimate(out)
    assert live["segments"] == offline["segments"] >= 8
    assert live["recordings"] == offline["recordings"]  # checksum of the file with its results
    assert live["recordings"][0]["sha256"] == hashlib.sha256(out.read_bytes()).hexdigest()
    for ours, theirs in zip(live["channels"], offline["channels"], strict=True):
        assert (ours["sensor"], ours["channel"]) == (theirs["sensor"], theirs["channel"])
        for key in ("data_psd", "noise_psd", "noise_psd_low", "noise_psd_high", "cov"):
            a, b = np.array(ours[key], dtype=float), np.array(theirs[key], dtype=float)
            np.testing.assert_allclose(a, b, rtol=1e-9)
    with Recording.open(out) as recording:
        assert recording.closed
        arrays, attributes = recording.results()["three-sensor"]
        assert attributes["segments"] == live["segments"]
        noise = np.array([c["noise_psd"] for c in live["channels"]], dtype=float).T
        np.testing.assert_allclose(arrays["noise_psd"], noise, rtol=1e-9)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")  # noqa: PTH110
def test_a_result_that_cannot_be_written_elsewhere_is_in_the_recording(
    bench: Path, tmp_path: Path
) -> None:
    out = tmp_path / "r.h5"
    wanted = (*SHORT, "--out", str(out), "--json", "/dev/full")
    assert "/dev/full" in huddle("run", str(bench), *wanted, code=3).stderr
    with Recording.open(out) as recording:
        assert recording.results()


@pytest.mark.long
def test_kill_in_the_middle_loses_nothing_that_was_acknowledged(
    bench: Path, tmp_path: Path
) -> None:
    out = tmp_path / "killed.h5"
    process = start("run", str(bench), "--out", str(out), "--duration", "10min")
    wait_for_samples(process, out, 2500)
    with Recording.open(out) as recording:
        acknowledged = [sensor.n_samples for sensor in recording.sensors]
    (child,) = children_of(process.pid)
    os.kill(child, signal.SIGKILL)
    code, said, err = finish(process)
    assert code == 3
    assert "three-sensor" in said  # the result of what was recorded is shown all the same
    said_of_it = " ".join(err.split())
    assert "the recorder was killed (signal 9, SIGKILL)" in said_of_it
    assert "huddle repair" in said_of_it
    report = verify(out)
    assert report.intact
    assert not report.being_written
    for sensor, n_samples in zip(report.sensors, acknowledged, strict=True):
        assert sensor.n_samples >= n_samples
    assert estimate(out)["segments"] >= 8


def test_a_fault_of_the_estimate_does_not_end_the_recording(
    bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr("daq.estimation.follow.follow", fail)
    out = tmp_path / "r.h5"
    huddle("run", str(bench), *SHORT, "--out", str(out))
    with Recording.open(out) as recording:
        assert recording.events[-1].text == "duration reached"
        # Of 6 s: sensors of a busy computer connect late.
        assert min(sensor.n_samples for sensor in recording.sensors) >= 3 * 190
        assert recording.results()


@pytest.mark.long
def test_ctrl_c_stops_the_recorder_and_still_prints_the_result(bench: Path, tmp_path: Path) -> None:
    out = tmp_path / "stopped.h5"
    process = start("run", str(bench), "--out", str(out), "--duration", "10min")
    wait_for_samples(process, out, 2500)
    process.send_signal(signal.SIGINT)
    code, said, err = finish(process)
    assert code == 130, err
    assert "three-sensor" in said
    with Recording.open(out) as recording:
        assert recording.closed
        assert recording.events[-1].kind == "stopped"


@pytest.mark.long
def test_until_cov_ends_the_run(bench: Path, tmp_path: Path) -> None:
    out = tmp_path / "until.h5"
    with_report = tmp_path / "bench.toml"
    text = bench.read_text(encoding="utf-8")
    with_report.write_text(text.replace("[recording]", '[recording]\nreport = "html"'), "utf-8")
    wanted = ("--out", str(out), "--until-cov", "0.4", "--json", "-")
    document = json.loads(huddle("run", str(with_report), *wanted).stdout)
    inside = slice(4, 41)  # 2 to 20 Hz
    cov = np.array([channel["cov"] for channel in document["channels"]], dtype=float)[:, inside]
    # The last, complete look differs a little from the live one that ended the run.
    assert np.median(cov, axis=1).max() <= 0.6
    with Recording.open(out) as recording:
        assert recording.events[-1].text != "duration reached"
    assert "self-noise" in out.with_suffix(".html").read_text(encoding="utf-8")


def test_the_recorder_ends_at_the_precision_that_its_recording_states(
    bench: Path, tmp_path: Path
) -> None:
    out = tmp_path / "alone.h5"
    table = json.dumps({"segment": "0.5s", "band": [2.0, 20.0]})
    process = start(
        *("record", str(bench), "--out", str(out), "--until", "60 %", "--until-stopped"),
        *("--estimate", table),
    )
    code, _, err = finish(process)  # nobody asks it to stop
    assert code == 0, err
    with Recording.open(out) as recording:
        assert recording.closed
        assert recording.until == EndCondition(cov=0.6)
        assert recording.duration is None
        assert recording.bench is not None
        assert recording.bench.estimate.segment == 0.5
        assert recording.bench.estimate.band == (2.0, 20.0)
        assert recording.events[-1].kind == "stopped"


def test_a_test_without_limits_cannot_end_when_they_are_decided(
    bench: Path, tmp_path: Path
) -> None:
    out = tmp_path / "undecided.h5"
    assert "has no limits" in words_of("run", bench, "--until-decided", "--out", out, code=2)
    recorded = ("record", bench, "--out", out, "--until")
    assert "has no limits" in words_of(*recorded, "decided", code=2)
    assert "expected" in words_of(*recorded, "soon", code=2)
    assert not out.exists()


def test_record_says_what_is_safe(bench: Path, tmp_path: Path) -> None:
    out = tmp_path / "record.h5"
    code, said, err = finish(
        start("record", str(bench), "--duration", "5s", "--out", str(out), "--json", "-")
    )
    assert code == 0, err
    status = json.loads(said)
    assert status["closed"]
    with Recording.open(out) as recording:
        assert recording.duration == 5
        for name in "ABC":  # how many is up to the load: connecting takes part of the duration
            assert status["sensors"][name]["samples"] == recording.sensor(name).n_samples > 0
    again = huddle("record", str(bench), "--duration", "5s", "--out", str(out), code=3)
    assert "exists already" in again.stderr


def test_a_run_too_short_for_any_estimate_is_refused_before_it_begins(
    bench: Path, tmp_path: Path
) -> None:
    out = tmp_path / "short.h5"
    huddle("run", str(bench), "--duration", "3s", "--out", str(out), code=2)
    assert not out.exists()


def test_a_recording_that_is_there_is_not_taken_for_the_new_one(
    bench: Path, tmp_path: Path
) -> None:
    out = tmp_path / "old.h5"
    out.write_bytes(b"last night")
    result = huddle("run", str(bench), "--out", str(out), code=3)
    assert "exists already" in result.stderr
    assert not result.stdout
    assert out.read_bytes() == b"last night"


def test_ports_that_are_not_there_are_named_and_exit_3(bench: Path, tmp_path: Path) -> None:
    broken = parse(bench.read_text(encoding="utf-8"))
    sensors = tuple(
        sensor.model_copy(update={"port": f"{tmp_path}/none-{sensor.name}"})
        for sensor in broken.sensors
    )
    path = tmp_path / "broken.toml"
    path.write_text(dump(broken.model_copy(update={"sensors": sensors})), encoding="utf-8")
    result = huddle("run", str(path), "--out", str(tmp_path / "none.h5"), code=3)
    for name in "ABC":
        assert f"none-{name}" in result.stderr


def children_of(pid: int) -> list[int]:
    """Process ids of the children of a process (Linux)."""
    done = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=True
    )
    return [int(line) for line in done.stdout.split()]


def test_check_finds_what_is_on_a_port(bench: Path) -> None:
    port = parse(bench.read_text(encoding="utf-8")).sensors[0].port
    (device,) = json.loads(huddle("check", "--port", port, "--json", "-").stdout)["devices"]
    assert device["driver"] == "epson"
    assert device["information"]["model"].startswith("A352")


@pytest.mark.long
def test_a_demo_ended_by_ctrl_c_says_so_and_still_compares(tmp_path: Path) -> None:
    process = start("demo", "--speed", "8", "--json", "-", TMPDIR=str(tmp_path))
    wait_for_samples(process, tmp_path, 2500)
    process.send_signal(signal.SIGINT)
    code, said, err = finish(process)
    assert code == 130, err
    assert len(json.loads(said)["channels"]) == 18


@pytest.mark.long
def test_demo_shows_which_estimate_is_right() -> None:
    document = huddle("demo", "--duration", "40s", "--speed", "8", "--json", "-").stdout
    channels = json.loads(document)["channels"]
    right, wrong = (
        [entry for entry in channels if entry["method"] == method]
        for method in ("three-sensor", "three-channel")
    )
    assert len(right) == len(wrong) == 9
    assert sum(entry["covers"] for entry in right) >= 8, document  # all nine at once in 95 %
    # Their intervals hold the truth only where a model test that fails by chance widens them.
    for entry in wrong:
        assert not 0 < entry["noise_psd"] < 2 * entry["true_noise_psd"], document
