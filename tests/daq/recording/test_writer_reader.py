"""What is written is what is read, while it grows and afterwards; secrets are not written."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.bench.channel import Channel
from daq.bench.loading import parse
from daq.bench.response import PolesZeros
from daq.errors import NotARecordingError, RecordingError
from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.repair import verify
from daq.recording.storage.locking import is_being_written
from daq.recording.writer import RecordingWriter

NOW = HostTime(1_000_000_000, 1_790_000_000_000_000_000)
RATE = 100.0
CHANNELS = (
    Channel(name="x", sensitivity=1e6, direction="up"),
    Channel(
        name="y",
        sensitivity=2.5,
        unit="V",
        response=PolesZeros(poles=(-1 + 2j, -1 - 2j), zeros=(0j,), frequency=5.0),
    ),
    Channel(name="temperature", sensitivity=100.0, unit="°C", auxiliary=True),
)


def layout(name: str) -> SensorLayout:
    return SensorLayout(name, CHANNELS, RATE, np.dtype("i4"), clock="c")


def samples(first: int, n: int) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
    """Return counts that tell their place."""
    return (np.arange(first, first + n)[:, None] * 10 + np.arange(3)).astype(np.int32)


def at(sample: int) -> HostTime:
    elapsed = round(sample / RATE * 1e9)
    return HostTime(NOW.monotonic_ns + elapsed, NOW.utc_ns + elapsed)


def block(sensor: str, first: int, n: int, **rest: object) -> Block:
    return Block(sensor, first, samples(first, n), at(first + n), **rest)  # type: ignore[arg-type]


def test_kinds_of_events_are_the_documented_strings_and_unknown_ones_are_read(
    tmp_path: Path,
) -> None:
    """A recording of a newer program, or of a driver from elsewhere, may hold other kinds."""
    written = [*EventKind, "warmed up"]
    writer = RecordingWriter.create(tmp_path / "r.h5", sensors=[layout("a")], created=NOW)
    for kind in written:
        writer.event(Event("a", kind, "", NOW))
    writer.close()
    with h5py.File(tmp_path / "r.h5") as file:
        assert file["events"]["kind"].tolist() == [
            *(b"started", b"stopped", b"mark", b"connected", b"disconnected", b"late", b"stalled"),
            *(b"refused", b"resynchronised", b"checksum", b"reset", b"overflow"),
            *(b"uncounted", b"clock", b"status"),
            b"warmed up",
        ]
    with Recording.open(tmp_path / "r.h5") as recording:
        kinds = [event.kind for event in recording.events]
    assert kinds == written
    assert [isinstance(kind, EventKind) for kind in kinds] == [True] * len(EventKind) + [False]


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "sub" / "r.h5"
    writer = RecordingWriter.create(
        path, sensors=[layout("b"), layout("a")], created=NOW, control=(4711, "token")
    )
    writer.append(block("b", 0, 130, flags=BlockFlag.CLOCK_RESTART, device_counter=7))
    writer.append(block("b", 150, 70, reason="cable"))
    writer.gap("b", 130, 20, reason="K" + 60 * "ä", estimated=True)
    instants = np.arange(50, dtype=np.int64) * 10_000_000
    writer.append(block("a", 0, 50, instants_ns=instants))
    writer.event(Event("b", EventKind.CONNECTED, "hello", NOW))
    done = writer.close()
    assert done.closed
    assert done.sensors["b"].rows == 200

    with Recording.open(path) as recording:
        assert recording.closed
        assert [sensor.name for sensor in recording.sensors] == ["b", "a"]
        b, a = recording.sensors
        assert b.channels == CHANNELS
        assert b.n_samples == 200
        np.testing.assert_array_equal(b.counts(0, 130), samples(0, 130))
        np.testing.assert_array_equal(b.counts(130), samples(150, 70))
        assert b.blocks["first_sample"].tolist() == [0, 150]
        assert b.blocks["first_row"].tolist() == [0, 130]
        assert b.blocks["device_counter"].tolist() == [7, -1]
        assert b.blocks["monotonic_ns"].tolist() == [at(130).monotonic_ns, at(220).monotonic_ns]
        (gap,) = b.gaps
        assert (gap["first_sample"], gap["missing"], gap["estimated"]) == (130, 20, 1)
        assert gap["reason"].decode() == "K" + 49 * "ä"  # 100 bytes at most
        np.testing.assert_array_equal(a.instants_ns(), instants)
        assert a.polled
        assert not b.polled
        assert recording.events == (Event("b", EventKind.CONNECTED, "hello", NOW),)
        assert recording.bench is None
        assert not recording.refresh()
        with pytest.raises(IndexError, match="200 are committed"):
            b.counts(0, 201)
        with pytest.raises(RecordingError, match="no sample times"):
            b.instants_ns()


def test_plain_h5py_reads_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    writer = RecordingWriter.create(path, sensors=[layout("a")], created=NOW)
    writer.append(block("a", 0, 250))
    writer.close()
    with h5py.File(path, "r") as file:
        assert file.attrs["format"].decode() == "huddle-recording"
        dataset = file["sensors/a/samples"]
        assert dataset.shape == (250, 3)
        assert dataset.chunks == (100, 3)
        assert dataset.fletcher32
        assert [unit.decode() for unit in dataset.attrs["unit"]] == ["m/s²", "V", "°C"]
        np.testing.assert_array_equal(dataset[...], samples(0, 250))


def test_only_complete_chunks_and_blocks_are_committed(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    writer = RecordingWriter.create(path, sensors=[layout("a")], created=NOW)
    for first in range(0, 195, 15):
        writer.append(block("a", first, 15))
    done = writer.commit()
    # 195 samples: one chunk of 100 is on disk, and the blocks up to row 90 end within it.
    assert done.sensors["a"].rows == 90
    assert done.sensors["a"].blocks == 6
    with h5py.File(path, "r", swmr=True, locking=False) as file:
        assert file["sensors/a/samples"].shape == (100, 3)
    assert writer.close().sensors["a"].rows == 195


def test_small_blocks_become_rows_of_a_tenth_of_a_second(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    writer = RecordingWriter.create(path, sensors=[layout("a")], created=NOW)
    for first in range(0, 20, 2):
        writer.append(block("a", first, 2))
    writer.append(block("a", 24, 2, reason="dropped"))
    writer.append(block("a", 26, 2, flags=BlockFlag.CLIPPED))
    writer.append(block("a", 28, 2, flags=BlockFlag.CLIPPED))
    writer.close()
    with Recording.open(path) as recording:
        blocks = recording.sensors[0].blocks
        assert blocks["first_sample"].tolist() == [0, 10, 24, 26]
        assert blocks["n_samples"].tolist() == [10, 10, 2, 4]
        assert blocks["monotonic_ns"].tolist() == [at(n).monotonic_ns for n in (10, 20, 26, 30)]


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(1, 350), min_size=1, max_size=12), st.sets(st.integers(0, 11)))
def test_any_blocks_and_commits(
    tmp_path_factory: pytest.TempPathFactory, lengths: list[int], commits: set[int]
) -> None:
    path = tmp_path_factory.mktemp("r") / "r.h5"
    writer = RecordingWriter.create(path, sensors=[layout("a")], created=NOW)
    first = 0
    for number, length in enumerate(lengths):
        writer.append(block("a", first, length))
        first += length
        if number in commits:
            rows = writer.commit().sensors["a"].rows
            assert first - rows < 100 + max(lengths)
    writer.close()
    with Recording.open(path) as recording:
        np.testing.assert_array_equal(recording.sensors[0].counts(), samples(0, first))


FOLLOWER = """
import json, sys
from daq.recording.reader import Recording
with Recording.open(sys.argv[1]) as recording:
    sensor = recording.sensors[0]
    for line in sys.stdin:
        news = recording.refresh()
        print(json.dumps([news, sensor.n_samples, int(sensor.counts().sum()), recording.closed,
                          len(recording.events)]), flush=True)
"""


def test_another_process_follows_a_growing_recording(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    writer = RecordingWriter.create(path, sensors=[layout("a")], created=NOW)
    command = [sys.executable, "-c", FOLLOWER, str(path)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as follower:
        assert follower.stdin is not None
        assert follower.stdout is not None
        asking, answering = follower.stdin, follower.stdout

        def ask() -> list[object]:
            print(file=asking, flush=True)
            answer: list[object] = json.loads(answering.readline())
            return answer

        assert ask() == [False, 0, 0, False, 0]
        for first in range(0, 300, 100):
            writer.append(block("a", first, 100))
            writer.event(Event("a", "mark", "", NOW))
            writer.commit()
            end = first + 100
            assert ask() == [True, end, int(samples(0, end).sum()), False, end // 100]
            assert ask()[0] is False
        writer.append(block("a", 300, 7))
        assert is_being_written(path)
        writer.close()
        assert not is_being_written(path)
        assert ask() == [True, 307, int(samples(0, 307).sum()), True, 3]


def test_a_growing_recording_is_followed_in_the_same_process(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    writer = RecordingWriter.create(path, sensors=[layout("a")], created=NOW)
    with Recording.open(path) as recording:
        writer.append(block("a", 0, 100))
        writer.commit()
        assert recording.refresh()
        np.testing.assert_array_equal(recording.sensors[0].counts(), samples(0, 100))
        writer.close()
        assert recording.refresh()
        assert recording.closed


def test_two_readers_of_a_file_at_rest_do_not_disturb_each_other(tmp_path: Path) -> None:
    """HDF5 shares its state of the file between them."""
    path = tmp_path / "r.h5"
    writer = RecordingWriter.create(path, sensors=[layout("a")], created=NOW)
    for first in range(0, 60_000, 100):
        writer.append(block("a", first, 100))
    writer.close()
    with Recording.open(path) as first_reader:
        for _ in range(3):
            with Recording.open(path) as second:
                np.testing.assert_array_equal(second.sensors[0].counts(0), samples(0, 60_000))
                np.testing.assert_array_equal(first_reader.sensors[0].counts(0), samples(0, 60_000))


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    path.write_text("precious", encoding="utf-8")
    with pytest.raises(RecordingError, match="exists already"):
        RecordingWriter.create(path, sensors=[layout("a")], created=NOW)


def test_counts_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    writer = RecordingWriter.create(tmp_path / "r.h5", sensors=[layout("a")], created=NOW)
    wide = Block("a", 0, np.full((3, 3), 2**40), NOW)
    with pytest.raises(RecordingError, match="int64 do not fit int32"):
        writer.append(wide)
    writer.abandon()


# What is no recording is refused, and the message says why.


@pytest.fixture
def closed(tmp_path: Path) -> Path:
    path = tmp_path / "r.h5"
    writer = RecordingWriter.create(path, sensors=[layout("a")], created=NOW)
    writer.append(block("a", 0, 250))
    writer.close()
    return path


def refusal(path: Path) -> str:
    with pytest.raises(NotARecordingError) as caught:
        Recording.open(path)
    return str(caught.value)


def test_a_text_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "t.h5").write_text("hello", encoding="utf-8")
    assert "expected an HDF5 file" in refusal(tmp_path / "t.h5")


def test_an_absent_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        Recording.open(tmp_path / "none.h5")


def test_another_hdf5_file_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "f.h5", "w") as file:
        file["data"] = [1, 2, 3]
    assert "it has no attribute format" in refusal(tmp_path / "f.h5")


def test_a_newer_format_is_refused(closed: Path) -> None:
    with h5py.File(closed, "r+") as file:
        file.attrs["format_version"] = 99
    assert "written by a newer version of huddle (format 99)" in refusal(closed)


@pytest.mark.parametrize("kept", [0.0, 0.001, 0.01, 0.5, 0.99])
def test_a_truncated_file_is_refused(closed: Path, kept: float) -> None:
    size = closed.stat().st_size
    with closed.open("r+b") as file:
        file.truncate(int(kept * size))
    assert ("truncated" if kept else "expected an HDF5 file") in refusal(closed)


# --- secrets of a bench file -----------------------------------------------------------------


BENCH = """
name = "lab"  # a comment that stays
sampling_rate = 100.0
{hooks}
[[sensors]]
name = "a"
driver = "epson"
port = "x"
channels = [{{name = "x", sensitivity = 1.0}}]

[storage]
keep_runs = 5
"""


@pytest.mark.parametrize(
    "hooks",
    [
        '[hooks]\non_finished = ["curl", "s3cret"]\n[metrics]\nport = 1',
        'hooks.on_failed = ["s3cret"]\nmetrics.port = 1',
        'hooks = {on_failed = ["s3cret"], retries = 2}',
    ],
)
def test_hooks_and_metrics_are_not_recorded(
    tmp_path: Path, hooks: str, caplog: pytest.LogCaptureFixture
) -> None:
    bench = parse(BENCH.format(hooks=hooks), tmp_path / "lab.toml")
    assert bench.hooks.retries
    layout = SensorLayout("a", bench.sensors[0].channels, 100.0, np.dtype("i4"))
    path = tmp_path / "r.h5"
    RecordingWriter.create(path, bench, sensors=[layout], created=HostTime(1, 2)).close()
    assert b"s3cret" not in path.read_bytes()
    with Recording.open(path) as recording, caplog.at_level(logging.WARNING):
        assert "# a comment that stays" in recording.bench_text
        assert recording.bench is not None
        assert recording.bench.sensors == bench.sensors
        assert recording.bench.storage == bench.storage
    assert not caplog.records


def test_a_recording_with_hooks_warns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("daq.recording.writer.recorded_text", lambda bench: bench.text)
    bench = parse(BENCH.format(hooks='[hooks]\non_failed = ["x"]'), tmp_path / "lab.toml")
    layout = SensorLayout("a", bench.sensors[0].channels, 100.0, np.dtype("i4"))
    path = tmp_path / "r.h5"
    RecordingWriter.create(path, bench, sensors=[layout], created=HostTime(1, 2)).close()
    with caplog.at_level(logging.WARNING):
        Recording.open(path).close()
        Recording.open(path).close()
    (said,) = caplog.records  # once
    assert "holds [hooks] of its bench file" in said.getMessage()
    assert "holds [hooks] of its bench file" in verify(path).warning
