"""``huddle export``: what was written is read by programs that are not ours."""

from __future__ import annotations

import csv
import functools
import hashlib
import importlib
import io
import json
import os
import shutil
import zlib
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import numpy as np
import pytest
import pyuff
import xarray as xr
from numcodecs import blosc
from scipy.io import loadmat
from typer.testing import CliRunner, Result

import huddle
from daq.estimation.snapshot import Snapshot
from daq.formats.importer import import_files
from daq.formats.miniseed_export import export_miniseed
from daq.recording.reader import Recording
from estimator.self_noise.result import SelfNoise
from tests import command
from tests.daq.clocks.recordings import ORIGIN, Sensor, blocks, create
from tests.daq.formats.test_sources import START, STEP, counts, write_records
from tests.tui.demo_bench import DEMO
from tui.commands.main import app
from tui.output.exit_codes import ExitCode

BENCH = """
name = "lab"
sampling_rate = 100.0
""" + "".join(
    f"""
[[sensors]]
name = "{name}"
driver = "epson"
port = "/dev/null"
channels = [{{name = "X", sensitivity = 400.0}}, {{name = "Y", sensitivity = 500.0}}]
"""
    for name in ("front left", "rear", "B3")
)


@pytest.fixture
def obspy() -> ModuleType:
    module: ModuleType = pytest.importorskip("obspy", reason="ObsPy is an extra")
    return module


def export_to(folder: Path) -> Path:
    """Write the recording of a folder as miniSEED and StationXML."""
    with Recording.open(folder / "a.h5") as opened:
        export_miniseed(opened, folder / "a.mseed", folder / "a.xml")
    return folder / "a.mseed"


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


@pytest.fixture
def zarr_threads() -> Iterator[None]:
    """End the threads that zarr leaves running."""
    sync = pytest.importorskip("zarr.core.sync")
    yield
    sync.cleanup_resources()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sensors with two channels on one motion, in m/s²."""
    from daq.bench.loading import parse  # noqa: PLC0415 - of this fixture

    folder = tmp_path_factory.mktemp("export")
    rng = np.random.default_rng(8)
    motion = 1e4 * rng.normal(size=(8000, 2))
    arrays = {
        name: np.round(motion + 100 * rng.normal(size=motion.shape)).astype(np.int32)
        for name in ("front left", "rear", "B3")
    }
    source = folder / "a.npz"
    np.savez(source, sampling_rate=100.0, start_time="2026-11-21T03:00:00.000007", **arrays)  # type: ignore[arg-type]  # arrays
    import_files([source], folder / "a.h5", bench=parse(BENCH))
    return folder / "a.h5"


@pytest.fixture(scope="module")
def made(recording: Path) -> huddle.Result:
    return huddle.estimate(recording, segment="5s")


@pytest.fixture(scope="module")
def snapshot(made: huddle.Result) -> Snapshot:
    return made.snapshot


@pytest.fixture(scope="module")
def noise(snapshot: Snapshot) -> SelfNoise:
    (found,) = snapshot.results.values()
    return found


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulate sensors with a limit."""
    folder = tmp_path_factory.mktemp("simulated")
    text = DEMO.replace("sampling_rate = 200.0", "sampling_rate = 50.0")
    text += '[[limits]]\nname = "low"\nfrequency = [4.0, 18.0]\npsd = [1e-15, 1e-15]\n'
    (folder / "bench.toml").write_text(text, encoding="utf-8")
    options = (folder / "bench.toml", "--duration", "40s", "--out", folder / "s.h5")
    command.huddle("simulate", *options)
    return folder / "s.h5"


@pytest.fixture(scope="module")
def exported(
    recording: Path, simulated: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """Return what exports a kind of file once, for tests that only read.

    First it has what simulated sensors measured, and then what takes its place.
    """
    of_simulated = huddle.estimate(simulated, segment="5s")

    @functools.cache
    def export(kind: str) -> Path:
        path = tmp_path_factory.mktemp(kind) / f"a.{kind}"
        for is_simulated in (True, False):
            if is_simulated:
                huddle.export(of_simulated, path, kind=kind)
            else:
                command.huddle("export", recording, "--format", kind, "-o", path, "--segment", "5s")
            if kind == "uff58":
                notes = {each["id5"].strip() for each in pyuff.UFF(str(path)).read_sets()}
                assert notes == {"SIMULATED SENSORS" if is_simulated else "NONE"}
                continue
            said = said_by_file(path, kind)
            found = said["simulated"], said["verdict"]
            assert found == (("true", "not-decided") if is_simulated else ("false", "none"))
        return path

    return export


@pytest.fixture
def copy(exported: Callable[[str], Path], tmp_path: Path) -> Callable[[str], Path]:
    """Return what gives a copy of an exported file, for tests that change it."""

    def copied(kind: str) -> Path:
        whole = exported(kind).parent
        return shutil.copytree(whole, tmp_path / "copy") / f"a.{kind}"

    return copied


def test_miniseed_and_back_in_obspy(obspy: ModuleType, tmp_path: Path) -> None:
    x = counts(5000, 1)
    for first, end in ((0, 2000), (2017, 5000)):
        start = START + 123_000 + first * STEP
        write_records(tmp_path / "a", x[first:end], start=start)
        write_records(tmp_path / "a", x[first:end] + 1, channel="HHN", start=start)
    import_files([tmp_path / "a"], tmp_path / "a.h5")
    assert run(tmp_path / "a.h5", "--format", "mseed").exit_code == ExitCode.DONE
    ours = obspy.read(str(tmp_path / "a.mseed"), format="MSEED")
    theirs = obspy.read(str(tmp_path / "a"), format="MSEED")
    for stream in (ours, theirs):
        stream.merge(method=-1).sort()
    assert [trace.id for trace in ours] == [trace.id for trace in theirs]
    assert len(ours) == 4
    for our, their in zip(ours, theirs, strict=True):
        assert (our.stats.starttime, our.stats.endtime) == (
            their.stats.starttime,
            their.stats.endtime,
        )
        np.testing.assert_array_equal(our.data, their.data)
    gaps = [(*gap[:6], round(gap[6], 6)) for gap in ours.get_gaps()]
    assert gaps == [(*gap[:6], round(gap[6], 6)) for gap in theirs.get_gaps()]
    inventory = obspy.read_inventory(str(tmp_path / "a.xml"), format="STATIONXML")
    assert sorted(inventory.get_contents()["channels"]) == sorted({trace.id for trace in ours})


def test_miniseed_of_any_recording_has_codes_and_responses(
    obspy: ModuleType, recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "b.mseed"
    found = run(recording, "--format", "mseed", "-o", out, "--json", "-")
    document = json.loads(found.stdout)
    assert document["codes"]["front left.X"] == {
        "network": "XX",
        "station": "FRONT",
        "location": "",
        "channel": "HNX",
    }
    stream = obspy.read(str(out), format="MSEED")
    assert sorted(trace.id for trace in stream) == sorted(
        f"XX.{station}..HN{axis}" for station in ("FRONT", "REAR", "B3") for axis in "XY"
    )
    assert {trace.stats.starttime.ns for trace in stream} == {START + 7000}
    inventory = obspy.read_inventory(document["stationxml"], format="STATIONXML")
    response = inventory.get_response("XX.REAR..HNY", stream[0].stats.starttime)
    assert response.instrument_sensitivity.value == 500.0
    stream.select(station="REAR", channel="HNY").remove_sensitivity(inventory)
    with Recording.open(recording) as opened:
        samples = opened.sensor("rear").counts()[:, 1] / 500.0
    (trace,) = stream.select(station="REAR", channel="HNY")
    np.testing.assert_allclose(trace.data, samples, rtol=1e-12)
    assert run(recording, "--format", "mseed", "--start", "1s").exit_code == ExitCode.USAGE
    assert run(recording, "--format", "sac").exit_code == ExitCode.USAGE


@pytest.mark.parametrize("dtype", ["f4", "f8", "i8"])
def test_miniseed_of_any_type_of_sample_is_read_as_it_was(
    obspy: ModuleType, tmp_path: Path, dtype: str
) -> None:
    """HDF5 states the order of bytes of floats, which ObsPy took for the other one."""
    samples = (1e10 * np.random.default_rng(4).normal(size=(6000, 2))).astype(dtype)
    np.savez(tmp_path / "a.npz", sampling_rate=100.0, A=samples)
    import_files([tmp_path / "a.npz"], tmp_path / "a.h5")
    stream = obspy.read(str(export_to(tmp_path)), format="MSEED").merge(method=-1).sort()
    np.testing.assert_array_equal(np.column_stack([trace.data for trace in stream]), samples)


@pytest.mark.parametrize("states_utc", [True, pytest.param(False, marks=pytest.mark.long)])
def test_miniseed_of_a_clock_off_its_rate_is_on_time(
    obspy: ModuleType, tmp_path: Path, *, states_utc: bool
) -> None:
    rate, n = 100 * (1 + 80e-6), 8 * 4100
    sensor = Sensor(
        np.arange(n, dtype=np.int32)[:, None] % 9973, rate=rate, nominal=100.0, utc=states_utc
    )
    writer = create(tmp_path / "a.h5", {"a": sensor})
    for block in blocks("a", sensor, block=41.0):
        writer.append(block)
    writer.close()
    content = export_to(tmp_path).read_bytes()
    late, first = [], 0
    for at in range(0, len(content), 512):  # a reader joins records; each states its time
        (record,) = obspy.read(io.BytesIO(content[at : at + 512]), format="MSEED")
        index = first + np.arange(record.stats.npts)
        np.testing.assert_array_equal(record.data, index % 9973)
        stated = (record.stats.starttime.ns - ORIGIN.utc_ns) / 1e9 + (index - first) / 100
        late.append(stated - index / rate)
        first += record.stats.npts
    assert first == n
    error = np.concatenate(late)
    if states_utc:
        assert np.max(np.abs(error)) <= 0.005 / 100 + 1e-6
    assert np.ptp(error) <= 0.005 / 100 + 2e-6  # times of miniSEED are whole microseconds


def test_public_recording_through_import_and_export(
    obspy: ModuleType, tmp_path: Path, usgs_recording: Path
) -> None:
    sources = sorted(usgs_recording.glob("TST5_*_BH0.mseed"))
    resp = usgs_recording / "T-compact_Q330HR_BH_40"
    import_files(sources, tmp_path / "a.h5", response_for=[("*", resp)])
    assert run(tmp_path / "a.h5", "--format", "mseed").exit_code == ExitCode.DONE
    ours = obspy.read(str(tmp_path / "a.mseed"), format="MSEED").merge(method=-1)
    theirs = obspy.Stream()
    for source in sources:
        theirs += obspy.read(str(source), format="MSEED")
    for their in theirs.merge(method=-1):
        (our,) = ours.select(id=their.id)
        assert our.stats.starttime == their.stats.starttime
        np.testing.assert_array_equal(our.data, their.data)
    frequency = np.geomspace(0.005, 16.0, 60)
    our_xml = obspy.read_inventory(str(tmp_path / "a.xml"), format="STATIONXML")
    exported = our_xml.get_response(ours[0].id, ours[0].stats.starttime)
    original = obspy.read_inventory(str(resp), format="RESP")[0][0][0].response
    curves = [
        np.abs(each.get_evalresp_response_for_frequencies(frequency, output="VEL"))
        for each in (exported, original)
    ]
    assert np.max(np.abs(20 * np.log10(curves[0] / curves[1]))) < 0.01


@pytest.mark.parametrize(
    "name",
    [
        "BW.BGLD.__.EHE.D.2008.001.first_10_records",
        "CH.BALST..LHE.D.2025.314",
        "gaps.mseed",
        "qualityflags.mseed",
        "two_channels.mseed",
        "WUQ.XJ.HHN.D.2008.285.first_record",
    ],
)
def test_files_of_networks_through_import_and_export(
    obspy: ModuleType, tmp_path: Path, name: str
) -> None:
    source = Path(str(obspy.__file__)).parent / "io/mseed/tests/data" / name
    import_files([source], tmp_path / "a.h5")
    ours = obspy.read(str(export_to(tmp_path)), format="MSEED").merge(method=-1).sort()
    theirs = obspy.read(str(source), format="MSEED").merge(method=-1).sort()
    assert [trace.id for trace in ours] == [trace.id for trace in theirs]
    for our, their in zip(ours, theirs, strict=True):
        assert abs(our.stats.starttime.ns - their.stats.starttime.ns) <= 1000
        np.testing.assert_array_equal(our.data, their.data)


def test_tidy_csv(exported: Callable[[str], Path], snapshot: Snapshot, noise: SelfNoise) -> None:
    with exported("csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["sensor"] == "rear"]
    assert {row["method"] for row in rows} == {"three-sensor"}
    assert {row["unit"] for row in rows} == {"m/s²"}
    found = [float(row["noise_psd"]) for row in rows if row["channel"] == "Y" and row["noise_psd"]]
    column = [(label.sensor, label.channel) for label in snapshot.channels].index(("rear", "Y"))
    flags = [int(row["flags"]) for row in rows if row["channel"] == "Y"]
    assert flags == noise.flags[:, column].tolist()
    expected = noise.noise_psd[:, column]
    np.testing.assert_array_equal(found, expected[np.isfinite(expected)])


def test_netcdf(exported: Callable[[str], Path], noise: SelfNoise) -> None:
    with xr.open_dataset(exported("netcdf"), engine="h5netcdf") as found:
        rear = found["noise_psd"].sel(estimate="three-sensor", trace="rear.X")
        np.testing.assert_array_equal(rear, noise.noise_psd[:, 2])
        assert found["noise_psd"].attrs["units"] == "(m s-2)2 Hz-1"


@pytest.mark.usefixtures("zarr_threads")
def test_zarr(
    exported: Callable[[str], Path], made: huddle.Result, noise: SelfNoise, tmp_path: Path
) -> None:
    found = huddle.load(exported("zarr"))
    rear = found["noise_psd"].sel(estimate="three-sensor", trace="rear.X")
    np.testing.assert_array_equal(rear, noise.noise_psd[:, 2])
    np.testing.assert_array_equal(found["flags"][0].T, noise.flags)
    assert found["noise_psd"].attrs["units"] == "(m s-2)2 Hz-1"
    own = tmp_path / "mine.zarr"
    (own / "thesis").mkdir(parents=True)
    with pytest.raises(OSError, match="mine"):
        made.save(own)
    assert [each.name for each in own.iterdir()] == ["thesis"]


def _of_pickle(folder: Path, about: dict[str, Any]) -> None:
    del folder
    about["filters"] = [{"id": "pickle", "protocol": 4}]


def _of_another_packer(folder: Path, about: dict[str, Any]) -> None:
    del folder
    about["compressor"] = {"id": "bz2", "level": 1}


def _of_huge_shape(folder: Path, about: dict[str, Any]) -> None:
    del folder
    about["shape"] = [1 << 20] * 3


def _of_a_bomb(folder: Path, about: dict[str, Any]) -> None:
    del about
    chunk = next(each for each in (folder / "noise_psd").iterdir() if each.name[0] != ".")
    chunk.write_bytes(blosc.compress(bytes(1 << 24), b"zstd", 5))


@pytest.mark.usefixtures("zarr_threads")
@pytest.mark.parametrize("forged", [_of_pickle, _of_another_packer, _of_huge_shape, _of_a_bomb])
def test_zarr_from_elsewhere_is_checked_before_it_is_inflated(
    copy: Callable[[str], Path], forged: Callable[[Path, dict[str, Any]], None]
) -> None:
    out = copy("zarr")
    described = json.loads((out / ".zmetadata").read_text(encoding="utf-8"))
    forged(out, described["metadata"]["noise_psd/.zarray"])
    (out / ".zmetadata").write_text(json.dumps(described), encoding="utf-8")
    with pytest.raises(OSError, match=r"a\.zarr: no netCDF or Zarr of huddle .*noise_psd"):
        huddle.load(out)


@pytest.mark.usefixtures("zarr_threads")
def test_texts_of_zarr_are_no_more_than_they_hold(copy: Callable[[str], Path]) -> None:
    out = copy("zarr")
    (out / "channel" / "0").write_bytes(blosc.compress(bytes([0, 0, 0, 40, *range(9)]), b"lz4", 5))
    with pytest.raises(OSError, match=r"channel/0: more than \d+ texts"):
        huddle.load(out)


def test_netcdf_from_elsewhere_is_checked_before_it_is_inflated(
    copy: Callable[[str], Path],
) -> None:
    out = copy("netcdf")
    huddle.load(out)
    with h5py.File(out, "r+") as file:
        made = file.create_dataset("x", (9,), "f8", chunks=(9,), compression="gzip")
        made.id.write_direct_chunk((0,), zlib.compress(bytes(1 << 24)))
    with pytest.raises(OSError, match="a chunk of 72 bytes inflates to more"):
        huddle.load(out)
    with h5py.File(out, "r+") as file:
        del file["x"]
        file["x"] = h5py.ExternalLink("other.nc", "/x")
    with pytest.raises(OSError, match="a link"):
        huddle.load(out)


def test_load_says_what_reads_other_files(recording: Path, tmp_path: Path) -> None:
    (other := tmp_path / "a.toml").write_text("")
    for path in (recording, other):
        with pytest.raises(OSError, match=rf"{path.name}: no netCDF.*recording: huddle\.open"):
            huddle.load(path)
    with pytest.raises(FileNotFoundError, match=r"No such file or directory: .*a\.nc"):
        huddle.load(tmp_path / "a.nc")


def test_mat_and_numpy(
    exported: Callable[[str], Path], snapshot: Snapshot, noise: SelfNoise
) -> None:
    matlab = loadmat(exported("mat"))
    with np.load(exported("npz"), allow_pickle=False) as numpy:
        assert numpy["sensors"].tolist() == [label.sensor for label in snapshot.channels]
        for name, expected in (
            ("data_psd", snapshot.data_psd),
            ("three_sensor_noise_low", noise.low),
            ("three_sensor_flags", noise.flags),
        ):
            np.testing.assert_array_equal(numpy[name], expected)
            np.testing.assert_array_equal(matlab[name], expected)
    assert [cell[0].item() for cell in matlab["units"]] == ["(m/s²)²/Hz"] * 6


def test_universal_file(
    exported: Callable[[str], Path], snapshot: Snapshot, noise: SelfNoise
) -> None:
    sets = pyuff.UFF(str(exported("uff58"))).read_sets()
    assert {each["func_type"] for each in sets} == {9}
    (found,) = [each for each in sets if each["id1"].strip() == "rear.Y three-sensor noise_psd"]
    assert (found["rsp_node"], found["rsp_dir"], found["rsp_ent_name"].strip()) == (2, 2, "rear")
    np.testing.assert_array_equal(found["data"], noise.noise_psd[2:, 3])
    np.testing.assert_allclose(found["x"], snapshot.frequency[2:], rtol=1e-5)


def test_parquet(exported: Callable[[str], Path], noise: SelfNoise) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is large, and an extra")
    table = parquet.read_table(exported("parquet")).to_pydict()
    rows = zip(table["noise_psd"], table["sensor"], table["channel"], strict=True)
    found = [psd for psd, *channel in rows if channel == ["B3", "X"]]
    np.testing.assert_array_equal(found, noise.noise_psd[:, 4])
    assert set(table["unit"]) == {"m/s²"}


def said_by_file(path: Path, kind: str) -> dict[str, str]:
    """Return what a file says of what made it, read by a program that is not ours."""
    if kind == "csv":
        metadata = json.loads(Path(f"{path}-metadata.json").read_text(encoding="utf-8"))
        assert metadata["url"] == path.name
        return dict(metadata["notes"][0])
    if kind in ("netcdf", "zarr"):
        with xr.open_dataset(path, engine="zarr" if kind == "zarr" else "h5netcdf") as found:
            assert found.attrs["Conventions"] == "CF-1.11"
            meanings = found["flags"].attrs["flag_meanings"].split()
            masks = np.asarray(found["flags"].attrs["flag_masks"]).tolist()
            assert found.attrs["history"]
            assert "_FillValue" not in found["frequency"].encoding
            assert dict(zip(meanings, masks, strict=True))["dead_channel"] == 4
            return dict(found.attrs)
    if kind == "mat":
        arrays = {key: np.asarray(value) for key, value in loadmat(path).items()}
        return {key: str(value[0]) for key, value in arrays.items() if value.shape == (1,)}
    if kind == "npz":
        with np.load(path, allow_pickle=False) as found:
            return {key: str(found[key]) for key in found if found[key].shape == ()}
    parquet = importlib.import_module("pyarrow.parquet")
    metadata = parquet.read_schema(path).metadata
    return {key.decode(): value.decode() for key, value in metadata.items()}


@pytest.mark.usefixtures("zarr_threads")
@pytest.mark.parametrize("kind", ["csv", "netcdf", "zarr", "mat", "npz", "parquet"])
def test_every_export_says_what_made_it(
    recording: Path, exported: Callable[[str], Path], made: huddle.Result, kind: str
) -> None:
    if kind == "parquet":
        pytest.importorskip("pyarrow", reason="pyarrow is large, and an extra")
    said = said_by_file(exported(kind), kind)
    (source,) = json.loads(said["recordings"])
    assert source["sha256"] == hashlib.sha256(recording.read_bytes()).hexdigest()
    assert source["file"] == "a.h5"
    assert json.loads(said["settings"])["segment"] == 5.0
    assert said["source"] == f"huddle-bench {version('huddle-bench')}"
    assert said["time_coverage_start"] == "2026-11-21T03:00:00.000007000Z"
    assert said["time_coverage_end"].startswith("2026-11-21T03:01:20")
    assert said["confidence_of_intervals"] == "0.95"
    assert said["unit_of_densities"] == "(m/s²)²/Hz"
    kinds = [(each["kind"], each["line"]) for each in json.loads(said["facts"])]
    assert kinds == [(each.name, each.words.line) for each in made.result.all_facts]
    assert json.loads(said["flags"])["dead_channel"] == 4


def test_a_table_of_an_estimate_says_whether_sensors_were_simulated(
    recording: Path, simulated: Path, tmp_path: Path
) -> None:
    for source, code, said in ((simulated, 4, "true"), (recording, 0, "false")):
        path = tmp_path / f"{source.stem}.csv"
        command.huddle("estimate", source, "--segment", "5s", "--csv", path, code=code)
        assert said_by_file(path, "csv")["simulated"] == said


def test_a_table_on_standard_output_leaves_no_metadata(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for place in ("-", os.devnull):
        options = ["estimate", str(recording), "--segment", "5s", "--csv", place]
        command.huddle(*options)
    assert not list(tmp_path.iterdir())
    assert not Path(f"{os.devnull}-metadata.json").exists()
