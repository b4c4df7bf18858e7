"""Foreign files are read to exact instants and samples, and refused in words."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import ForeignSensor
from daq.formats.readers.delimited import read_delimited
from daq.formats.readers.npz import read_mat, read_npz
from daq.formats.sources import Selection, open_sources

RATE = 200.0
START_NS = 1_700_000_000_123_456_000


def write_mseed(path: Path, pieces: list[tuple[str, str, int, np.ndarray[Any, Any]]]) -> Path:
    """Write (location, channel, start in ns, counts) as miniSEED, each piece a trace."""
    obspy = pytest.importorskip("obspy", reason="ObsPy is an extra")
    traces = [
        obspy.Trace(
            counts,
            {
                "network": "XX",
                "station": "ABC",
                "location": location,
                "channel": channel,
                "starttime": obspy.UTCDateTime(ns=start_ns),
                "sampling_rate": RATE,
            },
        )
        for location, channel, start_ns, counts in pieces
    ]
    obspy.Stream(traces).write(str(path), format="MSEED")
    return path


def read_waveforms(
    paths: list[Path], selection: Selection | None = None
) -> tuple[ForeignSensor, ...]:
    return tuple(open_sources(paths, selection).sensors.values())


def counts(n: int, seed: int = 0) -> np.ndarray[Any, Any]:
    return np.random.default_rng(seed).integers(-(2**23), 2**23, n, dtype=np.int32)


def test_miniseed_channels_are_absent_where_others_have_samples(tmp_path: Path) -> None:
    x, y = counts(1000, 1), counts(1000, 2)
    step = 5_000_000
    path = write_mseed(
        tmp_path / "a.mseed",
        [
            ("00", "HNX", START_NS, x[:400]),
            ("00", "HNX", START_NS + 450 * step, x[450:]),
            ("00", "HNY", START_NS + 10 * step, y[10:]),
        ],
    )
    (sensor,) = read_waveforms([path])
    assert sensor.stretches[0].start_utc_ns == START_NS
    assert sensor.first_samples() == [0, 400, 450]
    assert sensor.absent.tolist() == [[1, 0, 10], [0, 400, 450]]
    found = np.concatenate([stretch.counts[:] for stretch in sensor.stretches])
    x[400:450] = y[:10] = 0
    np.testing.assert_array_equal(found, np.stack([x, y], axis=1))


def test_a_miniseed_record_that_does_not_end_as_it_states_is_left_out(tmp_path: Path) -> None:
    """Steim's differences are damaged, and can be unpacked."""
    path = write_mseed(tmp_path / "a.mseed", [("00", "HNX", START_NS, counts(3000, 1))])
    records = bytearray(path.read_bytes())
    length = 4096
    begin = struct.unpack_from(">H", records, length + 44)[0]
    records[length + begin + 11] ^= 0x15  # of the last sample, as the second record states it
    path.write_bytes(records)
    found = open_sources([path])
    assert "Data integrity check for Steim2 failed" in found.problems[0]
    (sensor,) = found.sensors.values()
    assert len(sensor.stretches) == 2


def test_a_miniseed_channel_without_a_sampling_rate_is_named(tmp_path: Path) -> None:
    traces = [(code, "HNX", START_NS, counts(400, 1)) for code in ("00", "10")]
    path = write_mseed(tmp_path / "a.mseed", traces)
    records = bytearray(path.read_bytes())
    struct.pack_into(">hh", records, 32, 0, 0)
    path.write_bytes(records)
    found = open_sources([path])
    assert (len(found.sensors), list(found.left_aside.values())) == (1, ["no sampling rate"])


def test_miniseed_channels_need_no_samples_in_common(tmp_path: Path) -> None:
    pieces = [
        ("00", "HNX", START_NS, counts(100)),
        ("00", "HNY", START_NS + 10_000_000_000, counts(100)),
    ]
    (sensor,) = read_waveforms([write_mseed(tmp_path / "a.mseed", pieces)])
    assert sensor.first_samples() == [0, 2000]
    assert sensor.absent.tolist() == [[1, 0, 100], [0, 100, 200]]


class _Runs:
    """Runs a command when it is unpickled."""

    def __init__(self, made: Path) -> None:
        self.made = made

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.made,)


def test_a_pickle_named_as_a_waveform_is_not_run(tmp_path: Path) -> None:
    pytest.importorskip("obspy", reason="ObsPy is an extra")
    evil, made = tmp_path / "evil.mseed", tmp_path / "made"
    evil.write_bytes(pickle.dumps(("obspy.core.stream", _Runs(made))))
    with pytest.raises(ImportFormatError, match="unknown format; expected one of MSEED"):
        read_waveforms([evil])
    assert not made.exists()
    response = tmp_path / "RESP.XX.A..BHZ"
    response.write_text("#\nB050F03     Station:     A\n", encoding="ascii")
    with pytest.raises(ImportFormatError, match="responses, no samples; give it with --response"):
        read_waveforms([response])


@pytest.mark.parametrize("kind", ["npz", "mat"])
def test_npz_and_mat_have_one_array_a_sensor(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a.{kind}"
    a, b = counts(300).reshape(100, 3), np.arange(100.0)
    arrays = {"sampling_rate": RATE, "start_time": "2026-11-21T03:00:00.005Z", "A": a, "B": b}
    if kind == "npz":
        np.savez(path, **arrays)  # type: ignore[arg-type]  # names of arrays
    else:
        savemat(path, arrays)
    first, second = (read_npz if kind == "npz" else read_mat)(path)
    assert (first.name, first.channels, first.sampling_rate) == ("A", ("1", "2", "3"), RATE)
    np.testing.assert_array_equal(first.stretches[0].counts, a)
    assert first.stretches[0].start_utc_ns == 1_795_230_000_005_000_000
    assert second.channels == ("1",)
    assert second.stretches[0].counts.shape == (100, 1)


def test_npz_rows_that_are_not_numbers_are_gaps(tmp_path: Path) -> None:
    values = np.arange(20.0).reshape(10, 2)
    values[4] = np.nan
    np.savez(tmp_path / "a.npz", sampling_rate=2.0, A=values)
    (sensor,) = read_npz(tmp_path / "a.npz")
    assert [s.n_samples for s in sensor.stretches] == [4, 5]
    assert sensor.first_samples() == [0, 5]


def test_npz_pickles_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", sampling_rate=1.0, A=np.array([{}], dtype=object))
    with pytest.raises(ImportFormatError, match=r"a\.npz"):
        read_npz(tmp_path / "a.npz")


def test_delimited_header_names_sensors_channels_and_units(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    path.write_text(
        "# made by hand\n"
        "time [s];A.X [m/s²];A.Y (m/s²);B.X\n"
        "10.000;1;-2;3e3\n10.005;4;5;6\n10.010;7;8;9\n",
        encoding="utf-8",
    )
    a, b = read_delimited(path)
    assert (a.name, a.channels, a.units) == ("A", ("X", "Y"), ("m/s²", "m/s²"))
    assert (b.name, b.channels, b.units) == ("B", ("X",), ("counts",))
    assert a.sampling_rate == b.sampling_rate == RATE
    assert a.stretches[0].start_utc_ns == 10_000_000_000
    np.testing.assert_array_equal(a.stretches[0].counts, [[1, -2], [4, 5], [7, 8]])


def test_delimited_missing_rows_make_gaps_and_missing_cells_none(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"2026-11-21T03:00:{s:02d}Z,{s},{'' if s == 4 else s}" for s in range(10) if s != 7]
    path.write_text("time,A.X,A.Y\n" + "\n".join(rows) + "\n")
    (sensor,) = read_delimited(path)
    assert sensor.sampling_rate == 1.0
    assert sensor.first_samples() == [0, 8]
    assert [s.n_samples for s in sensor.stretches] == [7, 2]
    assert np.argwhere(np.isnan(sensor.stretches[0].counts[:])).tolist() == [[4, 1]]


def test_delimited_without_time_the_rate_must_be_given(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("X,Y\n1,2\n3,4\n")
    with pytest.raises(ImportFormatError, match="--sampling-rate"):
        read_delimited(path)
    (sensor,) = read_delimited(path, 50.0)
    assert (sensor.sampling_rate, sensor.channels) == (50.0, ("X", "Y"))
