"""Which runs are too old, and by whose clock."""

from __future__ import annotations

import pathlib
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

import numpy as np
import pytest

from daq.acquisition.retention import DISTRUST, ClockTrust, remove_old
from daq.bench.loading import parse
from daq.bench.model import Channel
from daq.errors import RecordingError
from daq.protocols.block import HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from pathlib import Path

START = datetime(2026, 11, 21, 12, 0, 30, tzinfo=UTC)
BENCH = """
name = "{name}"
sampling_rate = 10.0

[[sensors]]
name = "a"
driver = "epson"
port = "x"
channels = [{{name = "x", sensitivity = 1.0}}]
"""


def test_only_old_closed_recordings_of_the_bench_are_removed(tmp_path: Path) -> None:
    def make(name: str, age_days: float, *, bench: str | None = "mine") -> RecordingWriter:
        utc_ns = round((START.timestamp() - age_days * 86400) * 1e9)
        sensor = SensorLayout("a", (Channel(name="x", sensitivity=1.0),), 10.0, np.dtype("i4"))
        return RecordingWriter.create(
            tmp_path / name,
            parse(BENCH.format(name=bench), "bench.toml") if bench else None,
            sensors=[sensor],
            created=HostTime(0, utc_ns),
        )

    make("old.h5", 31).close()
    make("new.h5", 29).close()
    make("other.h5", 31, bench="other").close()
    make("imported.h5", 31, bench=None).close()
    make("killed.h5", 31).abandon()
    (tmp_path / "foreign.h5").write_text("mine", encoding="utf-8")
    running = make("running.h5", 31)
    removed = remove_old(tmp_path, 30 * 86400, bench="mine", now=START, kept=0)
    running.close()
    assert removed == [tmp_path / "old.h5"]
    killed = ["killed.h5", "killed.h5.journal"]
    kept = ["foreign.h5", "imported.h5", *killed, "new.h5", "other.h5", "running.h5"]
    assert sorted(path.name for path in tmp_path.iterdir()) == kept


def test_one_that_cannot_be_removed_does_not_keep_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    utc_ns = round((START.timestamp() - 31 * 86400) * 1e9)
    sensor = SensorLayout("a", (Channel(name="x", sensitivity=1.0),), 10.0, np.dtype("i4"))
    bench = parse(BENCH.format(name="mine"), "bench.toml")
    for name in ("1.h5", "2.h5"):
        RecordingWriter.create(
            tmp_path / name, bench, sensors=[sensor], created=HostTime(0, utc_ns)
        ).close()
    unlink = pathlib.Path.unlink

    def refuse(path: Path, *, missing_ok: bool = False) -> None:
        if path.name == "1.h5":  # a superuser's test cannot take itself the right
            raise PermissionError(13, "Permission denied")
        unlink(path, missing_ok)

    monkeypatch.setattr(pathlib.Path, "unlink", refuse)
    with pytest.raises(RecordingError, match=r"1\.h5: cannot be removed: Permission denied"):
        remove_old(tmp_path, 30 * 86400, bench="mine", now=START, kept=0)
    assert [path.name for path in tmp_path.iterdir()] == ["1.h5"]


def close_recordings(folder: Path, *age_days: float) -> None:
    sensor = SensorLayout("a", (Channel(name="x", sensitivity=1.0),), 10.0, np.dtype("i4"))
    bench = parse(BENCH.format(name="mine"), "bench.toml")
    for age in age_days:
        created = HostTime(0, round((START.timestamp() - age * 86400) * 1e9))
        path = folder / f"{age:.0f}.h5"
        RecordingWriter.create(path, bench, sensors=[sensor], created=created).close()


def test_all_files_of_a_run_go_with_its_recording(tmp_path: Path) -> None:
    close_recordings(tmp_path, 31, 2)
    for name in ("31.json", "31.html", "31.pdf", "31.csv", "31.h5.journal", "31.toml", "2.json"):
        (tmp_path / name).write_text("x", encoding="utf-8")
    assert remove_old(tmp_path, 30 * 86400, bench="mine", now=START, kept=0) == [tmp_path / "31.h5"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["2.h5", "2.json", "31.toml"]


def test_the_newest_stay_however_old(tmp_path: Path) -> None:
    close_recordings(tmp_path, 100, 101, 102, 103, 104)
    remove_old(tmp_path, 30 * 86400, bench="mine", now=START)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["100.h5", "101.h5", "102.h5"]


class Clocks:
    """The system's clock, and one that is never set."""

    def __init__(self, now: datetime) -> None:
        self.now, self.monotonic = now, 100.0

    def pass_time(self, duration: timedelta) -> None:
        """Let both go on."""
        self.now += duration
        self.monotonic += duration.total_seconds()


def test_a_clock_from_before_the_release_is_not_believed() -> None:
    clocks = Clocks(datetime(1970, 1, 1, tzinfo=UTC))
    trust = ClockTrust(lambda: clocks.now, lambda: clocks.monotonic)
    assert "shows 1970-01-01, before this software was released" in trust.doubt()


@pytest.mark.parametrize("jump", [timedelta(days=3650), timedelta(hours=-2)])
def test_a_clock_that_jumped_is_not_believed_for_a_day(jump: timedelta) -> None:
    clocks = Clocks(START)
    trust = ClockTrust(lambda: clocks.now, lambda: clocks.monotonic)
    clocks.pass_time(timedelta(days=40))
    assert trust.doubt() == ""
    clocks.now += jump
    clocks.pass_time(timedelta(minutes=5))
    assert "was set by more than 1 h" in trust.doubt()
    clocks.pass_time(DISTRUST / 2)
    assert trust.doubt() != ""
    clocks.pass_time(DISTRUST)
    assert trust.doubt() == ""
