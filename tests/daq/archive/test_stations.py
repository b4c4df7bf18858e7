"""Archives of stations: days of waveform files are the unit of work, and no segment is lost."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from daq.archive.answers import answer
from daq.archive.execution import carried_out
from daq.archive.plan import Plan
from daq.archive.sources import are_waveforms
from daq.archive.spectra_file import SpectraFile
from daq.archive.stations import archives_in, begun, summaries, work
from daq.archive.store import Store
from daq.archive.waveforms import FILE, Contents, FileReading, FoundFiles, stations_in
from daq.errors import ImportFormatError, WrongArchiveError, WrongSettingError
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.importer import import_files
from daq.formats.sources import Selection
from tests.daq.archive.day_files import DAY_NS, FIRST_NS, ROWS, SETTINGS, append, write_station
from tests.daq.archive.months import assert_same, record

HOUR_NS = 3600 * 10**9
PLAIN = FileReading()


def found_in(
    source: str | Path,
    store: Path,
    selection: Selection | None = None,
    groups: Sequence[tuple[str, str]] = (),
) -> FoundFiles:
    """Return the stations of files."""
    known = Contents(store)
    found = stations_in(
        [source], selection or Selection(), groups=groups, known=known, segment=SETTINGS.segment
    )
    if store.is_dir():
        known.save()
    return found


def fill(
    source: str | Path,
    store: Path,
    *,
    jobs: int = 1,
    settings: Settings = SETTINGS,
    selection: Selection | None = None,
    groups: Sequence[tuple[str, str]] = (),
    reading: FileReading = PLAIN,
) -> tuple[dict[str, Store], int, list[str]]:
    """Take new days; returns the archives, how many days were new, and failures."""
    found = found_in(source, store, selection, groups)
    run = partial(carried_out, jobs=jobs)
    stores, failures = begun(
        store, found.stations, settings, "hour", reading=reading, run=run, check=repr
    )
    new = work(found.stations, stores, reading)
    outcomes = list(run(new.tasks(stores, reading)))
    failures += new.failures + [each.failure for each in outcomes if each.failure]
    return stores, new.n_days, failures


@pytest.fixture(scope="module")
def sds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write day files of two stations, of more than two days."""
    root = tmp_path_factory.mktemp("sds")
    write_station(root, "ABC", days=2.2, seed=1)
    write_station(root, "DEF", days=2.0, seed=2, gap=(0.5, 1.01))
    return root


@pytest.fixture(scope="module")
def filled(sds: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Store]:
    """Make archives of both, for tests that only read."""
    stores, n_days, failures = fill(f"sds://{sds}", tmp_path_factory.mktemp("store"))
    assert (n_days, failures) == (5, [])
    return stores


def test_days_have_the_segments_of_one_recording(
    sds: Path, filled: dict[str, Store], tmp_path: Path
) -> None:
    """None is lost at midnight, though records straddle it, and none is counted twice."""
    whole = tmp_path / "whole.h5"
    import_files([f"sds://{sds}"], whole, selection=Selection(stations="ABC"))
    settings = replace(SETTINGS, equalise="off", bridge=0.0)
    direct = estimate([whole], settings)
    store = filled["XX.ABC"]
    pooled = answer(store, store.entries()[0], SETTINGS).pooled
    assert pooled.n_segments == direct.n_segments == (190_080 - 60) // 30 + 1
    np.testing.assert_allclose(pooled.data_psd, direct.data_psd, rtol=1e-12)
    one, two = (each.results["three-sensor"].noise_psd for each in (pooled, direct))
    # effective averages are added by days, without the overlap of segments at midnight
    np.testing.assert_allclose(one, two, rtol=1e-8)


def test_a_day_has_the_stretches_of_its_hours_only(filled: dict[str, Store]) -> None:
    hours = []
    for entry in filled["XX.ABC"].entries()[0]:
        with SpectraFile(entry.path) as file:
            starts = (file.stretches["start_utc_ns"] - FIRST_NS) // HOUR_NS
        assert entry.path.name == f"{entry.described.origin.run_id}.h5"
        hours.append(starts.tolist())
    assert hours == [list(range(24)), list(range(24, 48)), list(range(48, 53))]


@pytest.mark.long
def test_several_processes_write_the_same_values(
    sds: Path, filled: dict[str, Store], tmp_path: Path
) -> None:
    one = Selection(stations="DEF")
    stores, n_days, failures = fill(f"sds://{sds}", tmp_path / "store", jobs=2, selection=one)
    assert (list(stores), n_days, failures) == (["XX.DEF"], 2, [])
    assert_same(stores["XX.DEF"], filled["XX.DEF"])


def test_files_in_a_folder_are_as_good_as_sds(
    sds: Path, filled: dict[str, Store], tmp_path: Path
) -> None:
    for file in sds.rglob("*.D.*"):
        shutil.copy2(file, tmp_path / f"{file.name}.mseed")
    (tmp_path / "notes.txt").write_text("no waveforms")
    assert are_waveforms([str(tmp_path)])
    (tmp_path / "huddle-archive").mkdir()
    stores, n_days, failures = fill(tmp_path, tmp_path / "huddle-archive")
    assert (n_days, failures) == (5, [])
    for name, store in stores.items():
        for entry, other in zip(store.entries()[0], filled[name].entries()[0], strict=True):
            with SpectraFile(entry.path) as one, SpectraFile(other.path) as two:
                assert entry.n_segments == other.n_segments
                for row in range(len(one.stretches)):
                    np.testing.assert_array_equal(one.csm(row), two.csm(row))
    assert (tmp_path / "huddle-archive" / FILE).exists()
    (tmp_path / "huddle-archive" / FILE).write_bytes(b"no database")
    assert fill(tmp_path, tmp_path / "huddle-archive")[1:] == (0, [])


def test_grown_days_and_those_beside_them_are_taken_again(tmp_path: Path) -> None:
    root, store = tmp_path / "sds", tmp_path / "store"
    write_station(root, days=1.2)
    assert fill(f"sds://{root}", store)[1] == 2
    assert fill(f"sds://{root}", store)[1] == 0
    for location in ("00", "10", "20"):
        counts = np.arange(ROWS, dtype=np.int32)
        append(root, "ABC", location, FIRST_NS + round(1.5 * DAY_NS), counts)
    stores, n_days, failures = fill(f"sds://{root}", store)
    assert (n_days, failures) == (2, [])  # the segment at midnight is of both
    assert len(stores["XX.ABC"].entries()[0]) == 2


def test_days_without_all_channels_are_named_and_the_others_taken(tmp_path: Path) -> None:
    root = tmp_path / "sds"
    write_station(root, days=2.1)
    (gone,) = root.rglob("*.10.LHZ.D.2026.001")
    gone.unlink()
    stores, n_days, failures = fill(f"sds://{root}", tmp_path / "store")
    assert n_days == 2
    assert failures == ["XX.ABC: 1 of 3 days left out (2026-01-01): no file of XX.ABC.10.LHZ"]
    assert len(stores["XX.ABC"].entries()[0]) == 2


def test_sensors_of_several_stations_are_one_group(tmp_path: Path) -> None:
    root = tmp_path / "sds"
    for number, station in enumerate(("A1", "A2", "A3", "B")):
        write_station(root, station, days=0.1, locations=("",), seed=number)
    found = found_in(f"sds://{root}", tmp_path)
    assert (found.stations, found.alone) == ([], ["XX.A1", "XX.A2", "XX.A3", "XX.B"])
    stores, _, failures = fill(f"sds://{root}", tmp_path / "store", groups=[("LAB", "XX.A?")])
    assert failures == []
    assert [name for name, _ in stores["LAB"].plan.sensors] == ["XX.A1", "XX.A2", "XX.A3"]
    assert archives_in(tmp_path / "store") == [tmp_path / "store" / "LAB"]


def test_the_span_of_time_takes_whole_days(sds: Path, tmp_path: Path) -> None:
    noon = FIRST_NS + 3 * DAY_NS // 2
    selection = Selection(stations="ABC", start_ns=noon, end_ns=noon + 1)
    stores, n_days, _ = fill(f"sds://{sds}", tmp_path, selection=selection)
    assert n_days == 1
    (entry,) = stores["XX.ABC"].entries()[0]
    assert (entry.described.origin.run_id, entry.n_segments) == ("2026-01-02", 2880)
    assert fill(f"sds://{sds}", tmp_path, selection=Selection(stations="ABC"))[1] == 2


def test_what_is_wrong_is_said_before_there_is_a_folder(sds: Path, tmp_path: Path) -> None:
    def refuse(plan: Plan) -> None:
        raise WrongSettingError(plan.sensors[0][1][0][1])

    stations = found_in(f"sds://{sds}", tmp_path).stations
    about = {"reading": FileReading(), "run": carried_out}
    with pytest.raises(WrongSettingError, match="counts"):
        begun(tmp_path, stations, SETTINGS, "hour", check=refuse, **about)  # type: ignore[arg-type]  # of several types
    wrong = replace(SETTINGS, segment=7200.0)
    with pytest.raises(WrongSettingError, match="choose --stretch day"):
        begun(tmp_path, stations, wrong, "hour", check=repr, **about)  # type: ignore[arg-type]  # of several types
    assert not list(tmp_path.iterdir())
    with pytest.raises(ImportFormatError, match="no such"):
        found_in(tmp_path / "none", tmp_path)


def test_recordings_and_waveforms_do_not_share_an_archive(sds: Path, tmp_path: Path) -> None:
    path = record(tmp_path / "one.h5", hours=0.1)
    assert not are_waveforms([str(path)])
    assert not are_waveforms([])
    with pytest.raises(WrongArchiveError, match="not both"):
        are_waveforms([str(path), f"sds://{sds}"])


def test_a_station_is_summed_up_by_a_task(filled: dict[str, Store]) -> None:
    settings = dict.fromkeys(filled, SETTINGS)
    outcomes = list(carried_out(summaries(filled, settings, "UTC", 0.01)))
    assert [(each.source, each.failure, each.problems) for each in outcomes] == [
        ("XX.ABC", "", ()), ("XX.DEF", "", ()),
    ]  # fmt: skip
    (summary, _) = (each.summary for each in outcomes)
    assert summary is not None
    truth = 10 * np.log10(2 / 1.0 * (20.0**2 + 1 / 12))
    assert (summary["n_days"], summary["n_channels"], summary["unit"]) == (3, 3, "counts")
    assert truth - 0.3 < summary["lowest_db"] <= summary["highest_db"] < truth + 0.3


def test_a_response_may_change_at_midnight(tmp_path: Path) -> None:
    """And a day whose response has changed in the file is taken again, but no other."""
    obspy = pytest.importorskip("obspy")
    root, xml = tmp_path / "sds", tmp_path / "stations.xml"
    write_station(root, days=1.2)
    inventory = obspy.read_inventory()
    template = inventory[0][0][0]
    midnight = obspy.UTCDateTime((FIRST_NS + DAY_NS) // 10**9)
    epochs = []
    for location in ("00", "10", "20"):
        for gain, begin, end in ((1.0, midnight - 1e6, midnight), (2.0, midnight, None)):
            channel = copy.deepcopy(template)
            channel.code, channel.location_code = "LHZ", location
            channel.start_date, channel.end_date = begin, end
            channel.response.response_stages[0].stage_gain *= gain
            channel.response.instrument_sensitivity.value *= gain
            epochs.append(channel)
    inventory.networks = inventory.networks[:1]
    inventory.networks[0].code = "XX"
    inventory.networks[0].stations = inventory.networks[0].stations[:1]
    inventory.networks[0].stations[0].code = "ABC"
    inventory.networks[0].stations[0].channels = epochs
    inventory.write(str(xml), "STATIONXML")
    reading = FileReading(response=(str(xml),))
    stores, n_days, failures = fill(f"sds://{root}", tmp_path / "store", reading=reading)
    assert (n_days, failures) == (2, [])
    before, after = (
        entry.described.channels[0][1].sensitivity for entry in stores["XX.ABC"].entries()[0]
    )
    assert after == pytest.approx(2 * before)
    late = [channel for channel in epochs if channel.end_date is None]
    inventory.source = "another writer"
    inventory.write(str(xml), "STATIONXML")
    assert fill(f"sds://{root}", tmp_path / "store", reading=reading)[1:] == (0, [])
    late[1].response.response_stages[0].stage_gain *= 3.0
    late[1].response.instrument_sensitivity.value *= 3.0
    inventory.write(str(xml), "STATIONXML")
    stores, n_days, failures = fill(f"sds://{root}", tmp_path / "store", reading=reading)
    assert (n_days, failures) == (1, [])
    gains = [
        [channel.sensitivity / before for _, channel in entry.described.channels]
        for entry in stores["XX.ABC"].entries()[0]
    ]
    np.testing.assert_allclose(gains, [[1, 1, 1], [2, 6, 2]])
    assert fill(f"sds://{root}", tmp_path / "store", reading=reading)[1:] == (0, [])
    assert fill(f"sds://{root}", tmp_path / "store")[1:] == (0, [])  # responses of before stay
