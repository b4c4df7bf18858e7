"""``import huddle``: its numbers, what it refuses, and its results."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from numpy.typing import NDArray
from scipy import signal
from typer.testing import CliRunner

import huddle
from daq.bench.units import canonical, cf_unit
from daq.errors import ArrayError, ImportFormatError, WrongSettingError
from daq.results.band_summary import judged_method
from estimator.errors import BandError
from tui.commands.main import app
from tui.output import extras

FloatArray = NDArray[np.float64]

ROOT = Path(__file__).parents[1]
RATE = 100.0
SNR = 100.0


def triaxial(n: int = 20_000, seed: int = 5) -> dict[str, FloatArray]:
    """Make three sensors that point anywhere and feel one motion; noise of variance 1."""
    rng = np.random.default_rng(seed)
    motion = np.sqrt(SNR) * rng.normal(size=(n, 3))
    turns = {name: np.linalg.qr(rng.normal(size=(3, 3)))[0] for name in "ABC"}
    return {name: motion @ turn + rng.normal(size=(n, 3)) for name, turn in turns.items()}


def command(*arguments: str) -> str:
    """Run ``huddle`` in this process; return its standard output."""
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    return done.stdout


def imported(folder: Path, sensors: dict[str, FloatArray]) -> Path:
    """Write the samples as a recording of the command's."""
    source, out = folder / "arrays.npz", folder / "arrays.h5"
    np.savez(source, sampling_rate=RATE, **sensors)  # type: ignore[arg-type]  # allow_pickle is no sensor
    command("import", str(source), "--out", str(out))
    return out


# ------------------------------------------------------------------------------ numbers


@pytest.mark.parametrize(
    ("options", "arguments"),
    [
        ({}, ()),
        pytest.param(
            {"method": "all", "segment": 2.0},
            ("--method", "all", "--segment", "2"),
            marks=pytest.mark.long,
        ),
        (
            {"segment": 4, "window": "kaiser,8", "overlap": 0.6, "gains": {"B": 1.02}},
            ("--segment", "4", "--window", "kaiser,8", "--overlap", "0.6", "--gain", "B=1.02"),
        ),
        pytest.param(
            {"octaves": True, "segment": "1s", "detrend": "linear", "correct": False},
            ("--octaves", "--segment", "1s", "--detrend", "linear", "--no-correction"),
            marks=pytest.mark.long,
        ),
    ],
)
def test_arrays_give_the_numbers_of_the_command_to_the_bit(
    tmp_path: Path, options: dict[str, Any], arguments: tuple[str, ...]
) -> None:
    sensors = triaxial()
    sensors["A"][7000:7003, 1] = np.nan
    path = imported(tmp_path, sensors)
    printed = json.loads(command("estimate", str(path), *arguments, "--json", "-"))
    documents = printed.get("results", [printed])
    of_arrays = huddle.self_noise(sensors, fs=RATE, **options)
    of_file = huddle.estimate(path, **options)
    assert of_arrays.methods == tuple(document["method"] for document in documents)
    for document in documents:
        for found in (of_arrays, of_file):
            result = found.with_method(document["method"])
            assert result.n_segments == document["segments"]
            assert result.effective_averages == document["effective_averages"]
            assert result.frequency.tolist() == document["frequency_hz"]
            for column, channel in enumerate(document["channels"]):
                label = result.channels[column]
                assert (label.sensor, label.channel) == (channel["sensor"], channel["channel"])
                curves = (result.data_psd, result.noise_psd, result.noise_low, result.noise_high)
                names = ("data_psd", "noise_psd", "noise_psd_low", "noise_psd_high")
                for curve, name in zip((*curves, result.cov), (*names, "cov"), strict=True):
                    expected = np.array(channel[name], dtype=np.float64)
                    np.testing.assert_array_equal(curve[:, column], expected, strict=True)


def test_the_three_sensor_estimate_is_the_closed_form_of_scipys_spectra() -> None:
    sensors = triaxial(5000)
    result = huddle.self_noise(sensors, fs=RATE, segment="4s", correct=False, method="three-sensor")
    columns = np.hstack(list(sensors.values()))
    pairs = [
        # scipy takes the conjugate of the first signal, we that of the second
        [
            signal.csd(columns[:, q], columns[:, p], RATE, "hann", 400, 200, detrend="constant")[1]
            for q in range(9)
        ]
        for p in range(9)
    ]
    csm = np.moveaxis(np.array(pairs), 2, 0)[2:-1]  # detrending bends the first bin
    a, b, c = slice(0, 3), slice(3, 6), slice(6, 9)
    for i, j, k in ((a, b, c), (b, c, a), (c, a, b)):
        motion = csm[:, i, k] @ np.linalg.inv(csm[:, j, k]) @ csm[:, j, i]
        closed = np.einsum("fcc->fc", csm[:, i, i] - motion).real
        # The noise is 1/SNR of the spectra that are subtracted, and so are 1/SNR of the digits.
        rounding = 1e3 * SNR * np.finfo(np.float64).eps
        np.testing.assert_allclose(result.noise_psd[2:-1, i], closed, rtol=rounding)


def test_samples_that_are_not_numbers_cost_the_segments_they_touch() -> None:
    sensors = triaxial()
    whole = huddle.self_noise(sensors, fs=RATE, segment="2s", overlap=0.5)
    sensors["B"][5050, 2] = np.nan  # within two segments of 200 samples, 100 apart
    sensors["C"][9999:10_001] = np.nan  # within three
    found = huddle.self_noise(sensors, fs=RATE, segment="2s", overlap=0.5)
    assert whole.n_segments - found.n_segments == 5
    assert np.isfinite(found.noise_psd[2:-1]).all()


def test_a_unit_of_the_samples_is_turned_into_that_of_the_motion() -> None:
    sensors = triaxial()
    velocity = huddle.self_noise(sensors, fs=RATE, sample_unit="mm/s", segment="1s")
    assert velocity.unit == "mm/s"
    motion = huddle.self_noise(sensors, fs=RATE, sample_unit="mm/s", unit="m/s²", segment="1s")
    omega = 2 * np.pi * motion.frequency[:, None]
    np.testing.assert_allclose(
        motion.data_psd[1:], velocity.data_psd[1:] * (omega[1:] * 1e-3) ** 2, rtol=1e-12
    )
    assert huddle.self_noise(sensors, fs=RATE, segment="1s").unit == "counts"


def test_counts_are_not_called_motion(tmp_path: Path) -> None:
    sensors = triaxial()
    with pytest.raises(ArrayError, match=r"A\.1 are counts.*response=.*sample_unit="):
        huddle.self_noise(sensors, fs=RATE, unit="m/s²", segment="1s")
    inventory: Any = pytest.importorskip("obspy", reason="ObsPy is an extra").core.inventory
    stage = inventory.PolesZerosResponseStage(
        stage_sequence_number=1,
        stage_gain=5e4,
        stage_gain_frequency=10.0,
        input_units="M/S",
        output_units="COUNTS",
        pz_transfer_function_type="LAPLACE (RADIANS/SECOND)",
        normalization_frequency=10.0,
        normalization_factor=abs((20j * np.pi + 20) ** 2 + 400) / (20 * np.pi) ** 2,
        zeros=[0, 0],
        poles=[-20 + 20j, -20 - 20j],
    )
    response = inventory.Response(response_stages=[stage])
    channel = inventory.Channel("HHZ", "00", 0, 0, 0, 0, response=response, sample_rate=RATE)
    station = inventory.Station("ABC", 0, 0, 0, channels=[channel])
    found = inventory.Inventory([inventory.Network("XX", [station])], source="test")
    found.write(str(tmp_path / "a.xml"), format="STATIONXML")
    plain = huddle.self_noise(sensors, fs=RATE, segment="1s")
    for given in (tmp_path / "a.xml", str(tmp_path / "a.xml"), found, [found]):
        result = huddle.self_noise(
            sensors, fs=RATE, unit="m/s", segment="1s", response={"*": given}
        )
        s = 2j * np.pi * result.frequency[1:]
        at_10 = 20j * np.pi
        size = np.abs(s**2 / ((s + 20 - 20j) * (s + 20 + 20j)))
        size *= 5e4 / np.abs(at_10**2 / ((at_10 + 20 - 20j) * (at_10 + 20 + 20j)))
        np.testing.assert_allclose(
            result.data_psd[1:], plain.data_psd[1:] / size[:, None] ** 2, rtol=1e-9
        )
    with pytest.raises(ImportFormatError, match=r"no response for A\.1; .*XX\.ABC\.00\.HHZ"):
        huddle.self_noise(sensors, fs=RATE, segment="1s", response=found)
    with pytest.raises(ArrayError, match="expected one of the two"):
        huddle.self_noise(sensors, fs=RATE, segment="1s", response=found, sample_unit="m/s")


def test_data_arrays_keep_their_unit_and_times() -> None:
    start = np.datetime64("2026-11-21T03:00:00", "ns")
    coords = {"time": start + np.arange(20_000) * np.timedelta64(10, "ms"), "channel": list("XYZ")}
    dataset = xr.Dataset(
        {
            name: xr.DataArray(
                array, dims=("time", "channel"), coords=coords, attrs={"units": "mm/s"}
            )
            for name, array in triaxial().items()
        }
    )
    expected = huddle.self_noise(triaxial(), fs=RATE, sample_unit="mm/s", unit="m/s²", segment="1s")
    for given in (dataset, dict(dataset.data_vars)):
        found = huddle.self_noise(given, unit="m/s²", segment="1s")
        np.testing.assert_array_equal(found.noise_psd, expected.noise_psd)
        assert found.snapshot.start_utc_ns == int(start.astype(np.int64))
    assert huddle.self_noise(dataset, sample_unit="nm/s", segment="1s").unit == "nm/s"


def test_all_sensors_in_one_are_the_sensors_one_by_one() -> None:
    sensors = triaxial()
    settings: dict[str, Any] = {"segment": "1s"}
    expected = huddle.self_noise(
        sensors, fs=RATE, channels="XYZ", sample_unit="m/s²", **settings
    ).noise_psd
    whole = np.stack(list(sensors.values()))
    of_array = huddle.self_noise(whole, fs=RATE, sample_unit="m s-2", **settings)
    assert of_array.sensors == ("1", "2", "3")
    assert of_array.unit == "m/s²"
    np.testing.assert_array_equal(of_array.noise_psd, expected)
    times = pd.date_range("2026-11-21", periods=whole.shape[1], freq="10ms", tz="Europe/Berlin")
    coords = {"sensor": list("ABC"), "time": times.tz_convert(None), "channel": list("XYZ")}
    array = xr.DataArray(whole, coords=coords, dims=tuple(coords), attrs={"units": "m s-2"})
    frame = pd.concat(
        {name: pd.DataFrame(each, times, list("XYZ")) for name, each in sensors.items()}, axis=1
    )
    frame.attrs["units"] = "m s-2"
    timed = {name: frame[name] for name in sensors}
    results = [huddle.self_noise(each, **settings) for each in (array, frame, timed)]
    for each in results:
        assert [label.name for label in each.channels][:4] == ["A.X", "A.Y", "A.Z", "B.X"]
        assert each.unit == "m/s²"
        np.testing.assert_array_equal(each.noise_psd, results[0].noise_psd)
        assert each.snapshot.start_utc_ns == pd.Timestamp("2026-11-20T23:00").value
    np.testing.assert_allclose(results[0].noise_psd, expected, rtol=1e-9)
    with pytest.raises(ArrayError, match=r"a ndarray of shape .* an array .sensor, time, channel"):
        huddle.self_noise(whole[0], fs=RATE)


def test_the_sampling_rate_by_another_name_is_refused_with_its_name() -> None:
    with pytest.raises(WrongSettingError, match="the sampling rate of arrays is fs"):
        huddle.self_noise(np.zeros((3, 100, 1)), sampling_rate=100.0)  # type: ignore[call-arg]  # it has none


def test_a_window_may_be_a_tuple_of_scipy() -> None:
    sensors = triaxial()
    tuples, texts = (
        huddle.self_noise(sensors, fs=RATE, segment="1s", window=window).noise_psd
        for window in (("kaiser", 8.5), "kaiser,8.5")
    )
    np.testing.assert_array_equal(tuples, texts)
    with pytest.raises(WrongSettingError, match=r"window=.*kaiser.*above 0"):
        huddle.self_noise(sensors, fs=RATE, window=("kaiser", -1.0))


@pytest.mark.parametrize(
    ("unit", "cf"),
    [("m/s²", "m s-2"), ("nm/s", "nm s-1"), ("µg", "1e-6 standard_free_fall"), ("m", "m")],
)
def test_units_of_the_cf_conventions_are_understood(unit: str, cf: str) -> None:
    assert cf_unit(unit) == cf
    assert canonical(cf) == unit
    assert canonical("m s^-2") == canonical("m  s**-2") == "m/s²"
    assert cf_unit("furlong") == canonical("furlong") == "furlong"


def test_numbers_of_numpy_are_options() -> None:
    options: dict[str, Any] = {
        "segment": np.int64(4),
        "overlap": np.float32(0.25),
        "band": np.array([1.0, 9.0]),
    }
    found = huddle.self_noise(triaxial(), fs=float(np.float32(RATE)), **options)
    assert (found.settings.overlap, found.settings.band) == (0.25, (1.0, 9.0))


def test_sensors_may_have_different_numbers_of_channels() -> None:
    sensors = triaxial()
    sensors["D"] = sensors.pop("C")[:, :1] + sensors["A"][:, :1]
    sensors["E"] = triaxial()["C"]
    result = huddle.self_noise(sensors, fs=RATE, segment="1s")
    assert result.noise_psd.shape == (51, 10)
    dataset = result.to_xarray()
    assert dataset.noise_psd.sizes == {"estimate": 1, "trace": 10, "frequency": 51}
    np.testing.assert_array_equal(
        dataset.noise_psd.sel(estimate="three-sensor", trace="D.1"),
        result["D", "1"].noise_psd,
    )


# ------------------------------------------------------------------------------ refusals


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"method": "three_sensor"}, "method='three_sensor': .*did you mean 'three-sensor'"),
        ({"segmnt": 10}, r"option 'segmnt': expected one of .*\(did you mean 'segment'\?\)"),
        ({"segment": "fast"}, "segment='fast': expected a positive duration"),
        ({"segment": 1e9}, r"segment=1e\+09 s: longer than the 200 s of samples"),
        ({"segment": 0.01}, "segment 0.01s: expected at least 0.04s, 4 samples at 100 Hz"),
        ({"overlap": 1}, "overlap=1: expected a fraction from 0 to less than 1"),
        ({"window": "kaiser"}, "window='kaiser': expected the window with a parameter"),
        ({"dimension": 2, "method": "three-sensor"}, "dimension is for the maximum-likelihood"),
        ({"gains": {"Z": 1.0}}, "gains Z=1: expected one of A, B, C"),
        ({"unit": "volt"}, "unit 'm/s²' cannot be turned into 'volt'"),
    ],
)  # fmt: skip
def test_wrong_options_are_refused_with_what_was_expected(
    options: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        huddle.self_noise(triaxial(), fs=RATE, sample_unit="m/s²", **options)
    assert isinstance(caught.value, huddle.HuddleError)


def test_too_few_sensors_are_refused_by_name() -> None:
    sensors = triaxial()
    two = {name: sensors[name] for name in "AB"}
    with pytest.raises(ValueError, match=r"2 sensors \(A, B\): three-sensor takes at least 3; .*"
                       r"or method='two-channel'"):  # fmt: skip
        huddle.self_noise(two, fs=RATE, method="three-sensor")
    with pytest.raises(ValueError, match=r"1 sensor \(A\): two-channel takes at least 2"):
        huddle.self_noise({"A": sensors["A"]}, fs=RATE, method="two-channel")
    for method, used in (
        ("two-channel", {"two-channel"}),
        ("all", {"two-channel", "multi-part"}),
        ("auto", {"multi-part"}),
    ):
        found = huddle.self_noise(two, fs=RATE, method=method, segment="1s")
        assert set(found.methods) == used
    assert huddle.self_noise({"A": sensors["A"]}, fs=RATE, segment="1s").methods == ()


def test_too_few_averages_are_refused_with_the_reason() -> None:
    sensors = {name: array[:2000] for name, array in triaxial().items()}
    with pytest.raises(
        huddle.EstimatorError, match=r"2\.89286 effective averages; expected more than 3"
    ):
        huddle.self_noise(sensors, fs=RATE, segment="10s")


def test_paths_are_refused_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(huddle.HuddleError, match="absent"):
        huddle.estimate(tmp_path / "absent.h5")
    with pytest.raises(huddle.HuddleError, match="expected at least one path"):
        huddle.estimate([])
    with pytest.raises(huddle.HuddleError, match="recordings=3: expected a path"):
        huddle.estimate(3)  # type: ignore[arg-type]  # what is tested
    with pytest.raises(OSError, match="absent"):
        huddle.open(tmp_path / "absent.h5")


# ------------------------------------------------------------------------------ results


@pytest.fixture(scope="module")
def result() -> huddle.Result:
    return huddle.self_noise(triaxial(), fs=RATE, channels="XYZ", method="all", segment="4s")


def test_a_result_shows_the_table_of_the_command(result: huddle.Result) -> None:
    lines = repr(result).splitlines()
    assert lines[0].startswith("Self-noise, mean over 0.5 to 45 Hz, dB re 1 (counts)²/Hz")
    assert lines[1].startswith("99 segments")
    assert lines[2].split()[:4] == ["sensor", "channel", "data", "three-sensor"]
    assert [line.split()[:2] for line in lines[3:12]] == [[s, c] for s in "ABC" for c in "XYZ"]
    assert lines[12].startswith(("Nothing to do.", "▲", "✗"))
    assert not any(line.endswith(" ") for line in lines)
    assert max(map(len, lines)) <= 100
    assert all(isinstance(line, str) for line in result.advice)
    assert {str(each) for each in result.facts} >= set(result.advice)


def test_a_band_has_a_mean_with_its_interval(result: huddle.Result) -> None:
    band = result.band(1, 40)
    truth = 1 / (RATE / 2)  # variance 1 over all frequencies
    assert band.noise_psd.shape == (9,)
    np.testing.assert_allclose(band.noise_db, 10 * np.log10(truth), atol=0.3)
    assert np.all((band.noise_low < band.noise_psd) & (band.noise_psd < band.noise_high))
    assert "mean over 1 to 40 Hz" in repr(band)
    usual = result.band()
    assert (usual.low_hz, usual.high_hz) == (0.5, 45.0)
    with pytest.raises(BandError, match="no frequency between 60 and 70 Hz"):
        result.band(60, 70)


def test_a_channel_is_found_by_its_labels(result: huddle.Result) -> None:
    channel = result["B", "Y"]
    for name in ("data_psd", "noise_psd", "noise_low", "noise_high", "cov"):
        np.testing.assert_array_equal(getattr(channel, name), getattr(result, name)[:, 4])
    assert repr(channel) == "ChannelNoise(B Y, (counts)²/Hz, 201 frequencies from 0 to 50 Hz)"
    with pytest.raises(KeyError, match='expected a sensor and a channel, one of: "A", "X"'):
        result["B", "W"]


def test_methods_can_be_changed(result: huddle.Result) -> None:
    other = result.with_method("maximum-likelihood")
    assert other.method == "maximum-likelihood"
    assert set(other.methods) == set(result.methods)
    assert not np.array_equal(other.noise_psd, result.noise_psd)
    with pytest.raises(WrongSettingError, match="method='four-sensor': not estimated; there is"):
        result.with_method("four-sensor")


def test_labels_and_numbers_go_into_xarray_and_pandas(result: huddle.Result) -> None:
    dataset = result.to_xarray()
    assert tuple(dataset.noise_psd.dims) == ("estimate", "trace", "frequency")
    assert dataset.noise_psd.attrs["units"] == "(count)2 Hz-1"
    frame = result.to_frame()
    assert len(frame) == len(result.methods) * 9 * len(result.frequency)
    for method in result.methods:
        expected = result.with_method(method)
        for column, label in enumerate(result.channels):
            chosen = {"trace": label.name}
            assert dataset.sensor.sel(chosen).item() == label.sensor
            assert dataset.channel.sel(chosen).item() == label.channel
            rows = frame[
                (frame.method == method)
                & (frame.sensor == label.sensor)
                & (frame.channel == label.channel)
            ]
            for name in ("noise_psd", "noise_low", "noise_high", "cov", "flags", "data_psd"):
                curve = getattr(expected, name)[:, column]
                np.testing.assert_array_equal(rows[name].to_numpy(), curve)
                by_method = chosen if name == "data_psd" else {"estimate": method, **chosen}
                np.testing.assert_array_equal(dataset[name].sel(by_method).to_numpy(), curve)


def test_a_result_can_be_saved_and_loaded(result: huddle.Result, tmp_path: Path) -> None:
    dataset = result.to_xarray()
    result.save(tmp_path / "noise.nc")
    stored = huddle.load(tmp_path / "noise.nc")
    assert set(stored.variables) == set(dataset.variables)
    for name, values in dataset.variables.items():
        np.testing.assert_array_equal(stored[name], values)
        assert stored[name].attrs.get("units") == values.attrs.get("units")
    assert stored.attrs["Conventions"].startswith("CF-")
    with pytest.raises(OSError, match=r"none\.nc"):
        huddle.load(tmp_path / "none.nc")


def test_a_dataset_has_the_matrix_and_what_made_motion_of_counts() -> None:
    sensors = triaxial()
    found = huddle.self_noise(sensors, fs=RATE, channels="XYZ", segment="2s")
    dataset = found.to_xarray()
    whole = (dataset.csm_real + 1j * dataset.csm_imag).transpose("frequency", ...)
    np.testing.assert_array_equal(whole, found.csm)
    _, expected = signal.coherence(
        sensors["A"][:, 0], sensors["B"][:, 0], RATE, "hann", 200, detrend="constant"
    )
    pair = dataset.coherence.sel(trace="A.X", other_trace="B.X")
    np.testing.assert_allclose(pair[2:-1], expected[2:-1], rtol=1e-9)
    np.testing.assert_array_equal(dataset.response_amplitude, 1)


def test_an_interval_has_any_confidence(result: huddle.Result) -> None:
    low, high = result.interval()
    np.testing.assert_allclose(low, result.noise_low, rtol=1e-9)
    np.testing.assert_allclose(high, result.noise_high, rtol=1e-9)
    narrow, wide = result.band(5, 40, confidence=0.68), result.band(5, 40, confidence=0.99)
    usual = result.band(5, 40)
    assert (narrow.noise_high < usual.noise_high).all()
    assert (usual.noise_high < wide.noise_high).all()
    assert (wide.noise_low < usual.noise_low).all()
    assert "with its 68 % interval" in repr(narrow)
    for wrong in (0, 1, 95):
        with pytest.raises(WrongSettingError, match=f"confidence={wrong}: expected a fraction"):
            result.interval(wrong)


def test_a_notebook_shows_the_table(result: huddle.Result) -> None:
    tree = ET.fromstring(f"<html>{result._repr_html_()}</html>")  # noqa: S314 - our own
    rows = ["".join(row.itertext()) for row in tree.iter("tr")]
    assert len(rows) == 10
    assert all(name in row for name, row in zip("AAABBBCCC", rows[1:], strict=True))
    caption = tree.find(".//caption")
    assert caption is not None
    assert "".join(caption.itertext()) == repr(result).splitlines()[0]


def test_noise_is_drawn_on_axes_that_exist(result: huddle.Result) -> None:
    pyplot = pytest.importorskip("matplotlib.pyplot")
    drawn, axes = pyplot.subplots()
    assert result.plot(ax=axes) is drawn
    assert len(axes.lines) == 9
    np.testing.assert_allclose(10 ** (axes.lines[4].get_ydata() / 10), result.noise_psd[1:, 4])
    with pytest.raises(WrongSettingError, match="counts"):
        result.plot(ax=axes, models="nlnm")
    pyplot.close(drawn)


def test_noise_models_are_those_of_peterson() -> None:
    obspy = pytest.importorskip("obspy.signal.spectral_estimation")
    for name, of_obspy in (("nlnm", obspy.get_nlnm), ("nhnm", obspy.get_nhnm)):
        periods, level = of_obspy()
        found = 10 * np.log10(huddle.noise_model(name, 1 / periods[1:-1]))
        np.testing.assert_allclose(found, level[1:-1], atol=0.15)
    velocity = huddle.noise_model("nlnm", [1.0], unit="m/s")
    expected = huddle.noise_model("nlnm", [1.0]) / (2 * np.pi) ** 2
    np.testing.assert_allclose(velocity, expected)
    with pytest.raises(WrongSettingError, match="'nlmn'"):
        huddle.noise_model("nlmn", [1.0])


def test_a_figure_has_an_axis_for_each_channel(result: huddle.Result, tmp_path: Path) -> None:
    import matplotlib as mpl  # noqa: PLC0415 - only here

    mpl.use("agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    figure = result.plot()
    try:
        titles = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
        assert titles == [f"{sensor}.{axis}" for sensor in "ABC" for axis in "XYZ"]
        figure.savefig(tmp_path / "noise.png")
        assert (tmp_path / "noise.png").stat().st_size > 10_000
    finally:
        plt.close(figure)


def test_a_package_that_is_missing_is_named_with_its_extra(
    result: huddle.Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("xarray", "pandas", "matplotlib.pyplot"):
        monkeypatch.setitem(sys.modules, name, None)
    for call in (result.to_xarray, result.to_frame, result.plot):
        with pytest.raises(
            extras.MissingPackageError, match=r"is not installed; run: .* pip install 'h?[5nfp]"
        ):
            call()


def test_with_fewer_averages_than_channels_auto_is_three_sensor_and_not_judged() -> None:
    """Maximum likelihood of 15 channels needs more than ten averages."""
    rng = np.random.default_rng(27)
    motion = rng.normal(size=(1000, 3))
    sensors = {name: motion + 0.1 * rng.normal(size=(1000, 3)) for name in "ABCDE"}
    few = huddle.self_noise(sensors, fs=100.0, segment="1s", overlap=0, window="boxcar")
    assert few.method == "three-sensor"
    assert any(line.startswith("maximum-likelihood: ") for line in few.advice)
    assert judged_method(few.snapshot, few.settings) == "maximum-likelihood"
    enough = huddle.self_noise(sensors, fs=100.0, segment="0.25s", overlap=0, window="boxcar")
    assert enough.method == "maximum-likelihood"
    assert list(enough.snapshot.results) == ["maximum-likelihood"]
