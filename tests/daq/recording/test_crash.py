"""What was acknowledged survives kill -9, a full disk and a torn end; healing loses nothing."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from daq.bench.channel import Channel
from daq.errors import RecordingError
from daq.protocols.block import Block, BlockFlag, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording, control_address
from daq.recording.repair import repair, verify, write_results
from daq.recording.storage.superblock import lookup3
from daq.recording.writer import RecordingWriter
from tests.full_disk import files_limited_to
from tests.torture.crashes import MANY

NOW = HostTime(1_000_000_000, 1_790_000_000_000_000_000)


def run_writer(path: Path) -> subprocess.Popen[str]:
    """Record until the disk fails, or for ever; acknowledge on standard output."""
    program = [sys.executable, "-m", "tests.torture.recording_program"]
    command = [*program, str(path), "/dev/stdout", str(MANY)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def rows(line: str) -> dict[str, int]:
    """Return how many rows of each sensor a line acknowledges."""
    return {name: counts[0] for name, counts in json.loads(line)["sensors"].items()}


def killed(path: Path, n_lines: int) -> dict[str, int]:
    """Kill a writer after some acknowledgments; return the last one it managed to give."""
    with run_writer(path) as writer:
        assert writer.stdout is not None
        lines = [writer.stdout.readline() for _ in range(n_lines)]
        writer.send_signal(signal.SIGKILL)
        lines += writer.stdout.readlines()
    return rows([line for line in lines if line.endswith("\n")][-1])


@pytest.fixture(scope="module")
def of_killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of a recorder that was killed, for tests that work on a copy."""
    path = tmp_path_factory.mktemp("killed") / "r.h5"
    killed(path, 40)
    return path


def make(path: Path, n_rows: int = 250) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
    counts = np.random.default_rng(2).integers(-1000, 1000, (n_rows, 1)).astype(np.int32)
    channels = (Channel(name="x", sensitivity=1.0),)
    sensor = SensorLayout("a", channels, 100.0, np.dtype("i4"))
    writer = RecordingWriter.create(path, sensors=[sensor], created=NOW)
    for first in range(0, n_rows, 25):
        writer.append(Block("a", first, counts[first : first + 25], NOW))
    writer.close()
    return counts


@pytest.mark.parametrize(
    "n_lines", [12, *(pytest.param(n, marks=pytest.mark.long) for n in (3, 31))]
)
def test_a_kill_loses_no_acknowledged_rows(tmp_path: Path, n_lines: int) -> None:
    path = tmp_path / "r.h5"
    acknowledged = killed(path, n_lines)
    before = verify(path)
    assert before.intact
    assert not before.closed
    assert not before.being_written
    with Recording.open(path) as recording:
        kept = {sensor.name: sensor.counts() for sensor in recording.sensors}
    for name, n_rows in acknowledged.items():
        assert len(kept[name]) >= n_rows > 0

    healed = repair(path, now=NOW)
    assert healed.closed
    assert healed.intact
    assert [s.n_uncommitted for s in healed.sensors] == [0, 0]
    with h5py.File(path, "r") as file:
        for name, counts in kept.items():
            np.testing.assert_array_equal(file["sensors"][name]["samples"][...], counts)
    with Recording.open(path) as recording:
        assert recording.closed
        assert recording.events[-1].kind == "stopped"
    assert repair(path) == healed
    assert [entry.name for entry in tmp_path.iterdir()] == ["r.h5"]


def test_repair_while_another_reader_lags_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with run_writer(path) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        with Recording.open(path) as lagging:
            lagging.sensors[0].counts()
            lines = [writer.stdout.readline() for _ in range(40)]
            writer.send_signal(signal.SIGKILL)
            writer.stdout.read()
            healed = repair(path, now=NOW)
    assert healed.intact
    for sensor in healed.sensors:
        assert sensor.n_samples >= rows(lines[-1])[sensor.name] > 0


def test_is_being_written_does_not_disturb_a_reader(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with run_writer(path) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        seen = dict.fromkeys("ab", 0)
        with Recording.open(path) as following:
            while min(seen.values()) < 3000:
                assert control_address(path) == (7, "token")
                writer.stdout.readline()
                following.refresh()
                for sensor in following.sensors:
                    counts = sensor.counts(seen[sensor.name])
                    assert len(counts) == sensor.n_samples - seen[sensor.name]
                    assert not len(counts) or counts.any(axis=1).all()
                    seen[sensor.name] = sensor.n_samples
        writer.kill()
    assert control_address(path) == (7, "token")
    repair(path, now=NOW)
    assert control_address(path) is None


@pytest.mark.parametrize("kept", [0.02, 0.1, 0.7])
def test_a_truncated_file_of_a_killed_recorder_is_handled(
    of_killed: Path, tmp_path: Path, kept: float
) -> None:
    path = tmp_path / "r.h5"
    shutil.copyfile(of_killed, path)
    with path.open("r+b") as raw:
        raw.truncate(int(kept * path.stat().st_size))
    if kept < 0.5:
        with pytest.raises(RecordingError):
            verify(path)
    else:
        # What came first is there and said to be right; what is cut off is said to be missing.
        for sensor in verify(path).sensors:
            assert sensor.bad_blocks
            assert sensor.bad_blocks == tuple(range(sensor.bad_blocks[0], sensor.n_blocks))


def test_a_full_disk_is_reported_and_loses_no_committed_rows(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with files_limited_to(150_000), run_writer(path) as writer:
        assert writer.stdout is not None
        *lines, last = writer.stdout
    assert last == f"{path}: cannot be written: File too large\n"
    assert len(lines) > 5
    report = verify(path)
    assert report.intact
    for sensor in report.sensors:
        assert sensor.n_samples >= rows(lines[-1])[sensor.name] > 0
    assert repair(path).intact


def test_a_file_being_written_is_not_repaired(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with run_writer(path) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        assert verify(path).being_written
        with pytest.raises(RecordingError, match="another program is writing it"):
            repair(path)
        with pytest.raises(OSError, match="lock"):
            h5py.File(path, "r+")
        writer.send_signal(signal.SIGKILL)


def test_a_first_block_of_one_sample_is_verified(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    channels = (Channel(name="x", sensitivity=1.0),)
    sensor = SensorLayout("a", channels, 100.0, np.dtype("i4"))
    writer = RecordingWriter.create(path, sensors=[sensor], created=NOW)
    counts = np.arange(50, dtype=np.int32)[:, None]
    writer.append(Block("a", 0, counts[:1], NOW, flags=BlockFlag.CLOCK_RESTART))
    writer.append(Block("a", 1, counts[1:], NOW))
    writer.close()
    with h5py.File(path, "r+") as file:
        file["sensors/a/samples"][0] = 7
    (found,) = verify(path).sensors
    assert found.bad_blocks == (0,)


def test_a_wrong_block_row_is_found(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    make(path)
    with h5py.File(path, "r+") as file:
        row = file["sensors/a/blocks"][3]
        row["utc_ns"] += 1
        file["sensors/a/blocks"][3] = row
    assert verify(path).sensors[0].bad_blocks == (3,)


def test_results_replace_earlier_ones_and_leave_the_samples(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    counts = make(path)
    write_results(path, {"a": ({"x": np.arange(3.0)}, {}), "b": ({"x": np.arange(2.0)}, {})})
    write_results(path, {"b": ({"x": np.arange(4.0)}, {"unit": "Hz"})})
    with Recording.open(path) as recording:
        ((method, (arrays, attributes)),) = recording.results().items()
        assert method == "b"
        assert arrays["x"].tolist() == [0, 1, 2, 3]
        assert attributes == {"unit": "Hz"}
        np.testing.assert_array_equal(recording.sensors[0].counts(), counts)
    assert verify(path).intact


def test_results_that_cannot_be_written_do_not_change_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    make(path)
    before = path.read_bytes()
    good, bad = {"x": np.arange(3.0)}, {"a/b": np.arange(3.0), "a": np.arange(3.0)}
    with pytest.raises(RecordingError, match="it was not changed"):
        write_results(path, {"first": (good, {}), "second": (bad, {})})
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["r.h5"]


def test_a_recording_left_open_is_closed_before_results_are_written(
    of_killed: Path, tmp_path: Path
) -> None:
    path = tmp_path / "r.h5"
    shutil.copyfile(of_killed, path)
    write_results(path, {"m": ({"x": np.arange(3.0)}, {})})
    assert verify(path).closed
    with Recording.open(path) as recording:
        assert list(recording.results()) == ["m"]


@pytest.mark.parametrize(
    ("key", "expected"),
    # From the comments of lookup3.c, driver5.
    [(b"", 0xDEADBEEF), (b"Four score and seven years ago", 0x17770551)],
)
def test_lookup3(key: bytes, expected: int) -> None:
    assert lookup3(key) == expected
