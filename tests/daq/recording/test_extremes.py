"""Extremes of samples by bucket: what waveforms are drawn from, and what is kept of them."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.recording import extremes
from daq.recording.array_writer import ArrayWriter
from daq.recording.extremes import BUCKET, SUFFIX, Extremes, extremes_of
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.repair import verify
from tests.daq.clocks.recordings import ORIGIN, Sensor, blocks, counts, create, write

N_SAMPLES = 60 * BUCKET + 77


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    sensors = {name: Sensor(counts(N_SAMPLES, 2, n), clock="one") for n, name in enumerate("AB")}
    return write(tmp_path_factory.mktemp("made") / "run.h5", sensors)


@pytest.fixture
def path(made: Path, tmp_path: Path) -> Path:
    """Return a recording of two sensors."""
    return Path(shutil.copy(made, tmp_path))


def brute(samples: NDArray[np.int32], edges: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the extremes of columns, from samples."""
    pieces = [samples[a:b] for a, b in itertools.pairwise(edges)]
    nothing = np.full(samples.shape[1], np.nan)
    return np.array([[p.min(0), p.max(0)] if len(p) else [nothing, nothing] for p in pieces])


def test_of_few_rows_a_column_has_the_extremes_of_its_samples(path: Path) -> None:
    """Also where columns have no row."""
    edges = np.sort(np.random.default_rng(1).integers(100, 4000, 50))
    with Recording.open(path) as recording:
        least, most = extremes_of(recording)[0].between(edges)
    expected = brute(counts(N_SAMPLES, 2, 0), edges)
    np.testing.assert_array_equal(least, expected[:, 0])
    np.testing.assert_array_equal(most, expected[:, 1])


@pytest.mark.parametrize("n_columns", [1, 2, 7, 29])
def test_of_many_rows_no_extreme_is_missed(path: Path, n_columns: int) -> None:
    """And what is drawn lies less than a column beside."""
    samples = counts(N_SAMPLES, 2, 0)
    edges = np.linspace(0, N_SAMPLES, n_columns + 1).astype(np.int64)
    with Recording.open(path) as recording:
        least, most = extremes_of(recording)[0].between(edges)
    width = -(-N_SAMPLES // n_columns)
    own = brute(samples, edges)
    wide = np.array(
        [
            [
                samples[max(0, a - width) : b + width].min(0),
                samples[max(0, a - width) : b + width].max(0),
            ]
            for a, b in itertools.pairwise(edges)
        ]
    )
    assert (least <= own[:, 0]).all()
    assert (most >= own[:, 1]).all()
    assert (least >= wide[:, 0]).all()
    assert (most <= wide[:, 1]).all()


def test_those_of_a_growing_recording_are_extended(tmp_path: Path) -> None:
    """To what they are of the whole one; the last bucket fills up."""
    sensor = Sensor(counts(N_SAMPLES, 2, 0))
    writer = create(tmp_path / "run.h5", {"A": sensor})
    pieces = blocks("A", sensor)
    for block in pieces[:100]:
        writer.append(block)
    writer.commit()
    with Recording.open(tmp_path / "run.h5") as recording:
        grown = Extremes(recording.sensors[0])
        grown.extend()
        assert 0 < grown.n_rows < N_SAMPLES
        assert grown.n_rows % BUCKET
        for block in pieces[100:]:
            writer.append(block)
        writer.close()
        recording.refresh()
        grown.extend()
        edges = np.linspace(0, N_SAMPLES, 12).astype(np.int64)
        found = grown.between(edges)
        np.testing.assert_array_equal(found, extremes_of(recording)[0].between(edges))


def test_a_damaged_block_has_no_extremes(path: Path) -> None:
    """Its samples are counted as missing, whatever stands there."""
    with h5py.File(path, "r+") as file:
        file["sensors/A/samples"][420, 0] += 5
        rows = file["sensors/A/blocks"][2:4]["first_row"].tolist()
    with Recording.open(path) as recording:
        least, most = extremes_of(recording)[0].between(np.array([390, *rows, 660]))
    assert np.isnan([least[1], most[1]]).all()
    assert np.isfinite([least[0], least[2]]).all()


def test_large_recordings_keep_theirs(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recording is as it was; what is kept is used, and not for other samples."""
    edges = np.array([0, N_SAMPLES])
    with Recording.open(path) as recording:
        extremes_of(recording)
    kept = path.with_suffix(SUFFIX)
    assert not kept.exists()
    monkeypatch.setattr(extremes, "KEPT_FROM", 1)
    before = path.read_bytes()
    with Recording.open(path) as recording:
        made = [each.between(edges) for each in extremes_of(recording)]
    assert path.read_bytes() == before
    assert verify(path).intact
    assert kept.stat().st_mode == path.stat().st_mode
    read: list[int] = []
    with Recording.open(path) as recording:
        again = [each.between(edges) for each in extremes_of(recording, read.append)]
    assert read == [N_SAMPLES % BUCKET] * 2
    np.testing.assert_array_equal(made, again)
    read.clear()
    other = {name: Sensor(counts(N_SAMPLES, 2, n + 5), clock="one") for n, name in enumerate("AB")}
    kept.rename(path.with_name("other.extremes"))
    write(path.with_name("new.h5"), other).rename(path.with_name("other.h5"))
    with Recording.open(path.with_name("other.h5")) as recording:
        extremes_of(recording, read.append)
    assert sum(read) == 2 * N_SAMPLES


def test_a_writer_appends_them_as_the_recording_grows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who opens it, growing or closed, reads only samples that are in no full bucket."""
    monkeypatch.setattr(extremes, "KEPT_FROM", 10 * BUCKET)
    monkeypatch.setattr(extremes, "WAITING", 4)
    sensors = {name: Sensor(counts(N_SAMPLES, 2, n)) for n, name in enumerate("AB")}
    path, read = tmp_path / "run.h5", list[int]()
    writer = create(path, sensors)
    pieces = [block for name, sensor in sensors.items() for block in blocks(name, sensor)]
    pieces.sort(key=lambda block: block.first_sample)
    for number, block in enumerate(pieces):
        writer.append(block)
        if number % 20 == 0:
            writer.commit()
        if number == len(pieces) // 2:
            writer.commit()
            with Recording.open(path) as recording:
                extremes_of(recording, read.append)
                assert sum(read) < sum(each.n_samples for each in recording.sensors) / 2
    writer.close()
    assert path.with_suffix(SUFFIX).stat().st_mode == path.stat().st_mode
    read.clear()
    edges = np.linspace(0, N_SAMPLES, 12).astype(np.int64)
    with Recording.open(path) as recording:
        kept = [each.between(edges) for each in extremes_of(recording, read.append)]
    assert read == [N_SAMPLES % BUCKET] * 2
    path.with_suffix(SUFFIX).unlink()
    with Recording.open(path) as recording:
        made = [each.between(edges) for each in extremes_of(recording)]
    np.testing.assert_array_equal(kept, made)


def test_a_recording_goes_on_without_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where something that is no file has their name."""
    monkeypatch.setattr(extremes, "KEPT_FROM", 1)
    (tmp_path / "run.extremes").mkdir()
    path = write(tmp_path / "run.h5", {"A": Sensor(counts(N_SAMPLES, 2, 0))})
    assert verify(path).intact
    with Recording.open(path) as recording:
        (found,) = extremes_of(recording)
        assert found.n_rows == N_SAMPLES


def test_samples_that_a_channel_lacks_are_no_extremes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither in what the writer keeps, nor in what is made of the samples."""
    monkeypatch.setattr(extremes, "KEPT_FROM", 1)
    layout = SensorLayout(
        "A",
        tuple(Channel(name=name, sensitivity=1.0) for name in "XY"),
        100.0,
        np.dtype(np.int32),
        absent=np.array([[1, BUCKET // 2, 3 * BUCKET]]),
    )
    samples = counts(8 * BUCKET, 2, 0)
    samples[BUCKET, 1] = 1 << 30
    with ArrayWriter(tmp_path / "run.h5", sensors=[layout], created=ORIGIN) as writer:
        writer.samples("A", samples)
    edges, found = np.array([0, 4 * BUCKET, 8 * BUCKET]), []
    for _ in range(2):
        with Recording.open(tmp_path / "run.h5") as recording:
            found.append(extremes_of(recording)[0].between(edges))
        (tmp_path / "run.extremes").unlink()
    np.testing.assert_array_equal(found[0], found[1])
    assert np.nanmax(found[0]) < 1 << 30


@pytest.mark.parametrize("size", [0, 10, 5000])
def test_what_is_damaged_of_them_is_made_again(
    path: Path, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As is what was cut short."""
    monkeypatch.setattr(extremes, "KEPT_FROM", 1)
    with Recording.open(path) as recording:
        made = [each.between(np.array([0, N_SAMPLES])) for each in extremes_of(recording)]
    kept = path.with_suffix(SUFFIX)
    content = bytearray(kept.read_bytes())
    content[-2000:-1900] = bytes(range(100))
    kept.write_bytes(content[: size or None])
    with Recording.open(path) as recording:
        again = [each.between(np.array([0, N_SAMPLES])) for each in extremes_of(recording)]
    np.testing.assert_array_equal(made, again)
