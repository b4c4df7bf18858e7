"""Conditions: lowest and highest of the readings that belong to the test."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from daq.bench.loading import parse
from daq.protocols.block import EventKind, HostTime, Quantity
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.results.sources import LoggedEvent, conditions, sources, with_uncounted

START = datetime(2026, 11, 25, 12, tzinfo=UTC)
BENCH = """
name = "pier"
sampling_rate = 1.0
[[sensors]]
name = "a"
driver = "text"
port = "/dev/ttyS1"
channels = [{name = "x", sensitivity = 1.0}]
data_sheet = {temperature = [0, 40]}
[[sensors]]
name = "b"
driver = "text"
port = "/dev/ttyS2"
channels = [{name = "x", sensitivity = 1.0}]
"""


def written(path: Path, *, temperature: float | None = None) -> Path:
    """Return a recording of ten hours in which the first sensor warms by 5 K an hour."""
    bench = parse(BENCH, "bench.toml")
    layouts = [
        SensorLayout(s.name, s.channels, 1.0, np.dtype("<f8"), temperature=temperature)
        for s in bench.sensors
    ]
    created = HostTime(0, round(START.timestamp()) * 10**9)
    with ArrayWriter(path, bench, sensors=layouts, created=created) as writer:
        for name in "ab":
            writer.samples(name, np.zeros((36_000, 1)))
        for minute in range(601 if temperature is None else 0):
            at = minute * 60 * 10**9
            writer.reading(Quantity.TEMPERATURE, minute / 12, at_ns=at, sensor="a")
            writer.reading(Quantity.TEMPERATURE, 50.0, at_ns=at)
            writer.reading("humidity", 40.0, at_ns=at, sensor="b")
    return path


def test_all_readings_are_those_of_the_whole_test(tmp_path: Path) -> None:
    found = sources([written(tmp_path / "r.h5")])
    a, b, host = conditions(found, found[0].bench)
    assert (a.sensor, a.lowest, a.highest, a.n_readings) == ("a", 0.0, 50.0, 601)
    assert (a.limits, a.is_outside) == ((0, 40), True)
    assert (b.sensor, b.quantity, b.limits, b.is_outside) == ("b", "humidity", None, False)
    assert (host.sensor, host.highest) == ("", 50.0)


def test_a_part_of_the_recording_has_its_own_conditions(tmp_path: Path) -> None:
    found = sources([written(tmp_path / "r.h5")])
    start, end = START + timedelta(hours=2), START + timedelta(hours=3)
    a, *_ = conditions(found, found[0].bench, start=start, end=end)
    assert (a.lowest, a.highest, a.n_readings) == (119 / 12, 181 / 12, 63)
    assert not a.is_outside


def test_an_older_recording_has_the_temperature_at_its_start(tmp_path: Path) -> None:
    found = sources([written(tmp_path / "r.h5", temperature=21.5)])
    a, b = conditions(found)
    assert (a.lowest, a.highest, a.n_readings, b.sensor) == (21.5, 21.5, 1, "b")


def test_lost_samples_of_an_estimate_take_the_place_of_those_recorded_of_the_same_sensor() -> None:
    kind = EventKind.UNCOUNTED
    recorded = [
        LoggedEvent(3, "A", kind, "recorded"), LoggedEvent(1, "A", EventKind.CONNECTED, "hello"),
        LoggedEvent(2, "B", kind, "recorded"),
    ]  # fmt: skip
    found = with_uncounted(recorded, [LoggedEvent(4, "A", kind, "estimated")])
    assert [(e.utc_ns, e.sensor, e.text) for e in found] == [
        (1, "A", "hello"), (2, "B", "recorded"), (4, "A", "estimated"),
    ]  # fmt: skip
