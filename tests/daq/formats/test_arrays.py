"""Samples in memory become sensors, or are refused with what was expected."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

from daq.errors import ArrayError, ImportFormatError
from daq.formats.arrays import recording_of_arrays

RATE = 100.0
N = 500
FloatArray = NDArray[np.float64]


def samples(n_channels: int = 3, seed: int = 0, n: int = N) -> FloatArray:
    return np.random.default_rng(seed).normal(size=(n, n_channels))


def labelled(array: FloatArray, times: object = None, **attributes: str) -> xr.DataArray:
    times = np.arange(len(array)) / RATE if times is None else times
    return xr.DataArray(
        array,
        dims=("time", "channel"),
        coords={"time": times, "channel": list("XYZ")[: array.shape[1]]},
        attrs=attributes,
    )


def stream(
    name: str = "TST", start: str = "2026-11-21T00:00:00.25", **of_channel: FloatArray
) -> Any:  # noqa: ANN401 - ObsPy has no types
    obspy = pytest.importorskip("obspy")
    header = {"network": "XX", "station": name, "sampling_rate": RATE}
    return obspy.Stream(
        [
            obspy.Trace(array, header | {"channel": code, "starttime": obspy.UTCDateTime(start)})
            for code, array in of_channel.items()
        ]
    )


@pytest.mark.parametrize("dtype", ["int16", "int64", "float32", "float64"])
def test_numbers_of_any_real_type_are_taken_as_they_are(dtype: str) -> None:
    given = (1000 * samples()).astype(dtype)
    recording = recording_of_arrays({"A": given, "B": given[:, 0]}, RATE, unit="M/S^2")
    first, second = recording.sensors
    assert [channel.name for channel in first.channels] == ["1", "2", "3"]
    assert {channel.unit for channel in first.channels} == {"m/s²"}
    assert second.counts().shape == (N, 1)
    assert first.counts().dtype == dtype
    assert np.shares_memory(first.counts(), given)


def test_lists_of_numbers_are_arrays() -> None:
    recording = recording_of_arrays({"A": [[1, 2], [3, 4]]}, RATE)
    np.testing.assert_array_equal(recording.sensors[0].counts(), [[1, 2], [3, 4]])


def test_rows_that_are_masked_are_gaps_and_numbers_that_are_not_finite_absent() -> None:
    given = samples()
    given[3, 1] = np.nan
    given[7, 0] = np.inf
    mask = np.zeros_like(given, dtype=bool)
    mask[5] = True
    recording = recording_of_arrays({"A": np.ma.MaskedArray(given, mask)}, RATE)
    assert recording.sensors[0].gaps["first_sample"].tolist() == [5]
    counts = recording.sensors[0].counts()
    assert np.argwhere(np.isnan(counts)).tolist() == [[3, 1], [6, 0]]
    assert recording.sensors[0].n_samples == N - 1


def test_labels_of_a_data_array_are_taken() -> None:
    start = np.datetime64("2026-11-21T00:00:00.5", "ns")
    times = start + np.arange(N) * np.timedelta64(10, "ms")
    array = labelled(samples(), times, units="nm/s").transpose("channel", "time")
    recording = recording_of_arrays({"A": array, "B": labelled(samples(), times)}, channels=None)
    sensor = recording.sensors[0]
    assert sensor.sampling_rate == pytest.approx(RATE, rel=1e-12)
    assert [channel.name for channel in sensor.channels] == ["X", "Y", "Z"]
    assert [channel.unit for channel in sensor.channels] == ["nm/s"] * 3
    assert recording.sensors[1].channels[0].unit == "counts"
    assert int(sensor.blocks["device_counter"][0]) == int(start.astype(np.int64))
    np.testing.assert_array_equal(sensor.counts(), samples())


def test_a_stream_holds_a_sensor_for_each_station() -> None:
    whole = stream("ONE", HNX=samples()[:, 0], HNY=samples()[:, 1]) + stream(
        "TWO", HNX=samples(1)[:, 0]
    )
    before = [trace.stats.starttime for trace in whole]
    recording = recording_of_arrays(whole)
    assert [sensor.name for sensor in recording.sensors] == ["XX.ONE", "XX.TWO"]
    assert [channel.name for channel in recording.sensors[0].channels] == ["HNX", "HNY"]
    np.testing.assert_array_equal(recording.sensors[0].counts(), samples()[:, :2])
    assert int(recording.created_at.utc_ns) == 1_795_219_200_250_000_000
    assert [trace.stats.starttime for trace in whole] == before
    assert len(whole) == 3


def test_a_sensor_can_be_a_stream_a_trace_or_a_list_of_traces() -> None:
    given = stream(HNX=samples()[:, 0], HNY=samples()[:, 1])
    masked = given.copy()
    masked[0].data = np.ma.masked_inside(masked[0].data, 0.1, 0.11)
    n_masked = int(masked[0].data.mask.sum())
    assert n_masked > 0
    nan = given.copy()
    nan[1].data[17] = np.nan
    recording = recording_of_arrays(
        {"A": given, "B": given[0], "C": list(given), "D": masked, "E": nan}, channels=None
    )
    assert [len(sensor.channels) for sensor in recording.sensors] == [2, 1, 2, 2, 2]
    assert [len(sensor.gaps) for sensor in recording.sensors][:3] == [0, 0, 0]
    absent = [sensor.absent.tolist() for sensor in recording.sensors]
    assert {column for column, _, _ in absent[3]} == {0}
    assert sum(end - begin for _, begin, end in absent[3]) == n_masked
    assert (absent[:3], absent[4]) == ([[], [], []], [[1, 17, 18]])
    named = recording_of_arrays({"A": given}, channels="XY")
    assert [channel.name for channel in named.sensors[0].channels] == ["X", "Y"]


@pytest.mark.parametrize(
    ("sensors", "fs", "said"),
    [
        ([samples()], RATE, "sensors: a list; expected a dictionary of arrays"),
        (samples(), RATE, "sensors: a ndarray of shape (500, 3); expected a dictionary"),
        ({}, RATE, "an empty dictionary; expected an array for each sensor"),
        ({1: samples()}, RATE, "sensor 1: expected a name"),
        ({"A": samples()}, None, "fs: no sampling rate of sensor 'A'; expected it in Hz"),
        ({"A": samples()}, {"B": RATE}, "fs: no sampling rate of sensor 'A'"),
        ({"A": samples()}, 0, "fs=0: expected a sampling rate in Hz, above 0"),
        ({"A": samples()}, -1.0, "fs=-1.0: expected a sampling rate"),
        ({"A": samples()}, np.nan, "fs=nan: expected a sampling rate"),
        ({"A": samples()}, np.inf, "fs=inf: expected a sampling rate"),
        ({"A": samples()}, True, "fs=True: expected a sampling rate"),
        ({"A": samples()}, "200", "fs='200': expected a sampling rate"),
        ({"A": samples() * 1j}, RATE, "sensor 'A': complex128 samples; expected real numbers"),
        ({"A": ["a", "b"]}, RATE, "sensor 'A': <U1 samples; expected real numbers"),
        ({"A": [[1, 2], [3]]}, RATE, "sensor 'A': a list; expected numbers of shape"),
        ({"A": None}, RATE, "sensor 'A': object samples; expected real numbers"),
        ({"A": np.zeros((N, 3, 2))}, RATE, "an array of shape (500, 3, 2); expected"),
        ({"A": np.zeros(())}, RATE, "an array of shape (); expected (n_samples, n_channels)"),
        ({"A": np.zeros((0, 3))}, RATE, "an array of shape (0, 3); expected"),
        ({"A": samples().T}, RATE, "3 samples of 500 channels; expected (n_samples, n_channels)"),
        ({"A": np.full(N, np.nan)}, RATE, "sensor 'A': no finite sample; expected numbers"),
        ({"A": samples(), "B": samples(n=400)}, RATE,
         "sensor 'B' has 400 samples, 4 s, and 'A' has 500, 5 s; expected equal lengths"),
        ({"A": labelled(samples()), "B": samples()}, RATE,
         "sensor 'A' has times, 'B' has none; expected all sensors with times, or none"),
        ({"A": labelled(samples())}, 2 * RATE, "fs=200: the times of sensor 'A' are 100 Hz"),
        ({"A": labelled(samples(), np.cumsum(np.arange(N)))}, None,
         "times with steps of 1 to 499 s; expected even ones: put NaN where samples are missing"),
        ({"A": labelled(samples(), -np.arange(N))}, None, "times with steps of -1 to -1 s"),
        ({"A": labelled(samples(), [str(n) for n in range(N)])}, None, "times of type"),
        ({"A": labelled(samples()).rename(time="t")}, None,
         "a DataArray with dimensions ('t', 'channel'); expected 'time'"),
        ({"A": labelled(samples(1, n=1))}, None, "1 samples; expected at least two"),
    ],
)  # fmt: skip
def test_what_cannot_be_samples_is_refused_with_what_was_expected(
    sensors: object, fs: object, said: str
) -> None:
    with pytest.raises(ArrayError, match=re.escape(said)):
        recording_of_arrays(sensors, fs)


@pytest.mark.parametrize(
    ("channels", "said"),
    [
        ("XY", "channels: X, Y; expected 3 names that differ, as sensor 'A' has 3 channels"),
        ("XYX", "channels: X, Y, X; expected 3 names that differ"),
    ],
)
def test_names_of_channels_must_fit(channels: str, said: str) -> None:
    with pytest.raises(ArrayError, match=said):
        recording_of_arrays({"A": samples()}, RATE, channels=channels)


def test_streams_that_do_not_fit_are_refused() -> None:
    two = stream("ONE", HNX=samples()[:, 0]) + stream("TWO", HNX=samples()[:, 0])
    with pytest.raises(ArrayError, match=r"traces of 2 sensors \(XX.ONE, XX.TWO\); expected those"):
        recording_of_arrays({"A": two})
    with pytest.raises(ArrayError, match=r"fs=50: the times of sensor 'XX\.TST' are 100 Hz"):
        recording_of_arrays(stream(HNX=samples()[:, 0]), 50)
    slow = stream(HNX=samples()[:, 0], HNY=samples()[:, 0])
    slow[0].stats.sampling_rate = 50
    with pytest.raises(
        ImportFormatError, match="several sampling rates: 100 Hz in HNY; 50 Hz in HNX"
    ):
        recording_of_arrays({"A": slow})


def test_trailing_gaps_do_not_shorten_a_sensor() -> None:
    given = samples()
    given[-50:] = np.nan
    recording = recording_of_arrays({"A": samples(), "B": given}, RATE)
    assert [sensor.n_samples for sensor in recording.sensors] == [N, N - 50]
