"""The whole response, of the epoch in which the data were taken; what does not fit is named."""

from __future__ import annotations

import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.errors import ImportFormatError
from daq.formats.importer import import_files
from daq.formats.response import ChannelResponse, Responses
from daq.recording.reader import Recording
from tests.traced_memory import peak_of

obspy: Any = pytest.importorskip("obspy", reason="ObsPy is an extra")
RATE = 50.0
EPOCHS = [
    ("2020-01-01", "2025-06-01", 1000.0),
    ("2025-06-01", "2027-01-01", 2000.0),
    ("2027-01-01", None, 9999.0),
]


def station_file(path: Path, epochs: list[tuple[str, str | None, float]], **rest: object) -> Path:
    """Write StationXML of one channel with these starts, ends and gains."""
    inventory = obspy.core.inventory
    channels = []
    for start, end, gain in epochs:
        response = inventory.Response.from_paz(
            **{
                "zeros": [0j, 0j],
                "poles": [-0.2 + 0.2j, -0.2 - 0.2j],
                "stage_gain": gain,
                "input_units": "M/S",
                "output_units": "COUNTS",
            }
            | rest
        )
        dates = {"start_date": obspy.UTCDateTime(start)}
        dates |= {"end_date": obspy.UTCDateTime(end)} if end else {}
        channels.append(
            inventory.Channel("HHZ", "00", 0, 0, 0, 0, response=response, sample_rate=RATE, **dates)
        )
    network = inventory.Network("XX", [inventory.Station("ABC", 0, 0, 0, channels=channels)])
    inventory.Inventory([network], source="test").write(str(path), format="STATIONXML")
    return path


def waveform(path: Path, *starts: str) -> Path:
    """Write miniSEED of noise, a minute from each instant."""
    rng = np.random.default_rng(1)
    about = {"network": "XX", "station": "ABC", "location": "00", "channel": "HHZ"}
    traces = [
        obspy.Trace(
            rng.normal(0, 1e5, 3000).astype(np.int32),
            about | {"sampling_rate": RATE, "starttime": obspy.UTCDateTime(start)},
        )
        for start in starts
    ]
    obspy.Stream(traces).write(str(path), format="MSEED")
    return path


def sensitivity(folder: Path, epochs: list[tuple[str, str | None, float]], *starts: str) -> float:
    out = folder / "out.h5"
    out.unlink(missing_ok=True)
    source = waveform(folder / "a.mseed", *starts)
    import_files([source], out, response=station_file(folder / "s.xml", epochs))
    with Recording.open(out) as recording:
        return round(recording.sensors[0].channels[0].sensitivity, 1)  # A0 is 2e-6 off


def taken(path: Path, at: str = "2026-01-10") -> ChannelResponse:
    """Return the response that data of a minute take."""
    start = int(obspy.UTCDateTime(at).ns)
    found = Responses([path]).of("XX.ABC.00", "HHZ", [(start, start + 60 * 10**9)])
    assert found is not None
    return found


@pytest.mark.parametrize(("order", "ends"), [(1, False), (-1, True)])
def test_the_epoch_of_the_data_counts(tmp_path: Path, order: int, *, ends: bool) -> None:
    epochs = [(start, end if ends else None, gain) for start, end, gain in EPOCHS[::order]]
    assert sensitivity(tmp_path, epochs, "2026-01-10") == 2000
    assert sensitivity(tmp_path, epochs, "2024-01-10", "2025-01-10") == 1000
    assert sensitivity(tmp_path, epochs, "2031-01-10") == 9999


def test_a_change_within_the_data_is_refused_with_its_date(tmp_path: Path) -> None:
    for starts in (["2025-05-31T23:59:30"], ["2025-05-01", "2025-07-01"]):
        with pytest.raises(ImportFormatError, match="HHZ changes on 2025-06-01, within the data"):
            sensitivity(tmp_path, EPOCHS, *starts)
    same = [(start, end, 7.0) for start, end, _ in EPOCHS]
    assert sensitivity(tmp_path, same, "2025-05-01", "2025-07-01") == 7


def test_dates_of_epochs_may_be_off_by_less_than_a_second(tmp_path: Path) -> None:
    late = [("2020-01-01T00:00:00.9", "2025-06-01", 1000.0), *EPOCHS[1:]]
    assert sensitivity(tmp_path, late, "2020-01-01") == 1000
    assert sensitivity(tmp_path, EPOCHS, "2025-05-31T23:59:00.5") == 1000


def test_data_without_a_response_at_their_time_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ImportFormatError, match=r"from 2019-12-01 to 2019-12-01T00:00:59"):
        sensitivity(tmp_path, EPOCHS, "2019-12-01")
    with pytest.raises(ImportFormatError, match="is known for 2020-01-01 to 2025-06-01;"):
        sensitivity(tmp_path, EPOCHS[:1], "2026-01-10")


def test_data_without_a_date_take_the_only_epoch(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", sampling_rate=RATE, s=np.arange(100))
    with pytest.raises(ImportFormatError, match="the data have no date"):
        import_files(
            [tmp_path / "a.npz"],
            tmp_path / "a.h5",
            response_for=[("s.*", station_file(tmp_path / "s.xml", EPOCHS))],
        )
    only = station_file(tmp_path / "s.xml", EPOCHS[1:2])
    import_files([tmp_path / "a.npz"], tmp_path / "a.h5", response_for=[("s", only)])
    with Recording.open(tmp_path / "a.h5") as recording:
        assert recording.sensors[0].channels[0].sensitivity == pytest.approx(2000, rel=1e-5)


def test_a_gain_holds_at_its_own_frequency(tmp_path: Path) -> None:
    path = station_file(
        tmp_path / "s.xml", EPOCHS[1:2], stage_gain_frequency=0.05, normalization_frequency=1.0
    )
    response = taken(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (channel,) = obspy.read_inventory(str(path), format="STATIONXML")[0][0]
    at = np.array([0.02, 0.05, 1.0, 10.0])
    theirs = channel.response.get_evalresp_response_for_frequencies(at, output="DEF")
    ours = response.sensitivity * response.shape.at(at)
    np.testing.assert_allclose(np.abs(ours), np.abs(theirs), rtol=1e-3)  # 0.01 dB


def changed(path: Path, old: str, new: str) -> Path:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_a_sensitivity_that_misses_its_stages_is_said(tmp_path: Path) -> None:
    path = station_file(tmp_path / "s.xml", EPOCHS[1:2])
    assert taken(path).notes == ("2 poles, 2 zeros",)
    head, _, rest = path.read_text(encoding="utf-8").partition("<InstrumentSensitivity>")
    value = rest[rest.index("<Value>") : rest.index("</Value>")]
    rest = rest.replace(value, "<Value>2230", 1)
    path.write_text(f"{head}<InstrumentSensitivity>{rest}", encoding="utf-8")
    response = taken(path)
    assert response.sensitivity == pytest.approx(2000, rel=0.01)
    (said,) = response.notes[1:]
    assert said.startswith("the file's sensitivity, 2230, misses its stages by 12%")


def test_units_that_do_not_meet_are_refused(tmp_path: Path) -> None:
    path = station_file(tmp_path / "s.xml", EPOCHS[1:2], output_units="V")
    with pytest.raises(
        ImportFormatError, match=r"HHZ: no response of a digitizer in .*s\.xml; expected"
    ):
        taken(path)


def test_an_input_that_is_no_motion_is_said(tmp_path: Path) -> None:
    path = changed(station_file(tmp_path / "s.xml", EPOCHS[1:2]), "M/S", "PA")
    response = taken(path)
    assert response.unit == "pa"
    assert "its input is in 'PA', which is no unit of motion" in response.notes


def test_entities_are_not_resolved(tmp_path: Path) -> None:
    path = station_file(tmp_path / "s.xml", EPOCHS)
    changed(
        path, "<FDSNStationXML", '<!DOCTYPE x [<!ENTITY e SYSTEM "/etc/passwd">]><FDSNStationXML'
    )
    with pytest.raises(ImportFormatError, match="declares entities"):
        taken(path)


def test_an_archive_behind_a_response_is_not_unpacked(tmp_path: Path) -> None:
    path = station_file(tmp_path / "s.xml", EPOCHS)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb", bytes(100 << 20))

    def read() -> None:
        with pytest.raises(ImportFormatError, match="ObsPy cannot read it"):
            taken(path)

    assert peak_of(read) < 50 << 20
