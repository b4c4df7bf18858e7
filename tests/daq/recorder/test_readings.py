"""What devices state of themselves is recorded once a minute, with what it is of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.bench.channel import Channel
from daq.protocols.block import Block, HostTime, Quantity, Reading
from daq.recorder.block_writer import BlockWriter
from daq.recorder.recorder import host_temperature
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.writer import RecordingWriter
from tests.daq.recorder.test_recorder import Run

CHANNELS = (
    Channel(name="x", sensitivity=1.0),
    Channel(name="T", sensitivity=100.0, unit="°C", auxiliary=True),
)


def at(seconds: float) -> HostTime:
    """Return a time after a full minute."""
    return HostTime(round((600 + seconds) * 1e9), round((6e8 + seconds) * 1e9))


def temperatures(path: Path, sensor: str) -> list[tuple[float, float]]:
    """Return seconds and values of what was recorded."""
    with Recording.open(path) as recording:
        return [
            (each.received.monotonic_ns / 1e9 - 600, each.value)
            for each in recording.readings
            if (each.sensor, each.quantity) == (sensor, Quantity.TEMPERATURE)
        ]


@pytest.mark.virtual_time
async def test_a_device_states_its_temperature_and_the_first_of_a_minute_is_kept(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path / "r.h5", "a")
    run.clock.ns = at(0).monotonic_ns
    async with run.going():
        for second in range(130):
            now = run.clock.now()
            reading = Reading("a", Quantity.TEMPERATURE, 20 + second / 10, now)
            run.device("a").items.put_nowait(reading)
            run.send("a", 100 * second, 100)
        await run.until("a", 12_900)
    assert temperatures(run.path, "a") == [(0, 20), (60, 26), (120, 32)]


def test_an_auxiliary_channel_in_degrees_is_the_temperature_of_its_sensor(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    layout = SensorLayout("a", CHANNELS, 1.0, np.dtype("i4"))
    file = RecordingWriter.create(path, sensors=[layout], created=at(0))
    writer = BlockWriter(file, {"a": 1.0}, {"a": (1, 100.0)})
    for second in range(0, 90, 10):
        counts = np.array([[7, 2000 + second + n] for n in range(10)], np.int32)
        writer.write([Block("a", second, counts, at(second))])
    writer.close(at(90), "done")
    assert temperatures(path, "a") == [(0, 20.09), (60, 20.69)]


def test_readings_that_are_not_safe_are_written_to_the_next_file(tmp_path: Path) -> None:
    layout = SensorLayout("a", CHANNELS, 1.0, np.dtype("i4"))
    names = tmp_path / "r.h5", tmp_path / "r-2.h5"
    first, second = (
        RecordingWriter.create(name, sensors=[layout], created=at(0)) for name in names
    )
    writer = BlockWriter(first, {"a": 1.0})
    writer.write([Reading("a", Quantity.SUPPLY, 12.0, at(0))])
    writer.commit()
    writer.write([Reading("a", Quantity.SUPPLY, 11.5, at(60))])
    writer.continue_in(second)
    writer.close(at(90), "done")
    found = []
    for name in names:
        with Recording.open(name) as recording:
            found.append([reading.value for reading in recording.readings])
    assert found == [[12.0], [11.5]]


def test_the_computer_is_as_warm_as_its_warmest_zone(tmp_path: Path) -> None:
    for name, text in (("zone0", "41500\n"), ("zone1", "52000\n"), ("zone2", "no number\n")):
        folder = tmp_path / f"thermal_{name}"
        folder.mkdir()
        (folder / "temp").write_text(text)
    (tmp_path / "thermal_zone3").mkdir()
    assert host_temperature(tmp_path) == 52.0
    assert host_temperature(tmp_path / "none") is None
