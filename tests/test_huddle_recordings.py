"""``import huddle``: recordings, simulations and plans."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

import huddle
from daq.errors import ArrayError, WrongSettingError
from tests.daq.archive.day_files import write_station
from tests.test_huddle import RATE, command, imported, triaxial
from tui.notebook.options import EstimateOptions
from tui.output.json_document import calibration_document
from tui.output.json_values import json_text


def test_a_recording_is_opened_read_and_estimated(tmp_path: Path) -> None:
    sensors = triaxial()
    sensors["A"][100:103] = np.nan
    path = imported(tmp_path, sensors)
    with huddle.open(path) as recording:
        assert recording.sensors == ("A", "B", "C")
        assert recording.channels("A") == ("1", "2", "3")
        assert recording.sampling_rate("A") == RATE
        assert recording.closed
        for name, array in sensors.items():
            np.testing.assert_array_equal(recording.samples(name), array)
        assert "A: 1 2 3 at 100 Hz, 19997 samples" in repr(recording)
        assert "1 gap" in repr(recording)
        with pytest.raises(WrongSettingError, match="sensor='Z': expected one of A, B, C"):
            recording.samples("Z")
        assert [event.kind for event in recording.events] == []
        created = recording.created
        result = recording.estimate(start="20s", end=created.replace(minute=2), segment="2s")
        same = huddle.estimate(recording, start="20s", end="2min", segment="2s")
        np.testing.assert_array_equal(same.noise_psd, result.noise_psd)
    assert created == datetime(1970, 1, 1, tzinfo=UTC)
    assert result.snapshot.elapsed == pytest.approx(100)
    same = huddle.estimate([path], start=20.0, end="1970-01-01T00:02:00", segment="2s")
    np.testing.assert_array_equal(same.noise_psd, result.noise_psd)
    with pytest.raises(WrongSettingError, match="start='soon': expected UTC as in"):
        huddle.estimate(path, start="soon")


def test_files_are_estimated_as_their_import(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    motion = rng.normal(0, 1000, (10_000, 3))
    counts = {name: np.round(motion + rng.normal(0, 9, motion.shape)) for name in "ABC"}
    counts["B"] = counts["B"].astype(np.float64)
    counts["B"][700:750] = np.nan
    np.savez(tmp_path / "some.npz", sampling_rate=RATE, **counts)  # type: ignore[arg-type]
    command("import", str(tmp_path / "some.npz"), "--out", str(tmp_path / "some.h5"))
    expected = huddle.estimate(tmp_path / "some.h5", segment="2s")
    waveforms = huddle.read(tmp_path / "some.npz")
    for result in (waveforms.estimate(segment="2s"), huddle.self_noise(waveforms, segment="2s")):
        for name in ("noise_psd", "noise_low", "noise_high", "csm", "data_psd"):
            np.testing.assert_array_equal(getattr(result, name), getattr(expected, name))
    with huddle.open(tmp_path / "some.h5") as recording:
        for span in ({}, {"start": 6.5, "end": "8s"}, {"start": 7.2}, {"end": 7.1}, {"start": 900}):
            first, last = (
                int(100 * float(str(span.get(key, value)).rstrip("s")))
                for key, value in (("start", 0), ("end", 100))
            )
            for each in (recording, waveforms):
                for name, array in counts.items():
                    found = each.samples(name, **span)
                    np.testing.assert_array_equal(found, array[first:last])
    assert "A: 1 2 3 at 100 Hz, 10000 samples" in repr(waveforms)
    assert waveforms.calibrations[0] == "A.1: 1 counts per counts (none)"
    frame = waveforms.to_frame("B", start=6, end=9)
    assert (frame.index[1] - frame.index[0]).total_seconds() == 1 / RATE
    labelled = waveforms.to_xarray("B", start=6, end=9)
    assert labelled.attrs["units"] == "count"
    np.testing.assert_array_equal(labelled, frame)
    np.testing.assert_array_equal(labelled.time, frame.index)
    with pytest.raises(ArrayError, match=r"as arguments of huddle\.read"):
        huddle.self_noise(waveforms, fs=RATE)
    with pytest.raises(WrongSettingError, match=r"some\.h5: a recording; huddle\.open reads it"):
        huddle.read(tmp_path / "some.h5")
    with pytest.raises(WrongSettingError, match="expected at least one file"):
        huddle.read()


def test_read_takes_responses_by_code(tmp_path: Path) -> None:
    obspy = pytest.importorskip("obspy")
    inventory = obspy.read_inventory()
    stream = obspy.read()
    stream.write(str(tmp_path / "bw.mseed"), format="MSEED")
    inventory.write(str(tmp_path / "bw.xml"), format="STATIONXML")
    by_file = huddle.read(tmp_path / "bw.mseed", response=tmp_path / "bw.xml")
    by_object = huddle.read(tmp_path / "bw.mseed", response=inventory)
    (name,) = by_file.sensors
    assert by_file.units(name) == ("m/s",) * 3
    whole = by_file.samples(name)
    np.testing.assert_array_equal(whole, by_object.samples(name))
    trace = stream.select(channel=by_file.channels(name)[0])[0]
    gain = inventory.get_response(trace.id, trace.stats.starttime).instrument_sensitivity.value
    np.testing.assert_allclose(whole[:, 0], trace.data / gain, rtol=1e-3)
    frame = by_file.to_frame(name)
    assert frame.index[0].value == trace.stats.starttime.ns
    later = trace.stats.starttime + 1
    some = by_file.samples(name, start=later.datetime, end=(later + 2).datetime)
    np.testing.assert_array_equal(some, whole[100:300])


def test_a_simulation_is_estimated_from_memory_and_from_its_recording(tmp_path: Path) -> None:
    simulation = huddle.simulate("fig9", duration="2min")
    assert simulation.fs == {"i": 200.0, "j": 200.0, "k": 200.0}
    assert {array.shape for array in simulation.values()} == {(24_000, 2)}
    result = huddle.self_noise(simulation, fs=simulation.fs, sample_unit="m/s²", segment="1s")
    band = result.band(5, 60)
    inside = (result.frequency >= 5) & (result.frequency <= 60)
    truth = simulation.true_noise_psd(result.frequency[inside]).mean(axis=0)
    assert np.mean((band.noise_low < truth) & (truth < band.noise_high)) >= 5 / 6
    simulation.write(tmp_path / "fig9.h5")
    recording = huddle.open(tmp_path / "fig9.h5")
    assert recording.bench is not None
    for sensor in recording.bench.sensors:
        half_a_count = 0.5001 / sensor.channels[0].sensitivity
        found = recording.samples(sensor.name)
        np.testing.assert_allclose(found, simulation[sensor.name], rtol=0, atol=half_a_count)
    of_file = huddle.estimate(recording, segment="1s")
    np.testing.assert_allclose(of_file.band(5, 60).noise_psd, band.noise_psd, rtol=1e-3)


def test_a_simulation_has_a_seed_and_may_be_a_table() -> None:
    table = {
        "motion": {"spectra": [{"shape": "white", "level": 1e-9}]},
        "sensors": {name: {"noise": {"shape": "white", "level": 1e-13}} for name in "ABC"},
    }
    first, second, again = (
        huddle.simulate(table, duration=10, fs=50, seed=seed)["A"] for seed in (1, 2, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, second)
    with pytest.raises(ValueError, match="'fig99' is neither a file nor a scenario; expected"):
        huddle.simulate("fig99")
    with pytest.raises(ValueError, match="sampling_rate"):
        huddle.simulate(table, duration=10)
    with pytest.raises(WrongSettingError, match="duration='long': expected a positive duration"):
        huddle.simulate("fig9", duration="long")
    with pytest.raises(WrongSettingError, match="fs=50: fig9 has its own; expected no fs"):
        huddle.simulate("fig9", fs=50)


def test_a_plan_is_that_of_the_command(tmp_path: Path) -> None:
    bench = tmp_path / "bench.toml"
    command("init", "--out", str(bench))
    arguments = ("--snr", "250", "--cov", "0.05")
    printed = json.loads(command("plan", str(bench), *arguments, "--json", "-"))
    found = huddle.plan(bench, snr=250, cov=0.05)
    assert [entry.method for entry in found.values()] == [m["method"] for m in printed["methods"]]
    for entry, document in zip(found.values(), printed["methods"], strict=True):
        assert entry.duration == document["duration"]
        assert entry.bias.tolist() == document["bias"]
    assert repr(found).split() == command("plan", str(bench), *arguments).split()
    single = huddle.plan(snr=250, fs=200, segment="10s", channels=1)
    assert single.axes is not None
    assert single.axes.n_sensors == 6
    assert single.axes.share == pytest.approx(250 * (2.3 * np.radians(1)) ** 2)
    assert any("6 sensors determine this motion" in line for line in single.remarks)
    assert huddle.plan(snr=250, fs=200, segment="10s", sensors=7, channels=1).axes is None
    aligned = huddle.plan(snr=250, fs=200, segment="10s")
    assert "or use six sensors: five on a circle of 12 cm" in aligned.remarks[-1]
    four = huddle.plan(snr=250, fs=200, segment="10s", sensors=4)
    assert "no band is accepted" in four.remarks[-1]
    six = huddle.plan(snr=250, fs=200, segment="10s", sensors=6)
    assert "six sensors" not in six.remarks[-1]
    assert aligned.waves is not None
    assert six.waves is not None
    # long waves: bias in parts of the noise over SNR times (2 pi radius / wavelength)**2
    share = 0.01 / (250 * (2 * np.pi * 0.12 * aligned.waves.one_percent / 150) ** 2)
    assert 0.1 < share < 10
    # as good as six where they are best, to 10 %; three sensors have no bound
    assert abs(six.waves.cost / six.waves.cost_of_six - 1) < 0.1
    assert aligned.waves.cost == np.inf
    assert max(map(abs, aligned["three-channel"].bias)) < 1e-3
    for wrong, said in (
        ({"fs": None}, "fs=None: expected a sampling rate"),
        ({"fs": 200, "sensors": 0}, "sensors=0: expected a number from 1"),
        ({"bench": bench, "fs": 200, "overlap": 0}, "fs, overlap: expected in the bench file"),
    ):
        with pytest.raises(WrongSettingError, match=said):
            huddle.plan(snr=250, **wrong)


@pytest.mark.usefixtures("needs_obspy")
def test_commands_are_functions_with_their_numbers(tmp_path: Path) -> None:
    path = tmp_path / "fig9.h5"
    huddle.simulate("fig9", duration="15s").write(path)
    result = huddle.estimate(path, segment="1s")
    told = json.loads(command("calibrate", str(path), "--segment", "1s", "--json", "-"))
    found = huddle.calibrate(path, segment="1s")
    assert found.reference == 0
    again = huddle.calibrate(result, confidence=0.99)
    assert again.confidence == 0.99
    assert json.loads(json_text(calibration_document(found, result.snapshot))) == told
    for suffix in (".csv", ".npz", ".nc"):
        huddle.export(result, tmp_path / f"a{suffix}")
        kind = "netcdf" if suffix == ".nc" else suffix[1:]
        command("export", str(path), "--segment", "1s", "--format", kind, "-o",
                str(tmp_path / f"b{suffix}"))  # fmt: skip
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    with np.load(tmp_path / "a.npz") as ours, np.load(tmp_path / "b.npz") as theirs:
        for name in theirs:
            np.testing.assert_array_equal(ours[name], theirs[name])
    assert huddle.load(tmp_path / "a.nc").identical(huddle.load(tmp_path / "b.nc"))
    huddle.report(result, tmp_path / "a.html", models="nlnm")
    assert "NLNM" in (tmp_path / "a.html").read_text(encoding="utf-8")
    with pytest.raises(WrongSettingError, match=r"a\.xyz: expected a name that ends in \.csv"):
        huddle.export(result, tmp_path / "a.xyz")
    huddle.export(path, tmp_path / "a.mseed")
    command("export", str(path), "--format", "mseed", "-o", str(tmp_path / "b.mseed"))
    assert (tmp_path / "a.mseed").read_bytes() == (tmp_path / "b.mseed").read_bytes()
    again_read = huddle.read(tmp_path / "a.mseed", response=tmp_path / "a.xml")
    with huddle.open(path) as recording:
        for ours, theirs in zip(recording.sensors, again_read.sensors, strict=True):
            np.testing.assert_array_equal(recording.samples(ours), again_read.samples(theirs))
    with pytest.raises(WrongSettingError, match="expected its path in place of an estimate"):
        huddle.export(result, tmp_path / "c.mseed")
    with pytest.raises(WrongSettingError, match="segment with a Result"):
        huddle.calibrate(result, segment="1s")
    arrays = huddle.self_noise(triaxial(2000), fs=RATE, segment="1s")
    with pytest.raises(WrongSettingError, match="the estimate is of arrays"):
        huddle.report(arrays, tmp_path / "b.html")


def test_an_archive_answers_as_the_command(tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    for seed in (1, 2):
        huddle.simulate("fig9", duration="12s", seed=seed).write(folder / f"{seed}.h5")
    (folder / "broken.h5").write_bytes(b"no recording")
    ours = huddle.archive(folder, store=tmp_path / "ours", segment="1s")
    assert "broken.h5" in ours.problems[0]
    again = huddle.archive(store=tmp_path / "ours")
    (folder / "broken.h5").unlink()
    command("archive", str(folder), "--store", str(tmp_path / "theirs"), "--segment", "1s")
    theirs = huddle.archive(store=tmp_path / "theirs")
    assert not theirs.problems
    for each in (ours, again):
        for method, noise in theirs.pooled.results.items():
            np.testing.assert_array_equal(each.pooled.results[method].noise_psd, noise.noise_psd)
    with pytest.raises(WrongSettingError, match="stretch='week': expected one of"):
        huddle.archive(folder, stretch="week")
    with pytest.raises(WrongSettingError, match="time_zone='Nowhere'"):
        huddle.archive(folder, time_zone="Nowhere")
    with pytest.raises(huddle.HuddleError, match="no archive there"):
        huddle.archive(store=tmp_path / "none")


def test_an_archive_takes_waveform_files_by_station(tmp_path: Path) -> None:
    sds, store = tmp_path / "sds", tmp_path / "store"
    for seed, station in enumerate(("ABC", "DEF")):
        write_station(sds, station, days=0.5, seed=seed)
    options: EstimateOptions = {"segment": "60s", "method": "three-sensor"}
    with pytest.raises(WrongSettingError, match=r"2 stations: XX\.ABC XX\.DEF; expected one"):
        huddle.archive(f"sds://{sds}", store=store, **options)
    assert not store.exists()
    one = huddle.archive(f"sds://{sds}", store=store, channels=["XX.ABC.*"], **options)
    found = huddle.archive(f"sds://{sds}", store=store, by_station=True, **options)
    assert (list(found), found.problems) == (["XX.ABC", "XX.DEF"], ())
    again = huddle.archive(store=store, by_station=True)
    alone = huddle.archive(store=store / "XX.DEF")
    for ours, theirs in (
        (one, found["XX.ABC"]),
        (found["XX.DEF"], alone),
        (alone, again["XX.DEF"]),
    ):
        np.testing.assert_array_equal(ours.levels.mean, theirs.levels.mean)
    with pytest.raises(WrongSettingError, match="response: for waveform files"):
        huddle.archive(store=store, response="stations.xml")
    with pytest.raises(WrongSettingError, match="expected a path"):
        huddle.archive(f"sds://{sds}", store=store, response=object())
    with pytest.raises(huddle.HuddleError, match=r"no\.xml"):
        huddle.archive(f"sds://{sds}", store=store, by_station=True, response="no.xml")
