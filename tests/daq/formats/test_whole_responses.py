"""Whole responses against evalresp, through a recording and an export, and from several files."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal

from benchmarks.studies.shipped import (
    AGREED,
    BEYOND,
    BOTH_REFUSE,
    OURS_REFUSES,
    USED,
    by_evalresp,
    evaluated,
    response_files,
)
from daq.bench.response import Fir, GainStage, Measured, Response, response_from_json
from daq.errors import ImportFormatError
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.importer import ImportResult, import_files
from daq.formats.miniseed_export import export_miniseed
from daq.formats.response import Responses, whole_response
from daq.recording.reader import Recording

obspy: Any = pytest.importorskip("obspy", reason="ObsPy is an extra")
SHIPPED = Path(obspy.__file__).parent
RATE = 50.0


def shipped_response_files() -> list[Path]:
    """Return the RESP and StationXML files that ObsPy ships."""
    return list(response_files(SHIPPED))


def test_every_shipped_response_is_that_of_evalresp_or_refused_by_name() -> None:
    found = Counter[str]()
    reasons = r"stage \d+ takes|the last stage gives V|by A0 with its poles|expected a gain for"
    for path in shipped_response_files():
        try:
            epochs = Responses([path])._epochs  # noqa: SLF001 - every epoch of a file
        except ImportFormatError as error:
            assert str(path) in str(error)  # noqa: PT017 - refused by name, whatever is wrong
            continue
        for epoch in epochs:
            what, more = evaluated(epoch)
            assert what != BEYOND, more
            found[what] += 1
            if what in {OURS_REFUSES, BOTH_REFUSE}:
                assert epoch.name in more
                assert re.search(reasons, more), more
    assert found[AGREED] >= 160


@pytest.mark.parametrize("symmetry", ["none", "odd", "even"])
def test_a_filter_has_the_transform_of_its_coefficients(symmetry: Any) -> None:  # noqa: ANN401 - a literal
    rng = np.random.default_rng(3)
    half = rng.normal(size=7)
    whole = {
        "none": half,
        "odd": np.concatenate([half, half[-2::-1]]),
        "even": np.concatenate([half, half[::-1]]),
    }[symmetry]
    frequency = np.linspace(0, 50, 101)
    _, expected = signal.freqz(whole, worN=frequency, fs=100.0)
    stage = Fir(1.0, tuple(half), symmetry, 100.0)
    delay = 0.0 if symmetry == "none" else (len(whole) - 1) / 2 / 100.0
    found = stage.shape(frequency) * np.exp(-2j * np.pi * frequency * delay)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    late = replace(stage, symmetry="none", coefficients=tuple(whole), correction=0.03)
    np.testing.assert_allclose(
        late.shape(frequency), expected * np.exp(2j * np.pi * frequency * 0.03), atol=1e-12
    )


def test_nothing_is_known_beyond_a_list() -> None:
    stage = Measured(2.0, (1.0, 2.0, 3.0, 4.0, 5.0), (1.0,) * 5, (0.5,) * 5)
    values = Response((stage, GainStage(10.0)), 2.0).at(np.array([0.5, 1.0, 3.3, 5.0, 6.0]))
    np.testing.assert_allclose(values[1:4], np.exp(0.5j))
    assert np.isnan(values[[0, 4]]).all()


def recorded(tmp_path: Path, resp: Path, rate: float) -> tuple[Response, float, ImportResult]:
    """Import noise with a response, and return what the recording holds of it."""
    trace = obspy.Trace(
        np.random.default_rng(1).integers(-1000, 1000, 2000).astype(np.int32),
        {
            "network": "YY",
            "station": "NEW",
            "channel": "BHZ",
            "sampling_rate": rate,
            "starttime": obspy.UTCDateTime("2012-06-01"),
        },
    )
    trace.write(str(tmp_path / "a.mseed"), format="MSEED")
    result = import_files(
        [tmp_path / "a.mseed"], tmp_path / "a.h5", response_for=[("YY.NEW", resp)]
    )
    with Recording.open(tmp_path / "a.h5") as recording:
        (channel,) = recording.sensors[0].channels
        assert recording.bench is not None
        assert len(recording.bench.text) < 1000  # hundreds of coefficients are no text for people
        export_miniseed(recording, tmp_path / "b.mseed", tmp_path / "b.xml")
    assert isinstance(channel.response, Response)
    return channel.response, channel.sensitivity, result


@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("io/xseed/tests/data/RESP.NZ.CRLZ.10.HHZ", 100.0),  # five FIR stages, one a boxcar
        ("io/stationxml/tests/data/IM_IL31__BHZ.xml", 40.0),  # a list
        ("io/nrl/tests/data/6D6-Trillium-250sps.resp", 250.0),
    ],
)
def test_all_stages_pass_through_a_recording_and_an_export(
    tmp_path: Path, name: str, rate: float
) -> None:
    found = [path for path in shipped_response_files() if path.name == Path(name).name]
    shape, sensitivity, result = recorded(tmp_path, found[0], rate)
    (epoch, *_) = Responses([found[0]])._epochs  # noqa: SLF001
    frequency = np.geomspace(0.05, USED * rate, 200)
    theirs = by_evalresp(epoch.raw.response, frequency)
    assert theirs is not None
    ours = sensitivity * shape.at(frequency)
    known = np.isfinite(ours)
    np.testing.assert_allclose(np.abs(ours[known] / theirs[known]), 1, atol=1e-3)
    assert response_from_json(shape.to_json()) == shape
    assert shape.described in result.calibrations[0].notes
    again = obspy.read_inventory(str(tmp_path / "b.xml"), format="STATIONXML")
    exported = by_evalresp(again[0][0][0].response, frequency)
    assert exported is not None
    np.testing.assert_allclose(exported[known], ours[known], rtol=1e-6)
    (third,) = Responses([tmp_path / "b.xml"])._epochs  # noqa: SLF001
    back = whole_response([third])
    np.testing.assert_allclose(back.sensitivity * back.shape.at(frequency), ours, rtol=1e-9)


def halves(folder: Path) -> tuple[Path, Path]:
    """Write StationXML of a sensor and of a digitizer, as the nominal response library has them."""
    inventory = obspy.core.inventory
    about = {
        "stage_sequence_number": 1,
        "stage_gain_frequency": 1.0,
    }
    sensor = inventory.PolesZerosResponseStage(
        **about,
        stage_gain=750.0,
        input_units="M/S",
        output_units="V",
        pz_transfer_function_type="LAPLACE (RADIANS/SECOND)",
        normalization_frequency=10.0,
        zeros=[0, 0],
        poles=[-0.2 + 0.2j, -0.2 - 0.2j],
        normalization_factor=3.0,  # wrong, and not trusted
    )
    digitizer = inventory.FIRResponseStage(
        **about,
        stage_gain=4e5,
        input_units="V",
        output_units="COUNTS",
        symmetry="NONE",
        coefficients=list(signal.firwin(31, 0.5)),
        decimation_input_sample_rate=2 * RATE,
        decimation_factor=2,
        decimation_offset=0,
        decimation_delay=0.15,
        decimation_correction=0.15,
    )
    paths = []
    for name, stage, value in (("sensor", sensor, 750.0), ("digitizer", digitizer, 4e5)):
        stated = inventory.InstrumentSensitivity(value, 1.0, stage.input_units, stage.output_units)
        response = inventory.Response(instrument_sensitivity=stated, response_stages=[stage])
        channel = inventory.Channel("XXX", "", 0, 0, 0, 0, response=response, sample_rate=RATE)
        station = inventory.Station(name.upper()[:5], 0, 0, 0, channels=[channel])
        path = folder / f"{name}.xml"
        found = inventory.Inventory([inventory.Network("NR", [station])], source="test")
        found.write(str(path), format="STATIONXML")
        paths.append(path)
    return paths[0], paths[1]


def test_motion_through_filters_is_the_motion_again(tmp_path: Path) -> None:
    """Counts made by scipy from known motion: the estimate's spectrum is that of the motion."""
    sensor, digitizer = halves(tmp_path)
    rng = np.random.default_rng(7)
    motion = rng.normal(size=240_000)  # at 100 Hz: 0.02 (m/s)²/Hz
    analog = signal.bilinear([1, 0, 0], np.poly([-0.2 + 0.2j, -0.2 - 0.2j]), fs=2 * RATE)
    volts = 750.0 * signal.lfilter(*analog, motion)
    counts = 4e5 * np.convolve(volts, signal.firwin(31, 0.5), "same")[::2]
    other = rng.normal(size=len(counts))
    np.savez(tmp_path / "a.npz", sampling_rate=RATE, A=counts, B=counts + 1e3 * other)
    result = import_files(
        [tmp_path / "a.npz"],
        tmp_path / "a.h5",
        response_for=[("*", sensor), ("*", digitizer)],
    )
    (first, _) = result.calibrations
    assert first.sensitivity == pytest.approx(3e8, rel=2e-3)  # the filter at 1 Hz
    assert any("A0 differs from the file by" in note for note in first.notes)
    assert any(re.fullmatch(r"ripple \d+\.\d\d dB up to 20 Hz", note) for note in first.notes)
    snapshot = estimate(
        [tmp_path / "a.h5"], Settings(unit="m/s", segment=20.0, methods=("two-channel",))
    )
    used = (snapshot.frequency > 0.5) & (snapshot.frequency < USED * RATE)
    for channel in range(2):
        level = 10 * np.log10(np.mean(snapshot.data_psd[used, channel]) / 0.02)
        assert abs(level) < 0.1  # by the number of averages; the filter alone takes 1.5 dB
        high = used & (snapshot.frequency > 17)
        assert abs(10 * np.log10(np.mean(snapshot.data_psd[high, channel]) / 0.02)) < 0.2


def test_halves_that_are_missing_are_named(tmp_path: Path) -> None:
    sensor, digitizer = halves(tmp_path)
    np.savez(tmp_path / "a.npz", sampling_rate=RATE, A=np.arange(100))
    for given, lacks in (([sensor], "digitizer"), ([digitizer], "sensor")):
        with pytest.raises(ImportFormatError, match=rf"A\.1: no response of a {lacks} in .*xml"):
            import_files(
                [tmp_path / "a.npz"],
                tmp_path / "a.h5",
                response_for=[("A", each) for each in given],
            )
    with pytest.raises(ImportFormatError, match=r"A\.1: 2 responses of a sensor"):
        import_files(
            [tmp_path / "a.npz"],
            tmp_path / "a.h5",
            response_for=[("A", sensor), ("A.*", sensor), ("*", digitizer)],
        )


def test_a_channel_that_was_not_asked_for_may_have_any_response(tmp_path: Path) -> None:
    """A polynomial of state of health, or a stage in the wrong unit, concerns itself alone."""
    path = next(
        p for p in shipped_response_files() if p.name == "TM.SKLT.__.BHZ_faulty_response.xml"
    )
    inventory = obspy.read_inventory(str(path), format="STATIONXML")
    good = obspy.read_inventory(
        str(next(p for p in shipped_response_files() if p.name == "IM_IL31__BHZ.xml")),
        format="STATIONXML",
    )
    folder = tmp_path / "responses"
    folder.mkdir()
    (inventory + good).write(str(folder / "all.xml"), format="STATIONXML")
    (folder / "README").write_text("no response")
    responses = Responses([folder])
    found = responses.of("IM.IL31", "BHZ")
    assert found is not None
    assert "1 list" in found.notes
    with pytest.raises(ImportFormatError, match=r"TM\.SKLT\.BHZ.*stage 2 takes M/S"):
        responses.of("TM.SKLT", "BHZ")


SOME_NS = 1_700_000_000 * 10**9


def test_two_files_of_one_code_are_refused_if_they_differ(tmp_path: Path) -> None:
    path = next(p for p in shipped_response_files() if p.name == "IM_IL31__BHZ.xml")
    other = tmp_path / "other.xml"
    text = path.read_text(encoding="utf-8")
    other.write_text(text)
    assert Responses([path, other]).of("IM.IL31", "BHZ") is not None
    value = re.search(r"<StageGain>\s*<Value>([^<]*)", text)
    assert value is not None
    other.write_text(text.replace(f"<Value>{value[1]}", f"<Value>{2 * float(value[1])}"))
    both = obspy.read_inventory(str(path)) + obspy.read_inventory(str(other))
    both.write(str(tmp_path / "both.xml"), format="STATIONXML")
    for given in ([path, other], [tmp_path / "both.xml"]):
        with pytest.raises(ImportFormatError, match="several that differ for one time"):
            Responses(given).of("IM.IL31", "BHZ", [(SOME_NS, SOME_NS + 10**9)])
