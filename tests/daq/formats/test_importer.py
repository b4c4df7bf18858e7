"""Foreign files become recordings that say the same samples at the same times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.bench.loading import parse
from daq.clocks.aligned_recording import AlignedRecording
from daq.errors import ImportFormatError, RecordingError
from daq.formats.importer import import_files
from daq.protocols.block import BlockFlag
from daq.recording.reader import Recording

SENSOR = """
[[sensors]]
name = "{name}"
driver = "epson"
port = "/dev/null"
channels = [{{name = "east", sensitivity = 2.0}}, {{name = "north", sensitivity = 4.0}}]
"""
BENCH = 'name = "lab"\nsampling_rate = 50.0\noperator = "somebody"\n' + "".join(
    SENSOR.format(name=name) for name in ("A", "B")
)


def write_npz(
    path: Path, n: int = 40_000
) -> dict[str, np.ndarray[tuple[int, int], np.dtype[np.int32]]]:
    rng = np.random.default_rng(3)
    arrays = {name: rng.integers(-(2**20), 2**20, (n, 2), np.int32) for name in ("B", "A")}
    np.savez(
        path,
        sampling_rate=50.0,
        start_time="2026-11-21T03:00:00.0005",
        A=arrays["A"],
        B=arrays["B"],
    )
    return arrays


def test_samples_times_and_bench_survive(tmp_path: Path) -> None:
    arrays = write_npz(tmp_path / "a.npz")
    bench = parse(BENCH)
    imported = import_files([tmp_path / "a.npz"], tmp_path / "a.h5", bench=bench)
    assert [(e.sensor, e.n_samples, e.n_gaps) for e in imported.sensors] == [
        ("A", 40_000, 0),
        ("B", 40_000, 0),
    ]
    with Recording.open(tmp_path / "a.h5") as recording:
        assert recording.closed
        assert recording.operator == "somebody"
        for name, counts in arrays.items():
            sensor = recording.sensor(name)
            np.testing.assert_array_equal(sensor.counts(), counts)
            assert sensor.dtype == np.dtype("<i4")
            assert [c.name for c in sensor.channels] == ["east", "north"]
            assert all(sensor.blocks["flags"] & BlockFlag.DEVICE_UTC)
            first = 1_795_230_000_000_500_000
            np.testing.assert_array_equal(
                sensor.blocks["device_counter"],
                first + sensor.blocks["first_sample"] * 20_000_000,
            )
        aligned = AlignedRecording(recording)
        samples, valid = aligned.read(0, aligned.n_available)
        assert valid.all()
        np.testing.assert_array_equal(samples[:, :2], arrays["A"] / [2.0, 4.0])


@pytest.mark.parametrize(
    ("given", "odd_one", "stored"),
    [
        ("<i2", 7, "<i2"),
        ("<i8", -(2**31), "<i4"),
        ("<i8", 2**31, "<i8"),
        ("<u4", 2**31 - 1, "<i4"),
        ("<u4", 2**31, "<u4"),
        ("<f4", 2**24, "<i4"),
        ("<f8", 2**31 - 1, "<i4"),
        ("<f8", -(2**31) - 1, "<f8"),
        ("<f8", 0.5, "<f8"),
    ],
)
def test_whole_numbers_are_stored_as_int32_where_they_fit(
    tmp_path: Path, given: str, odd_one: float, stored: str
) -> None:
    counts = np.arange(140_000).reshape(-1, 2).astype(given)
    counts[69_000, 1] = odd_one
    np.savez(tmp_path / "a.npz", sampling_rate=50.0, A=counts)
    import_files([tmp_path / "a.npz"], tmp_path / "a.h5")
    with Recording.open(tmp_path / "a.h5") as recording:
        sensor = recording.sensor("A")
        assert sensor.dtype == np.dtype(stored)
        np.testing.assert_array_equal(sensor.counts(), counts)


def test_a_gap_stays_a_gap_of_its_length(tmp_path: Path) -> None:
    rows = [f"{k / 10:.1f},{k},{-k}" for k in range(1000) if not 300 <= k < 317]
    (tmp_path / "a.csv").write_text("time,A.X [m/s],B.X [m/s]\n" + "\n".join(rows) + "\n")
    first, _ = import_files([tmp_path / "a.csv"], tmp_path / "a.h5").sensors
    assert (first.n_gaps, first.missing, first.sampling_rate) == (1, 17, 10.0)
    with Recording.open(tmp_path / "a.h5") as recording:
        (gap,) = recording.sensor("A").gaps
        assert (gap["first_sample"], gap["missing"]) == (300, 17)
        assert recording.sensor("A").channels[0].unit == "m/s"
        samples, valid = AlignedRecording(recording).read(0, 1000)
        assert np.flatnonzero(~valid).tolist() == list(range(300, 317))
        np.testing.assert_array_equal(samples[317:, 0], np.arange(317, 1000))


@pytest.mark.usefixtures("needs_obspy")
def test_a_response_assigned_to_all_channels(tmp_path: Path, usgs_recording: Path) -> None:
    write_npz(tmp_path / "a.npz", 100)
    response = usgs_recording / "T-compact_Q330HR_BH_40"
    with pytest.raises(ImportFormatError, match=r"--response-for 'A\.1=.*{'A\.1': '.*T-com"):
        import_files([tmp_path / "a.npz"], tmp_path / "a.h5", response=response)
    result = import_files([tmp_path / "a.npz"], tmp_path / "a.h5", response_for=[("*", response)])
    with Recording.open(tmp_path / "a.h5") as recording:
        channels = [channel for sensor in recording.sensors for channel in sensor.channels]
    assert len(channels) == 4
    for channel in channels:
        assert channel.sensitivity == pytest.approx(754.3 * 2**26 / 40, rel=1e-6)
        assert channel.unit == "m/s"
        assert channel.response is not None
        assert np.abs(channel.response.at(np.array([1.0]))) == pytest.approx(1.0, abs=1e-6)
        assert channel.response.described == "11 poles, 6 zeros"
    assert {each.origin for each in result.calibrations} == {"response"}
    assert "11 poles, 6 zeros" in result.calibrations[0].notes


def test_stationxml_gives_each_channel_its_own(tmp_path: Path) -> None:
    obspy = pytest.importorskip("obspy", reason="ObsPy is an extra")
    inventory = obspy.core.inventory
    channels = []
    for number, code in enumerate("XY", start=1):
        response = inventory.Response.from_paz(
            zeros=[0.0],
            poles=[-1.0 + 1.0j, -1.0 - 1.0j],
            stage_gain=100.0 * number,
            normalization_factor=abs(2j * np.pi + 1 + 1j) * abs(2j * np.pi + 1 - 1j) / (2 * np.pi),
            input_units="M/S**2",
            output_units="COUNTS",
        )
        channels.append(
            inventory.Channel(code, "00", 0.0, 0.0, 0.0, 0.0, response=response, sample_rate=50.0)
        )
    station = inventory.Station("ABC", 0.0, 0.0, 0.0, channels=channels)
    network = inventory.Network("XX", stations=[station])
    path = tmp_path / "station.xml"
    inventory.Inventory(networks=[network], source="test").write(str(path), format="STATIONXML")
    samples = "\n".join(f"{k},{k}" for k in range(100))
    (tmp_path / "a.csv").write_text(f"XX.ABC.00.X,XX.ABC.00.Y\n{samples}\n")

    import_files([tmp_path / "a.csv"], tmp_path / "a.h5", response=path, sampling_rate=50.0)

    with Recording.open(tmp_path / "a.h5") as recording:
        (sensor,) = recording.sensors
    assert [c.sensitivity for c in sensor.channels] == pytest.approx([100.0, 200.0])
    assert {c.unit for c in sensor.channels} == {"m/s²"}

    (tmp_path / "b.csv").write_text(f"other.X,other.Y\n{samples}\n")
    with pytest.raises(
        ImportFormatError, match=r"no response for other\.X; --response gives XX\.ABC\.00\.X"
    ):
        import_files([tmp_path / "b.csv"], tmp_path / "b.h5", response=path, sampling_rate=50.0)
    assert not (tmp_path / "b.h5").exists()


def test_what_does_not_fit_is_said_and_leaves_no_file(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", 10)
    np.savez(tmp_path / "b.npz", sampling_rate=50.0, A=np.arange(20).reshape(10, 2))
    np.savez(tmp_path / "c.npz", sampling_rate=50.0, A=np.ones((10, 2)))
    out = tmp_path / "a.h5"
    bench = parse(BENCH.replace('"B"', '"C"'))
    with pytest.raises(ImportFormatError, match="the bench file has the sensors A, C"):
        import_files([tmp_path / "a.npz"], out, bench=bench)
    with pytest.raises(ImportFormatError, match="expected each sensor once"):
        import_files([tmp_path / "b.npz", tmp_path / "c.npz"], out)
    with pytest.raises(ImportFormatError, match="no such file"):
        import_files([tmp_path / "d.npz"], out)
    with pytest.raises(ImportFormatError, match="expected a RESP, StationXML"):
        import_files([tmp_path / "a.npz"], out, response=tmp_path / "a.npz")
    assert not out.exists()
    import_files([tmp_path / "a.npz"], out)
    with pytest.raises(RecordingError, match="exists already"):
        import_files([tmp_path / "a.npz"], out)
    assert out.exists()


def test_samples_in_units_already_are_not_scaled_by_a_bench_in_counts(tmp_path: Path) -> None:
    bench = parse(BENCH)
    unit = bench.sensors[0].channels[0].unit
    header = ",".join(f"{s}.{c} ({unit})" for s in "AB" for c in ("east", "north"))
    path = tmp_path / "a.csv"
    path.write_text(f"{header}\n1,2,3,4\n5,6,7,8\n", encoding="utf-8")
    with pytest.raises(ImportFormatError, match="scale it again"):
        import_files([path], tmp_path / "a.h5", bench=bench, sampling_rate=50.0)
