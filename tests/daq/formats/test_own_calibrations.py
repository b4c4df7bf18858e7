"""What files say of their own counts, and what has precedence over it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.bench.loading import parse
from daq.bench.model import Bench
from daq.errors import ImportFormatError
from daq.formats.importer import Taken, import_files
from daq.formats.readers.waveforms import _reftek
from daq.formats.sources import open_sources
from daq.recording.reader import Recording

obspy: Any = pytest.importorskip("obspy", reason="ObsPy is an extra")
pyuff: Any = pytest.importorskip("pyuff", reason="pyuff is an extra")
SHIPPED = Path(obspy.__file__).parent


def shipped(name: str) -> Path:
    """Return a file that ObsPy ships."""
    return next(SHIPPED.rglob(name))


def bench_of(sensor: str, channel: str) -> Bench:
    """Return a bench of one channel, of 5 counts per g."""
    return parse(
        "name = 'b'\nsampling_rate = 100.0\n"
        f"[[sensors]]\nname = '{sensor}'\ndriver = 'import'\nport = 'x'\n"
        f"channels = [{{name = '{channel}', sensitivity = 5.0, unit = 'g'}}]\n"
    )


def taken(tmp_path: Path, *paths: Path, **options: Any) -> tuple[Taken, ...]:  # noqa: ANN401 - any
    """Import, and return what was taken; the recording must say the same."""
    result = import_files(paths, tmp_path / "a.h5", **options)
    with Recording.open(tmp_path / "a.h5") as recording:
        kept = [channel for sensor in recording.sensors for channel in sensor.channels]
    assert [(each.sensitivity, each.unit) for each in kept] == [
        (each.sensitivity, each.unit) for each in result.calibrations
    ]
    return result.calibrations


@pytest.mark.filterwarnings("ignore")  # ObsPy warns of headers that it does not know
@pytest.mark.parametrize(
    ("name", "per_count", "unit"),
    [
        ("test.knet", 0.0, "m/s²"),  # gal and counts are in the header
        ("BI008_MEMA-04823.evt", 2.5 / 2**23 / 2.5 * 9.80665, "m/s²"),
        ("loc_RJOB20050831023349.z", 0.0949e-9 * 2 * np.pi / 1.0, "m/s"),
        ("20180307_031245000.0.seg2", 0.001199e-3, "V"),
        ("230000005_0036EE80_cropped.rt130", 2.760e-6, "V"),
    ],
)
def test_a_count_is_what_the_file_says(
    tmp_path: Path, name: str, per_count: float, unit: str
) -> None:
    path = shipped(name)
    if name == "test.knet":
        (line,) = [each for each in path.read_text().splitlines() if each.startswith("Scale")]
        gal, counts = line.split(maxsplit=2)[2].split("(gal)/")
        per_count = 1e-2 * float(gal) / float(counts)
    first = taken(tmp_path, path)[0]
    assert (first.origin, first.unit) == ("file", unit)
    assert 1 / first.sensitivity == pytest.approx(per_count, rel=1e-4)
    with Recording.open(tmp_path / "a.h5") as recording:
        np.testing.assert_array_equal(
            recording.sensors[0].counts()[:, 0], obspy.read(str(path))[0].data
        )


def test_a_factor_of_two_meanings_is_not_taken_and_said(tmp_path: Path) -> None:
    for scale, said in ((6.3e8, True), (1.0, False)):
        trace = obspy.Trace(np.arange(400, dtype=np.float32), {"station": "A", "channel": "HHZ"})
        trace.stats.sac = {"scale": scale}
        trace.write(str(tmp_path / "a.sac"), format="SAC")
        (only,) = taken(tmp_path, tmp_path / "a.sac")
        assert (only.origin, only.sensitivity, only.unit) == ("none", 1.0, "counts")
        assert ("SCALE 6.3e+08 of SAC not taken" in "".join(only.notes)) == said
        (tmp_path / "a.h5").unlink()


def test_bit_weights_count_at_unity_gain_alone() -> None:
    weights, gains = ("2.760 uV", "178.6 mV", "x", None), ("1", "32", "1", "1")
    found = [
        _reftek(
            obspy.core.AttribDict(
                channel_number=number, channel_true_bit_weights=weights, channel_gain_code=gains
            )
        )
        for number in range(4)
    ]
    assert [None if each is None else round(1 / each.sensitivity, 9) for each in found] == [
        2.76e-6,
        None,
        None,
        None,
    ]


def test_serial_numbers_come_along(tmp_path: Path) -> None:
    taken(tmp_path, shipped("BI008_MEMA-04823.evt"))
    with Recording.open(tmp_path / "a.h5") as recording:
        sensor = recording.sensors[0]
    assert (sensor.model, sensor.serial_number) == ("New Etna", "4823")


def test_what_writers_put_by_default_is_no_calibration(tmp_path: Path) -> None:
    trace = obspy.Trace(np.arange(400, dtype=np.int32), {"station": "A", "channel": "HHZ"})
    trace.write(str(tmp_path / "a.gse"), format="GSE2")
    (only,) = taken(tmp_path, tmp_path / "a.gse")
    assert (only.origin, only.unit) == ("none", "counts")


def test_response_then_bench_then_file(tmp_path: Path) -> None:
    path = shipped("test.knet")
    (only,) = taken(tmp_path, path)
    assert only.origin == "file"
    (name,) = open_sources([path]).sensors
    bench = bench_of(name, "EW")
    (tmp_path / "a.h5").unlink()
    (only,) = taken(tmp_path, path, bench=bench)
    assert (only.origin, only.sensitivity, only.unit) == ("bench", 5.0, "g")
    (tmp_path / "a.h5").unlink()
    resp = shipped("IM_IL31__BHZ.xml")
    (only,) = taken(tmp_path, path, bench=bench, response_for=[("*", resp)])
    assert (only.origin, only.unit) == ("response", "m")


def test_files_of_one_channel_that_contradict_each_other(tmp_path: Path) -> None:
    path = shipped("test.knet")
    other = tmp_path / "later.knet"
    text = path.read_text()
    value = text.split("(gal)/")[1].split()[0]
    other.write_text(text.replace(f"(gal)/{value}", f"(gal)/{2 * int(value)}"))
    opened = open_sources([path, other])
    (problem,) = opened.problems
    assert "later.knet" in problem
    assert "counts per m/s²" in problem


@pytest.mark.filterwarnings("ignore")  # pyuff leaves files open
@pytest.mark.parametrize("length", [None, 1.0, 1000.0])
def test_a_universal_file_without_a_label(tmp_path: Path, length: float | None) -> None:
    path = tmp_path / "a.uff"
    if length is not None:
        units = pyuff.prepare_164(
            units_code=1,
            units_description="units",
            temp_mode=1,
            length=length,
            force=1.0,
            temp=1.0,
            temp_offset=0.0,
        )
        pyuff.UFF(str(path)).write_sets(units, "add")
    function = pyuff.prepare_58(
        binary=1,
        func_type=1,
        rsp_node=7,
        rsp_dir=1,
        ref_node=1,
        ref_dir=3,
        data=np.arange(500.0),
        x=np.arange(500) / 512,
        abscissa_inc=1 / 512,
        abscissa_spacing=1,
        ordinate_spec_data_type=12,
        orddenom_spec_data_type=0,
        z_axis_spec_data_type=0,
        abscissa_spec_data_type=17,
    )
    pyuff.UFF(str(path)).write_sets(function, "add")
    (only,) = taken(tmp_path, path)
    assert (only.origin, only.sensitivity, only.unit) == ("file", length or 1.0, "m/s²")


def test_a_bench_that_would_scale_motion_again_is_refused(tmp_path: Path) -> None:
    nptdms: Any = pytest.importorskip("nptdms")
    path = tmp_path / "a.tdms"
    properties = {"wf_increment": 1e-3, "NI_UnitDescription": "g"}
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([nptdms.ChannelObject("A", "x", np.arange(300.0), properties)])
    (only,) = taken(tmp_path, path)
    assert (only.origin, only.sensitivity, only.unit) == ("file", 1.0, "g")
    with pytest.raises(ImportFormatError, match="would scale it again"):
        import_files([path], tmp_path / "b.h5", bench=bench_of("A", "x"))
