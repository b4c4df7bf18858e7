"""Readings are as safe as samples: after a crash, in a repaired file, and against changes."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from daq.bench.channel import Channel
from daq.protocols.block import Block, HostTime, Quantity, Reading
from daq.recording.chunks.manifest import write_manifest
from daq.recording.description import write_checksums
from daq.recording.file_format import READINGS, SensorLayout
from daq.recording.reader import Recording
from daq.recording.repair import repair, verify, write_results
from daq.recording.storage.journal import journal_path
from daq.recording.writer import RecordingWriter

NOW = HostTime(10**12, 10**18)
WRITTEN = tuple(
    Reading("a", quantity, value, HostTime(10**12 + n, 10**18 + n))
    for n, (quantity, value) in enumerate(
        [(Quantity.TEMPERATURE, 24.5), (Quantity.SUPPLY, 12.1), ("humidity", 45.0)]
    )
)


def written(path: Path) -> RecordingWriter:
    """Return a writer that has committed samples and readings."""
    sensors = [SensorLayout("a", (Channel(name="x", sensitivity=1.0),), 100.0, np.dtype("i4"))]
    writer = RecordingWriter.create(path, sensors=sensors, created=NOW)
    writer.append(Block("a", 0, np.arange(200, dtype=np.int32)[:, None], NOW))
    for reading in WRITTEN:
        writer.reading(reading)
    writer.commit()
    return writer


def readings(path: Path) -> tuple[Reading, ...]:
    """Return those of a recording."""
    with Recording.open(path) as recording:
        return recording.readings


def test_readings_are_read_while_the_file_grows_and_later(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    writer = written(path)
    with Recording.open(path) as growing:
        assert growing.readings == WRITTEN
        more = Reading("", Quantity.TEMPERATURE, 50.0, NOW)
        writer.reading(more)
        writer.close()
        growing.refresh()
        assert growing.readings == (*WRITTEN, more)
    assert verify(path).intact
    write_results(path, {})
    assert readings(path) == (*WRITTEN, more)


@pytest.mark.parametrize("has_journal", [True, False])
def test_a_repaired_recording_has_the_readings_that_were_acknowledged(
    tmp_path: Path, *, has_journal: bool
) -> None:
    path = tmp_path / "r.h5"
    writer = written(path)
    writer.reading(Reading("a", Quantity.SUPPLY, 1.0, NOW))  # never acknowledged
    writer.abandon()
    if not has_journal:
        journal_path(path).unlink()
    assert repair(path).intact
    assert readings(path) == WRITTEN
    assert verify(path).intact


def test_a_changed_reading_is_found(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "r.h5"
    written(path).close()
    with h5py.File(path, "r+") as file:
        row = file["readings"][0]
        row["value"] = 20.0
        file["readings"][0] = row
    report = verify(path)
    assert "/readings" in report.changed
    assert report.damaged_tables == ("events and readings",)
    assert "wrong checksum of the events and readings" in caplog.text


def test_a_recording_of_an_earlier_version_has_none(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    written(path).close()
    with h5py.File(path, "r+") as file:
        del file["readings"]
        file["committed"][-1, READINGS] = 0
        write_checksums(file)
        write_manifest(file)
    assert verify(path).intact
    assert readings(path) == ()
