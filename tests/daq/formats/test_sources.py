"""Archives as they are: many files, gaps, overlaps, clocks, damage, channels nobody asked for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pymseed
import pytest
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.clocks.aligned_recording import AlignedRecording
from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import ForeignSensor, Stretch
from daq.formats.importer import import_files
from daq.formats.memory import RecordingInMemory, SensorInMemory
from daq.formats.readers import miniseed
from daq.formats.readers.miniseed import MiniSeedPart
from daq.formats.sources import Selection, open_sources, sensors_of_parts
from daq.formats.traces import PartCache, ReadPart, Trace, TracePart
from daq.protocols.block import HostTime
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from tests.traced_memory import peak_of

RATE = 100.0
STEP = 10_000_000
START = 1_795_230_000_000_000_000
RECORD = 200
"""Samples in a record of the tests."""


def counts(n: int, seed: int) -> NDArray[np.int32]:
    return np.random.default_rng(seed).integers(-(2**23), 2**23, n, dtype=np.int32)


def write_records(
    path: Path,
    samples: NDArray[Any],
    *,
    channel: str = "HHZ",
    station: str = "ABC",
    start: int = START,
    step_ns: float = STEP,
    rate: float = RATE,
) -> Path:
    """Append records of 200 samples, each with the time that a clock of `step_ns` has."""
    with path.open("ab") as file:
        for first in range(0, len(samples), RECORD):
            record = pymseed.MS3Record(reclen=1024, encoding=4 if samples.dtype.kind == "f" else 3)
            record.formatversion = 2
            record.sourceid = pymseed.nslc2sourceid("XX", station, "00", channel)
            record.samprate = rate
            record.starttime = start + round(first * step_ns)
            kind = "f" if samples.dtype.kind == "f" else "i"
            for packed in record.generate(samples[first : first + RECORD], kind):
                file.write(packed)
    return path


def opened(paths: Sequence[Path], selection: Selection | None = None) -> ForeignSensor:
    (sensor,) = open_sources(paths, selection).sensors.values()
    return sensor


def whole(stretch: Stretch) -> NDArray[Any]:
    return stretch.counts[0 : stretch.n_samples]


def test_a_sensor_in_several_files_is_one_in_any_order_of_files(tmp_path: Path) -> None:
    x, y = counts(6000, 1), counts(6000, 2)
    files = []
    for day, (first, end) in enumerate([(0, 2000), (2000, 4000), (4600, 6000)]):
        for channel, samples in (("HHZ", x), ("HHN", y)):
            path = tmp_path / f"{channel}.{day}"
            start = START + first * STEP
            files.append(write_records(path, samples[first:end], channel=channel, start=start))
    sensor = opened(files[::-1])
    assert (sensor.name, sensor.channels, sensor.first_samples()) == (
        "XX.ABC.00",
        ("HHN", "HHZ"),
        [0, 4600],
    )
    np.testing.assert_array_equal(whole(sensor.stretches[0]), np.stack([y, x], 1)[:4000])
    np.testing.assert_array_equal(whole(sensor.stretches[1]), np.stack([y, x], 1)[4600:])
    (result,) = import_files(files, tmp_path / "a.h5").sensors
    assert (result.n_gaps, result.missing, result.n_samples) == (1, 600, 5400)


def test_where_files_repeat_the_same_samples_they_are_taken_once(tmp_path: Path) -> None:
    x = counts(3000, 1)
    first = write_records(tmp_path / "a", x[:2000])
    second = write_records(tmp_path / "b", x[1000:], start=START + 1000 * STEP)
    sensor = opened([first, second, first])
    np.testing.assert_array_equal(whole(sensor.stretches[0])[:, 0], x)
    assert len(sensor.stretches) == 1


@pytest.mark.parametrize(
    ("files", "first", "last"),
    [
        # (first sample, samples) of each file; then which file has each span of the result
        (((0, 2000), (1000, 2000)), "aab", "abb"),
        (((0, 3000), (1000, 1000)), "aaa", "aba"),
        (((0, 1000), (0, 2000)), "ab", "bb"),
    ],
)
def test_overlapping_files_are_refused_or_cut_as_asked(
    tmp_path: Path, files: tuple[tuple[int, int], ...], first: str, last: str
) -> None:
    samples = {name: counts(4000, seed) for seed, name in enumerate("ab")}
    paths = []
    for name, (begin, n) in zip("ab", files, strict=True):
        path, start = tmp_path / name, START + begin * STEP
        paths.append(write_records(path, samples[name][begin : begin + n], start=start))
    with pytest.raises(ImportFormatError, match=r"HHZ: samples of .*a and of .*b overlap at"):
        opened(paths)
    for selection, owners in (
        (Selection(overlap="first"), first),
        (Selection(overlap="last"), last),
    ):
        sensor = opened(paths, selection)
        expected = np.concatenate(
            [samples[owner][k * 1000 : (k + 1) * 1000] for k, owner in enumerate(owners)]
        )
        np.testing.assert_array_equal(whole(sensor.stretches[0])[:, 0], expected)


def test_channels_of_the_instrument_are_left_aside_unless_asked_for(tmp_path: Path) -> None:
    for channel in ("HHZ", "HHN", "VMZ", "LCE", "HKO"):
        write_records(tmp_path / "a", counts(400, 1), channel=channel)
    found = open_sources([tmp_path / "a"])
    assert found.sensors["XX.ABC.00"].channels == ("HHN", "HHZ")
    assert set(found.left_aside.items()) == {
        (f"XX.ABC.00.{code}", "state of health") for code in ("VMZ", "LCE", "HKO")
    }
    asked = open_sources([tmp_path / "a"], Selection(channels=("VM?", "XX.*.HHZ")))
    assert asked.sensors["XX.ABC.00"].channels == ("HHZ", "VMZ")
    assert asked.left_aside["XX.ABC.00.HHN"] == "not in --channels"
    with pytest.raises(ImportFormatError, match=r"no samples of --channels EHZ in 1 files; they"):
        open_sources([tmp_path / "a"], Selection(channels=("EHZ",)))


def test_one_bad_file_or_channel_is_named_and_the_rest_imported(tmp_path: Path) -> None:
    good = write_records(tmp_path / "good", counts(1000, 1))
    write_records(good, counts(1000, 2), channel="HHN")
    write_records(good, counts(1000, 3), channel="HHE")
    twice = write_records(tmp_path / "twice", counts(1000, 4), channel="HHE")
    (tmp_path / "bad.csv").write_text("time,A.X\n0,1\n1,oops\n")
    sources = [tmp_path / "bad.csv", good, tmp_path / "none", twice]
    result = import_files(sources, tmp_path / "a.h5")
    assert [(s.sensor, s.channels) for s in result.sensors] == [("XX.ABC.00", ("HHN", "HHZ"))]
    bad, none, channel = result.problems
    assert "oops" in bad
    assert "no such file" in none
    assert "channel HHE: samples of" in channel
    with pytest.raises(ImportFormatError, match=r"oops[^\0]*no such file"):
        import_files([tmp_path / "bad.csv", tmp_path / "none"], tmp_path / "b.h5")


def test_damage_in_a_file_is_a_gap_with_its_bytes(tmp_path: Path) -> None:
    samples = counts(600_000, 1)
    path = write_records(tmp_path / "a", samples)
    content = bytearray(path.read_bytes())
    at = (1 << 20) + 5 * 1024
    content[at : at + 64] = bytes(64)  # the header of one record in the second megabyte
    path.write_bytes(bytes(content))
    found = open_sources([path])
    sensor = found.sensors["XX.ABC.00"]
    (said,) = found.problems
    assert f"bytes {at} to {at + 1024} are not sound miniSEED" in said
    _, second = sensor.first_samples()
    assert second - sensor.stretches[0].n_samples == RECORD
    np.testing.assert_array_equal(
        whole(sensor.stretches[0])[:, 0], samples[: sensor.stretches[0].n_samples]
    )
    np.testing.assert_array_equal(whole(sensor.stretches[1])[:, 0], samples[second:])
    path.write_bytes(bytes(content[: 1 << 20]) + bytes(content[1 << 20 : (1 << 20) + 500]))
    (said,) = open_sources([path]).problems
    assert "bytes 1048576 to 1049076 are not sound miniSEED" in said


def test_a_clock_off_its_rate_gives_neither_gaps_nor_jumps(tmp_path: Path) -> None:
    step = STEP * (1 + 80e-6)
    samples = counts(500_000, 1)
    half = 250_000
    files = [
        write_records(tmp_path / "a", samples[:half], step_ns=step),
        write_records(
            tmp_path / "b", samples[half:], step_ns=step, start=START + round(half * step)
        ),
    ]
    import_files(files, tmp_path / "a.h5")
    with Recording.open(tmp_path / "a.h5") as recording:
        sensor = recording.sensor("XX.ABC.00")
        assert len(sensor.gaps) == 0
        blocks = sensor.blocks[:]
        expected = START + blocks["first_sample"] * step
        # Only starts of records are stated: the end of a file is known to the drift within one.
        within_a_record = RECORD * STEP * 80e-6
        assert np.max(np.abs(blocks["device_counter"] - expected)) < within_a_record + 2000
        clock = AlignedRecording(recording).clocks[0]
        assert clock.ppm == pytest.approx(-80, abs=0.1)


def test_rates_a_few_ppm_apart_are_one_and_others_are_refused(tmp_path: Path) -> None:
    write_records(tmp_path / "a", counts(1000, 1))
    rate = RATE * (1 + 50e-6)
    start = START + 1000 * STEP
    write_records(tmp_path / "b", counts(600, 2), rate=rate, step_ns=1e9 / rate, start=start)
    sensor = opened([tmp_path / "a", tmp_path / "b"])
    assert (sensor.sampling_rate, len(sensor.stretches)) == (RATE, 1)
    write_records(tmp_path / "c", counts(600, 2), channel="BHN", rate=40.0, step_ns=25e6)
    with pytest.raises(ImportFormatError, match=r"100 Hz in HHZ; 40 Hz in BHN; .* --channels"):
        opened([tmp_path / "a", tmp_path / "c"])
    assert opened([tmp_path / "a", tmp_path / "c"], Selection(channels=("B*",))).channels == (
        "BHN",
    )


def test_channels_sampled_between_each_other_are_resampled() -> None:
    def wave(t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.sin(2 * np.pi * 7.3 * t_s) + 0.5 * np.cos(2 * np.pi * 31.0 * t_s))

    n = np.arange(4000)
    late = 0.37 / RATE
    off = RATE * (1 + 60e-6)
    traces = [
        Trace("S", "a", START, RATE, wave(n / RATE)),
        Trace("S", "b", START + round(late * 1e9), RATE, wave(n / RATE + late)),
        Trace("S", "c", START, off, wave(n / off), end_ns=START + round(3999e9 / off)),
    ]
    (sensor,) = sensors_of_parts([ReadPart(Path("memory"), lambda _: traces)])
    (stretch,) = sensor.stretches
    assert (stretch.start_utc_ns - START) % STEP == 0
    rows = (np.arange(stretch.n_samples) * STEP + stretch.start_utc_ns - START) / 1e9
    found = whole(stretch)
    np.testing.assert_array_equal(found[:, 0], wave(rows))
    for column in (1, 2):  # the interpolation errs by less than -100 dB below 0.45 of the rate
        known = np.isfinite(found[:, column])
        assert np.max(np.abs(found[known, column] - wave(rows[known]))) < 1.5e-5
        assert np.count_nonzero(known) > 3900


def test_a_span_of_time_is_cut_to_the_sample(tmp_path: Path) -> None:
    x = counts(2000, 1)
    path = write_records(tmp_path / "a", x)
    selection = Selection(start_ns=START + 300 * STEP - 1, end_ns=START + 900 * STEP)
    (stretch,) = opened([path], selection).stretches
    np.testing.assert_array_equal(whole(stretch)[:, 0], x[300:900])
    assert stretch.start_utc_ns == START + 300 * STEP


def test_not_a_number_in_a_float_file_is_a_gap(tmp_path: Path) -> None:
    x = counts(1000, 1).astype(np.float32)
    x[417] = np.nan
    sensor = opened([write_records(tmp_path / "a", x)])
    assert sensor.first_samples() == [0, 418]
    assert [stretch.n_samples for stretch in sensor.stretches] == [417, 582]


def test_an_archive_is_read_by_codes_and_days(tmp_path: Path) -> None:
    day = 86_400_000_000_000
    monday = START // day * day
    for number in range(4):  # 2026, days 324 to 327
        for station in ("ABC", "DEF"):
            folder = tmp_path / "2026" / "XX" / station / "HHZ.D"
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"XX.{station}.00.HHZ.D.2026.{325 + number}"
            write_records(path, counts(400, number), station=station, start=monday + number * day)
    (tmp_path / "2026" / "XX" / "ABC" / "HHZ.D" / "notes.txt").write_text("not a day")
    selection = Selection(start_ns=monday + day, end_ns=monday + 3 * day, stations="A*")
    found = open_sources([f"sds://{tmp_path}"], selection)
    (sensor,) = found.sensors.values()
    assert sensor.name == "XX.ABC.00"
    starts = [stretch.start_utc_ns for stretch in sensor.stretches]
    assert starts == [monday + day, monday + 2 * day]
    with pytest.raises(ImportFormatError, match="no files found"):
        open_sources([f"sds://{tmp_path}"], Selection(networks="YY"))
    with pytest.raises(ImportFormatError, match="no such folder"):
        open_sources([f"sds://{tmp_path}/none"])


def test_an_estimate_from_files_needs_no_recording(tmp_path: Path) -> None:
    path = write_records(tmp_path / "a", counts(5000, 1))
    sensor = opened([path])
    channels = tuple(Channel(name=c, sensitivity=1.0, unit="counts") for c in sensor.channels)
    aligned = AlignedRecording(RecordingInMemory([SensorInMemory(sensor, channels)], "a"))
    samples, valid = aligned.read(0, aligned.n_available)
    assert valid.all()
    np.testing.assert_array_equal(samples[:, 0], counts(5000, 1))


def test_parts_outside_of_the_span_are_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By headers, also where a file is not in order of time; damaged parts are loaded."""
    loaded: list[int] = []
    load = MiniSeedPart.load

    def counted(part: MiniSeedPart) -> Sequence[Trace]:
        loaded.append(part.offset)
        return load(part)

    monkeypatch.setattr(miniseed, "_PART_BYTES", 4096)
    monkeypatch.setattr(MiniSeedPart, "load", counted)
    path = tmp_path / "all"
    x = counts(4000, 1)  # 20 records, 4 in a part
    write_records(path, x[2000:], start=START + 2000 * STEP)
    write_records(path, x[:2000])
    span = Selection(start_ns=START + 1300 * STEP, end_ns=START + 1700 * STEP)
    sensor = opened([path], span)
    np.testing.assert_array_equal(whole(sensor.stretches[0])[:, 0], x[1300:1700])
    assert set(loaded) == {4 * 4096}
    content = bytearray(path.read_bytes())
    content[1024:1032] = b"?" * 8
    path.write_bytes(content)
    loaded.clear()
    problems = open_sources([path], span).problems
    assert len(problems) == 1
    assert 0 in loaded


@pytest.mark.parametrize(("n_loads", "n_bytes"), [(8, 0), (4, 4 << 20)])
def test_a_cache_makes_room_for_what_is_read_together(n_loads: int, n_bytes: int) -> None:
    loads: list[str] = []
    cache = PartCache(1 << 20)
    cache.make_room(n_bytes)
    for part in 2 * large_parts("abcd", 1 << 16, loads):
        cache.traces(part)
    assert len(loads) == n_loads


def large_parts(names: Sequence[str], n_samples: int, loads: list[str]) -> list[TracePart]:
    """Return parts of so many samples, which note when they are loaded."""

    def read(path: Path) -> list[Trace]:
        loads.append(path.name)
        return [Trace("S", "a", START, RATE, np.zeros(n_samples))]

    return [ReadPart(Path(name), read) for name in names]


def test_parts_that_were_read_are_dropped_again() -> None:
    cache, loads = PartCache(8 << 20), list[str]()
    names = [str(number) for number in range(40)]
    large = large_parts(names, 1 << 17, loads)

    def load_twice() -> None:
        for part in large:
            cache.traces(part)
            cache.traces(part)

    assert peak_of(load_twice) < 10 << 20
    assert loads == names


def test_long_arrays_are_written_in_bounded_memory(tmp_path: Path) -> None:
    channels = tuple(Channel(name=name, sensitivity=1.0, unit="counts") for name in "abcdefgh")
    layout = SensorLayout(
        name="A", channels=channels, sampling_rate=2000.0, dtype=np.dtype("<i4"), clock="A"
    )
    samples = np.zeros((1 << 16, 8), np.int32)
    with ArrayWriter(tmp_path / "a.h5", sensors=[layout], created=HostTime(0, 0)) as writer:

        def write() -> None:
            for number in range(32):  # 64 MB
                writer.samples("A", samples, first_sample=number << 16, restart=number == 0)

        assert peak_of(write) < 40 << 20


def test_miniseed_without_codes_is_named_by_its_file(tmp_path: Path) -> None:
    path = write_records(tmp_path / "shake.mseed", counts(600, 1))
    content = bytearray(path.read_bytes())
    for record in range(0, len(content), 1024):
        content[record + 8 : record + 20] = b" " * 12  # station, location, channel, network
    path.write_bytes(content)
    opened = open_sources([path])
    assert (opened.problems, opened.left_aside) == ((), {})
    assert {n: each.channels for n, each in opened.sensors.items()} == {"shake": ("1",)}


def test_a_file_named_as_its_sensor_has_codes(tmp_path: Path) -> None:
    path = write_records(tmp_path / "XX.ABC.00.mseed", counts(600, 1))
    write_records(path, counts(600, 2), channel="LKM")
    opened = open_sources([path])
    assert opened.left_aside == {"XX.ABC.00.LKM": "state of health"}
