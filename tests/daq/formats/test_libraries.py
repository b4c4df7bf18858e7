"""Formats that other libraries keep: files that those libraries wrote, or have for their tests."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import nptdms
import numpy as np
import pytest
import pyuff
import scipy.io
from numpy.typing import NDArray
from scipy.io import wavfile

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import ForeignSensor
from daq.formats.importer import import_files
from daq.formats.sources import open_sources
from daq.recording.reader import Recording

START = "2026-11-21T03:00:00.25"
START_NS = 1_795_230_000_250_000_000


@pytest.fixture
def obspy() -> ModuleType:
    """Return ObsPy, which has no wheels for some machines."""
    found: ModuleType = pytest.importorskip("obspy", reason="ObsPy is an extra")
    return found


def counts(n: int, columns: int = 1, seed: int = 4) -> NDArray[np.int32]:
    return np.random.default_rng(seed).integers(-30_000, 30_000, (n, columns), dtype=np.int32)


def opened(path: Path) -> dict[str, ForeignSensor]:
    found = open_sources([path])
    assert found.problems == ()
    return found.sensors


def whole(sensor: ForeignSensor) -> NDArray[Any]:
    (stretch,) = sensor.stretches
    return stretch.counts[0 : stretch.n_samples]


@pytest.mark.parametrize(("name", "code"), [("SAC", "HHZ"), ("GSE2", "HHZ"), ("GCF", "HHZ")])
def test_seismological_formats_of_obspy(
    obspy: ModuleType, tmp_path: Path, name: str, code: str
) -> None:
    path = tmp_path / f"a.{name.lower()}"
    start = "2026-11-21T03:00:00" if name == "GCF" else START
    header = {"station": "ABC", "channel": code, "sampling_rate": 100.0}
    samples = counts(2000)[:, 0]
    trace = obspy.Trace(samples, {**header, "starttime": obspy.UTCDateTime(start)})
    trace.write(str(path), format=name)
    (sensor,) = opened(path).values()
    assert sensor.sampling_rate == 100.0
    np.testing.assert_array_equal(whole(sensor)[:, 0], samples)
    assert sensor.stretches[0].start_utc_ns == obspy.UTCDateTime(start).ns
    assert "ABC" in sensor.name


@pytest.mark.filterwarnings("ignore")  # ObsPy's, about its own files
@pytest.mark.parametrize(
    ("path", "n_sensors"),
    [
        ("gcf/tests/data/20160603_1910n.gcf", 1),
        ("gse2/tests/data/loc_RJOB20050831023349.z", 1),
        ("sac/tests/data/test.sac", 1),
        ("seg2/tests/data/20180307_031245000.0.seg2", 1),
        ("segy/tests/data/00001034.sgy_first_trace", 1),
    ],
)
def test_files_that_obspy_provides(obspy: ModuleType, path: str, n_sensors: int) -> None:
    file = Path(str(obspy.__file__)).parent / "io" / path
    expected = obspy.read(str(file))
    sensors = opened(file)
    assert len(sensors) == n_sensors
    for sensor, trace in zip(sensors.values(), expected, strict=False):
        np.testing.assert_array_equal(whole(sensor)[:, 0], trace.data)
        assert sensor.sampling_rate == trace.stats.sampling_rate
        assert sensor.stretches[0].start_utc_ns == trace.stats.starttime.ns


@pytest.mark.parametrize("order", ["<", ">"])
def test_sac_with_logicals_of_minus_one(obspy: ModuleType, tmp_path: Path, order: str) -> None:
    trace = obspy.Trace(counts(300, 1)[:, 0].astype(np.float32), {"sampling_rate": 50.0})
    path = tmp_path / "a.sac"
    trace.write(str(path), format="SAC", byteorder=order)
    content = bytearray(path.read_bytes())
    for at in (4 * 105, 4 * 107):  # LEVEN, LOVROK
        content[at : at + 4] = struct.pack(f"{order}i", -1)
    path.write_bytes(content)
    (sensor,) = opened(path).values()
    assert sensor.sampling_rate == 50.0
    np.testing.assert_array_equal(whole(sensor)[:, 0], trace.data)


def test_texts_of_data_centres_have_any_name(obspy: ModuleType, tmp_path: Path) -> None:
    samples = counts(300, 1)[:, 0].astype(np.int32)
    header = {"network": "AM", "station": "R1A2B", "location": "00", "channel": "ENZ"}
    trace = obspy.Trace(samples, {**header, "sampling_rate": 100.0})
    for kind in ("TSPAIR", "SLIST"):
        path = tmp_path / f"{kind}.csv"
        trace.write(str(path), format=kind)
        sensor = opened(path)["AM.R1A2B.00"]
        assert (sensor.channels, sensor.sampling_rate) == (("ENZ",), 100.0)
        np.testing.assert_array_equal(whole(sensor)[:, 0], samples)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("sheet.xlsx", b"PK\x03\x04...", r"a spreadsheet.*: huddle import sheet\.csv"),
        ("a.parquet", b"PAR1...", r"to_csv\), then: huddle import a\.csv --out"),
        ("b.h5", b"\x89HDF...", r"numpy\.savez, then: huddle import b\.npz --out"),
        ("SACPZ.X", b"* INPUT UNIT: M\nZEROS 0\nPOLES 0\nCONSTANT 1\n", "give it with --response"),
    ],
)
def test_what_is_not_read_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: bytes, said: str
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "obspy", None)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ImportFormatError, match=said):
        open_sources([tmp_path / name])


@pytest.mark.filterwarnings("ignore")  # ObsPy's, about headers that it makes
def test_segy_traces_are_sensors(obspy: ModuleType, tmp_path: Path) -> None:
    samples = counts(500, 3).astype(np.float32)
    stream = obspy.Stream([obspy.Trace(np.ascontiguousarray(c)) for c in samples.T])
    for trace in stream:
        trace.stats.sampling_rate = 500.0
        trace.stats.starttime = obspy.UTCDateTime("2026-11-21T03:00:00")
    stream.write(str(tmp_path / "a.sgy"), format="SEGY", data_encoding=5)
    sensors = opened(tmp_path / "a.sgy")
    assert [(s.name, s.channels, s.sampling_rate) for s in sensors.values()] == [
        (str(number), ("1",), 500.0) for number in (1, 2, 3)
    ]
    np.testing.assert_array_equal(np.hstack([whole(s) for s in sensors.values()]), samples)


def prepared_58(**given: object) -> dict[str, object]:
    """Complete a function as the documentation of pyuff does."""
    others = {
        **dict.fromkeys(("orddenom_spec_data_type", "z_axis_spec_data_type"), 0),
        "binary": 1,
        "ordinate_spec_data_type": 12,
        "abscissa_spec_data_type": 17,
    }
    return dict(pyuff.prepare_58(**others, **given))


@pytest.mark.filterwarnings("ignore")  # pyuff leaves a damaged file open
def test_time_responses_of_a_universal_file(tmp_path: Path) -> None:
    samples = counts(1000, 4) / 1000
    path = tmp_path / "a.uff"
    responses = [(7, 1), (7, -3), (12, 1), (12, 3)]
    for (node, direction), column in zip(responses, samples.T, strict=True):
        pyuff.UFF(str(path)).write_sets(
            prepared_58(
                func_type=1,
                id3="21-NOV-26 03:00:00",
                rsp_node=node,
                rsp_dir=direction,
                ref_node=1,
                ref_dir=3,
                data=column,
                x=np.arange(1000) / 512,
                abscissa_inc=1 / 512,
                abscissa_spacing=1,
                ordinate_axis_units_lab="m/s^2",
            ),
            "add",
        )
    others = {"rsp_dir": 1, "ref_node": 1, "ref_dir": 3, "abscissa_inc": 1.0, "abscissa_spacing": 1}
    spectrum = prepared_58(
        func_type=9, rsp_node=7, data=samples[:, 0], x=np.arange(1000.0), **others
    )
    pyuff.UFF(str(path)).write_sets(spectrum, "add")
    sensors = opened(path)
    assert {name: s.channels for name, s in sensors.items()} == {"7": ("X", "-Z"), "12": ("X", "Z")}
    assert {s.stretches[0].start_utc_ns for s in sensors.values()} == {1_795_230_000_000_000_000}
    np.testing.assert_allclose(
        np.hstack([whole(s) for s in sensors.values()]), samples, rtol=1e-6, atol=1e-9
    )
    import_files([path], tmp_path / "a.h5")
    with Recording.open(tmp_path / "a.h5") as recording:
        assert recording.sensors[0].sampling_rate == 512.0
        assert recording.sensors[0].channels[0].unit == "m/s²"
    (tmp_path / "b.uff").write_text("    -1\n    58\n")
    with pytest.raises(ImportFormatError, match=r"b\.uff"):
        open_sources([tmp_path / "b.uff"])


def test_groups_of_tdms(tmp_path: Path) -> None:
    samples = counts(300_000, 3)
    properties = {
        "wf_start_time": np.datetime64(START, "us"),
        "wf_increment": 1e-3,
        "unit_string": "g",
    }
    path = tmp_path / "a.tdms"
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject(sensor, channel, samples[:, column], properties)
                for column, (sensor, channel) in enumerate(
                    [("A/1", "x"), ("A/1", "ai/1"), ("B", "x")]
                )
            ]
        )
    sensors = opened(path)
    assert {name: (s.channels, s.units) for name, s in sensors.items()} == {
        "A_1": (("x", "ai_1"), ("g", "g")),
        "B": (("x",), ("g",)),
    }
    for sensor in sensors.values():  # of several parts
        assert (sensor.sampling_rate, sensor.stretches[0].start_utc_ns) == (1000.0, START_NS)
    np.testing.assert_array_equal(np.hstack([whole(s) for s in sensors.values()]), samples)
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([nptdms.ChannelObject("A", "x", samples[:, 0])])
    with pytest.raises(ImportFormatError, match=r"no wf_increment.*--sampling-rate"):
        open_sources([path])
    assert open_sources([path], sampling_rate=50.0).sensors["A"].sampling_rate == 50.0
    path.write_bytes(b"TDSm")
    with pytest.raises(ImportFormatError, match=r"a\.tdms: "):
        open_sources([path])


@pytest.mark.parametrize("dtype", ["uint8", "int16", "int32", "float32"])
def test_wav(tmp_path: Path, dtype: str) -> None:
    samples = counts(800, 3)
    written = (samples % 256 if dtype == "uint8" else samples).astype(dtype)
    wavfile.write(tmp_path / "A.wav", 8000, written)
    (sensor,) = opened(tmp_path / "A.wav").values()
    assert (sensor.name, sensor.channels, sensor.sampling_rate) == ("A", ("1", "2", "3"), 8000.0)
    zero = 128 if dtype == "uint8" else 0
    np.testing.assert_array_equal(whole(sensor), written.astype(np.float64) - zero)


def write_mat73(path: Path, **arrays: object) -> None:
    """Write as MATLAB does with -v7.3: HDF5 after a header, the first index fastest."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in arrays.items():
            kind = "char" if isinstance(value, str) else "double"
            array = np.asarray(value).T
            if isinstance(value, str):
                array = np.array([[ord(letter)] for letter in value], np.uint16)
            file[name] = np.atleast_2d(array)
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(124) + b"\0\2IM"
    with path.open("r+b") as raw:
        raw.write(header)


def test_matlab_of_version_7_3(tmp_path: Path) -> None:
    samples = counts(900, 2).astype(np.float64)
    path = tmp_path / "a.mat"
    write_mat73(path, sampling_rate=200.0, start_time=START, A=samples, B=samples[:, :1])
    sensors = opened(path)
    np.testing.assert_array_equal(whole(sensors["A"]), samples)
    np.testing.assert_array_equal(whole(sensors["B"]), samples[:, :1])
    assert sensors["A"].stretches[0].start_utc_ns == START_NS
    assert sensors["B"].sampling_rate == 200.0


def test_matlab_of_version_7_3_follows_no_link_and_inflates_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    write_mat73(path, sampling_rate=200.0, A=np.zeros((10, 1)))
    with h5py.File(path, "r+") as file:
        file["B"] = h5py.ExternalLink("other.h5", "/A")
    assert list(opened(path)) == ["A"]
    with h5py.File(path, "r+") as file:
        file.create_dataset("C", (1 << 40,), "f8", chunks=(1 << 16,), compression="gzip")
    with pytest.raises(ImportFormatError, match=r"C: \d+ rows, more than a file of"):
        open_sources([path])
    with h5py.File(path, "r+") as file:
        del file["C"]
        made = file.create_dataset("C", (9, 1), "f8", chunks=(9, 1), compression="gzip")
        made.id.write_direct_chunk((0, 0), zlib.compress(bytes(1 << 24)))
    with pytest.raises(ImportFormatError, match="a chunk of 72 bytes inflates to more"):
        open_sources([path])


def test_a_file_that_scipy_provides_says_what_it_lacks() -> None:
    path = Path(scipy.io.__file__).parent / "matlab/tests/data/testhdf5_7.4_GLNX86.mat"
    if not path.exists():
        pytest.skip("scipy was installed without its tests")
    with pytest.raises(ImportFormatError, match="expected a positive sampling_rate"):
        open_sources([path])


@pytest.mark.parametrize(
    ("name", "package"),
    [("a.tdms", "nptdms"), ("a.uff", "pyuff"), ("a.sac", "obspy"), ("a.mseed", "pymseed")],
)
def test_the_installation_of_a_missing_library_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str
) -> None:
    (tmp_path / name).write_bytes(b"000001D " + bytes(120) if package == "pymseed" else b"anything")
    monkeypatch.setitem(__import__("sys").modules, package, None)
    said = rf"(?i){package}, which is not installed; run: .* pip install '"
    with pytest.raises(ImportFormatError, match=said):
        open_sources([tmp_path / name])


@pytest.mark.parametrize(
    ("name", "problems"),
    [
        ("corrupt_one_extra_byte_at_end.mseed", "bytes 512 to 513"),
        ("brokenlastrecord.mseed", "bytes 4096 to"),
        ("single_record_plus_noise_record.mseed", "bytes 512 to 1024"),
    ],
)
def test_sound_records_of_a_damaged_file_that_obspy_provides(
    obspy: ModuleType, name: str, problems: str
) -> None:
    found = open_sources([Path(str(obspy.__file__)).parent / "io/mseed/tests/data" / name])
    assert len(found.sensors) == 1
    assert problems in found.problems[0]
