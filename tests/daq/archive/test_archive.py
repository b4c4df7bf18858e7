"""An archive: what it keeps equals the estimate, however it was made, and whatever happened."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from daq.archive import task
from daq.archive.answers import Answer, answer
from daq.archive.density import LOWEST_DB, Density
from daq.archive.execution import carried_out, is_exposed, tasks_of
from daq.archive.facts import AbsencesNotUsed, ResponsesVary, facts_of_archive
from daq.archive.index import FILE as INDEX
from daq.archive.index import ROLLUP
from daq.archive.sources import recordings_in, sort
from daq.archive.spectra_file import SpectraFile, SpectraWriter
from daq.archive.store import PLAN_FILE, Store
from daq.archive.task import Task
from daq.bench.sensitivity import KnownSensitivity
from daq.bench.units import STANDARD_GRAVITY
from daq.errors import ArchiveError, RecordingError, WrongArchiveError, WrongSettingError
from daq.estimation import snapshot_builder
from daq.estimation.contributions import contributions
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.protocols.block import HostTime
from daq.results.facts.recordings import SpanShortened
from estimator.levels.contributions import Source
from estimator.spectra.segment_rejection import Reason
from tests import known_clocks
from tests.daq.archive.months import (
    HOUR_NS,
    RATE,
    SETTINGS,
    START_NS,
    assert_same,
    content,
    fill,
    record,
    store_for,
    three,
)

SNR = 25.0**2
"""Of the recordings: rounding of the motion's spectra counts so many times in the noise's."""


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return three(tmp_path_factory.mktemp("recordings"))


@pytest.fixture(scope="module")
def store(paths: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Make an archive of all recordings, for tests that only read."""
    made = store_for(tmp_path_factory.mktemp("archive"), paths[0])
    assert fill(made, paths) == []
    return made


@pytest.fixture
def copy(store: Store, tmp_path: Path) -> Store:
    """Make an archive of all recordings, for tests that change it."""
    shutil.copytree(store.folder, tmp_path / "copy")
    return replace(store, folder=tmp_path / "copy")


@pytest.mark.parametrize(
    ("free", "settings", "stretch"),
    [
        (False, SETTINGS, "day"),
        pytest.param(True, replace(SETTINGS, reject=True), "hour", marks=pytest.mark.long),
    ],
)
def test_the_pooled_estimate_is_that_of_all_recordings(
    tmp_path: Path, *, free: bool, settings: Settings, stretch: str
) -> None:
    paths = three(tmp_path, hours=0.6, free=free)[: 2 if free else 3]
    store = store_for(tmp_path / "store", paths[0], settings, stretch)
    assert fill(store, paths) == []
    entries, bad = store.entries()
    pooled = answer(store, entries, settings).pooled
    direct = estimate(paths, replace(settings, equalise="off", bridge=0.0))
    assert not bad
    assert (pooled.n_segments, pooled.n_dropped) == (direct.n_segments, direct.n_dropped)
    assert pooled.n_effective == pytest.approx(direct.n_effective, rel=1e-12)
    assert pooled.left_out == direct.left_out
    rounding = 1000 * SNR * np.finfo(float).eps
    own, whole = pooled.results["three-sensor"], direct.results["three-sensor"]
    np.testing.assert_allclose(own.noise_psd, whole.noise_psd, rtol=rounding)
    assert not np.any(own.high < whole.high * (1 - rounding))
    if not free:
        assert not np.any(own.low > whole.low + rounding * np.abs(whole.low))


def test_stretches_are_whole_hours_of_utc(store: Store) -> None:
    starts = []
    for entry in store.entries()[0]:
        with SpectraFile(entry.path) as file:
            starts.append((file.stretches["start_utc_ns"] - START_NS) / HOUR_NS)
            csm = file.csm(0)
            assert np.array_equal(csm, csm.swapaxes(1, 2).conj())
    assert [list(each) for each in starts] == [[0, 1, 2], [9, 10, 11], [24, 25, 26]]


@pytest.mark.long
def test_processes_that_were_interrupted_and_resumed_write_the_same_bytes(
    paths: list[Path], store: Store, tmp_path: Path
) -> None:
    other = store_for(tmp_path / "other", paths[0])
    outcomes = carried_out(tasks_of(other, sort(paths, ()).new), jobs=2)
    assert next(outcomes).failure == ""
    outcomes.close()  # ends the processes, whatever they do
    with other.writing():
        assert fill(other, paths) == []
    assert_same(other, store)


def test_only_new_recordings_are_processed(paths: list[Path], copy: Store, tmp_path: Path) -> None:
    moved = tmp_path / "moved.h5"
    shutil.copyfile(paths[0], moved)  # another name and time, the same run
    longer = record(tmp_path / "four.h5", begin_ns=START_NS + 50 * HOUR_NS, seed=4)
    found = sort([moved, *paths, longer], copy.entries()[0])
    assert [Path(each.path) for each in found.new] == [longer]
    assert found.current == [moved, *paths]


def outgrow(path: Path) -> None:
    """Let spectra be those of a recording that has grown since."""
    with h5py.File(path, "r+") as file:
        file.attrs["source_samples"] -= 1000
        file.attrs["source_bytes"] -= 1


def test_what_two_recordings_cover_counts_once(paths: list[Path], tmp_path: Path) -> None:
    """In one command, or in two; that which is not new counts."""
    again = record(tmp_path / "again.h5", hours=2, begin_ns=START_NS + 2 * HOUR_NS // 3)
    for name, pieces in (("one", [[paths[0], again]]), ("two", [[paths[0]], [again]])):
        store = store_for(tmp_path / name, paths[0])
        for some in pieces:
            assert fill(store, some) == []
        outgrow(next(e.path for e in store.entries()[0] if not e.described.overlaps))
        assert fill(store, pieces[0]) == []  # what it has grown by does not change whose it is
        entries = store.entries()[0]
        (n_first, n_again) = (entry.n_segments for entry in entries)
        assert n_first == pytest.approx(1.5 * 720, abs=2)
        assert n_again == pytest.approx(0.5 * 720, abs=3)
        (overlap,) = answer(store, entries, SETTINGS).pooled.overlaps
        assert overlap.repeated == "again.h5"
        assert overlap.end_ns - overlap.begin_ns == pytest.approx(5400e9, abs=1e9)


def test_a_grown_recording_replaces_its_earlier_spectra(paths: list[Path], copy: Store) -> None:
    outgrow(copy.entries()[0][0].path)
    assert fill(copy, paths) == []
    assert len(copy.entries()[0]) == len(paths)
    assert sort(paths, copy.entries()[0]).new == []


def _killed_while_writing(path: Path) -> None:
    writer = SpectraWriter(path, n_freqs=51, n_channels=6)
    writer.append(0, 1, np.zeros((51, 6, 6), dtype=np.complex128))
    os.kill(os.getpid(), signal.SIGKILL)


def test_files_of_killed_processes_are_not_read_as_spectra(paths: list[Path], copy: Store) -> None:
    before = content(copy)
    process = multiprocessing.get_context("fork").Process(
        target=_killed_while_writing, args=(copy.folder / "killed.h5",)
    )
    process.start()
    process.join()
    process.close()
    assert len(content(copy)) == len(before) + 1
    assert len(copy.entries()[0]) == len(paths)
    with copy.writing() as n_unfinished:
        assert n_unfinished == 1
    assert content(copy) == before


def test_a_failed_task_is_reported_and_the_others_are_completed(
    paths: list[Path], store: Store, tmp_path: Path
) -> None:
    other = store_for(tmp_path / "other", paths[0])
    work = tasks_of(other, sort(paths, ()).new)
    work.insert(1, Task("no.h5", "nowhere/no.h5", "[" * 10**5, work[0].software))
    outcomes = list(carried_out(work))
    assert [bool(each.failure) for each in outcomes].count(True) == 1
    assert_same(other, store)


def test_one_command_writes_at_a_time(copy: Store) -> None:
    with (
        copy.writing(),
        pytest.raises(ArchiveError, match="another command is writing"),
        copy.writing(),
    ):
        pass


def test_settings_of_the_archive_cannot_be_mixed(copy: Store) -> None:
    changed = copy.plan.changed({"unit": "g", "segment": 10.0, "band": None}, "hour")
    assert (changed.unit, changed.segment) == ("g", 10.0)
    with pytest.raises(WrongArchiveError, match=r"--segment 20.0 .*--overlap 0.1 .*--stretch day"):
        copy.plan.changed({"segment": 20.0, "overlap": 0.1}, "day")


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"octaves": True}, "--no-octaves"), ({"segment": 7200.0}, "choose --stretch day")],
)
def test_impossible_settings_are_refused(
    paths: list[Path], tmp_path: Path, settings: dict[str, object], message: str
) -> None:
    with pytest.raises(WrongSettingError, match=message):
        store_for(tmp_path / "no", paths[0], replace(SETTINGS, **settings))  # type: ignore[arg-type]  # of several types


def test_recordings_of_other_sensors_are_reported_and_the_rest_processed(
    paths: list[Path], tmp_path: Path
) -> None:
    other = record(tmp_path / "other.h5", hours=0.1, names="ABD")
    text = tmp_path / "text.h5"
    text.write_text("no recording")
    store = store_for(tmp_path / "store", paths[0])
    failures = fill(store, [other, text, paths[0]])
    assert [("text.h5" in each, "other.h5" in each) for each in failures] == [
        (True, False),
        (False, True),
    ]
    assert "D (X in m/s²" in failures[1]
    assert len(store.entries()[0]) == 1


def test_newer_formats_are_refused_by_name(copy: Store) -> None:
    path = copy.entries()[0][1].path
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 3
    with pytest.raises(WrongArchiveError, match=rf"{path.name}: format version 3 is newer"):
        copy.entries()
    plan = copy.folder / PLAN_FILE
    plan.write_text(plan.read_text().replace('"format_version": 1', '"format_version": 7'))
    with pytest.raises(WrongArchiveError, match=r"archive.json: format version 7 is newer"):
        Store.open(copy.folder)


class _Executed:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, ("executed",)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[: len(content) // 2],
        lambda content: b"\0" * len(content),
        lambda content: pickle.dumps(_Executed()) + content[:0],
        lambda content: content[:0],
    ],
)
def test_damaged_files_are_reported_excluded_and_rebuilt(
    paths: list[Path], copy: Store, store: Store, damage: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(copy.folder.parent)
    path = copy.entries()[0][1].path
    path.write_bytes(damage(path.read_bytes()))  # type: ignore[operator]  # a function
    entries, bad = copy.entries()
    assert len(entries) == len(paths) - 1
    assert len(bad) == 1
    assert path.name in bad[0]
    assert fill(copy, paths) == []
    assert content(copy) == content(store)
    assert not (copy.folder.parent / "executed").exists()


@pytest.mark.parametrize(
    ("dataset", "unit"), [("months/2026-08/noise", None), ("csm", "g")], ids=["own", "other"]
)
def test_what_has_a_wrong_checksum_is_reported_and_excluded(
    copy: Store, dataset: str, unit: str | None
) -> None:
    """Of the archive's own settings the summary is read, of others the matrices."""
    entry = copy.entries()[0][0]
    with h5py.File(entry.path) as found:
        place = found[dataset].id.get_chunk_info(1).byte_offset
    content = bytearray(entry.path.read_bytes())
    content[place + 100] ^= 1
    entry.path.write_bytes(content)
    settings = replace(SETTINGS, unit=unit)
    whole = answer(copy, copy.entries()[0], settings)
    assert len(whole.problems) == 1
    assert entry.path.name in whole.problems[0]
    others = [each for each in copy.entries()[0] if each.path != entry.path]
    assert whole.n_segments.sum() == sum(each.n_segments for each in others)
    assert answer(copy, copy.entries()[0], settings).problems == whole.problems


def test_folders_that_are_no_archive_are_not_written_into(tmp_path: Path, store: Store) -> None:
    assert Store.open(tmp_path / "none") is None
    record(tmp_path / "one.h5", hours=0.01)
    with pytest.raises(WrongArchiveError, match="not an archive"):
        Store.open(tmp_path)
    for text in ("", "[]", '{"format": "x"}', store.plan.to_json().replace("hour", "eon")):
        (tmp_path / PLAN_FILE).write_text(text)
        with pytest.raises(WrongArchiveError, match=PLAN_FILE):
            Store.open(tmp_path)


def test_recordings_in_folders_are_found(paths: list[Path], tmp_path: Path) -> None:
    folder = paths[0].parent
    assert recordings_in([folder, paths[0]], leave_out=tmp_path) == sorted(paths)
    with pytest.raises(RecordingError, match="no recording"):
        recordings_in([folder], leave_out=folder.parent)
    with pytest.raises(RecordingError, match="no such file"):
        recordings_in([tmp_path / "none.h5"], leave_out=tmp_path)


def test_days_and_density_have_the_true_noise(store: Store) -> None:
    found = answer(store, store.entries()[0], SETTINGS)
    truth = (20.0**2 + 1 / 12) / 1e12 * 2 / 10.0  # noise and rounding, over half the rate
    assert list((found.days_utc_ns - START_NS) / HOUR_NS) == [0, 24]
    z = (found.levels.mean / truth - 1) / (found.levels.spread / truth)
    assert np.abs(z).max() < 4.5  # of 2 days, 6 channels and some bands
    assert found.density.n_stretches + found.density.n_short == 9
    assert found.density.n_short == 6  # those of 10 and 20 minutes
    median = found.density.percentile(0.5)
    assert np.abs(median - 10 * np.log10(truth)).max() < 2
    assert not any(each.decided for each in found.courses)  # two days tell nothing


def test_percentiles_of_the_density() -> None:
    counts = np.zeros((1, 400, 2), dtype=np.int64)
    counts[0, [100, 101, 102], 0] = 1, 2, 1
    counts[0, 100, 1] = 1
    density = Density(np.ones(1), counts, np.array([[0, 3]]), 4, 0)
    assert density.percentile(0.5)[0, 0] == LOWEST_DB + 101.5
    assert density.percentile(0.9)[0, 1] == pytest.approx(LOWEST_DB + 100.6)
    assert np.isnan(density.percentile(0.5)[0, 1])  # most of them have no level


@pytest.mark.parametrize(
    ("address", "exposed"),
    [
        ("tcp://127.0.0.1:8786", False),
        ("127.0.0.1:8786", False),
        ("tcp://[::1]:8786", False),
        ("tcp://localhost:8786", False),
        ("tls://10.0.0.1:8786", False),
        ("tcp://10.0.0.1:8786", True),
        ("host:8786", True),
        ("tcp://localhost.example.org:8786", True),
        ("ws://192.168.1.2:80", True),
    ],
)
def test_a_scheduler_in_the_open_is_named(address: str, *, exposed: bool) -> None:
    assert is_exposed(address) is exposed


@pytest.mark.parametrize("alone", [pytest.param(False, marks=pytest.mark.long), True])
def test_recordings_whose_clocks_are_not_understood_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, alone: bool
) -> None:
    good, bad = tmp_path / "good.h5", tmp_path / "bad.h5"
    settings = Settings(methods=("three-sensor",))
    scene = known_clocks.Scene(rates=(50.0, 50.0, 50.0), seconds=200.0)
    clocks = (known_clocks.Oscillator(), known_clocks.Oscillator(400.0), known_clocks.Oscillator())
    known_clocks.record(bad, replace(scene, clocks=clocks))  # faster than any oscillator
    if not alone:
        monkeypatch.setattr(known_clocks, "_ORIGIN", HostTime(0, START_NS))
        known_clocks.record(good, replace(scene, seed=2))
    paths = [bad] if alone else [good, bad]
    store = store_for(tmp_path / "store", paths[0], settings)
    assert fill(store, paths) == []
    entries, _ = store.entries()
    if alone:
        with pytest.raises(ArchiveError, match="no recording in which all clocks are understood"):
            answer(store, entries, settings)
        return
    found = answer(store, entries, settings)
    (left,) = found.doubted
    assert (left.origin.path, left.not_understood) == (str(bad), ("B",))
    only = answer(store, [one for one in entries if one.described != left], settings)
    np.testing.assert_array_equal(found.levels.mean, only.levels.mean)


def _at_limits(name: str, counts: NDArray[np.int32]) -> NDArray[np.int32]:
    """Clip A.X, wrap A.Y at ten bits, and repeat every second row of B."""
    if name == "A":
        x, y = counts.T
        return np.column_stack([x.clip(-600, 600), (y + 512) % 1024 - 512])
    return counts[np.arange(len(counts)) // 2 * 2] if name == "B" else 3 * counts


def test_what_counts_show_of_their_limits_is_kept(tmp_path: Path) -> None:
    paths = [
        record(tmp_path / "limits.h5", hours=0.3, device=_at_limits),
        record(tmp_path / "fine.h5", hours=0.3, begin_ns=START_NS + 9 * HOUR_NS),
    ]
    settings = replace(SETTINGS, segment=2.0)
    store = store_for(tmp_path / "store", paths[0], settings)
    assert fill(store, paths) == []
    counts = estimate(paths, settings).diagnostics.counts
    assert (list(counts.clipped), list(counts.repeated)) == ([0], [2, 3])
    assert {n: each.bits for n, each in counts.wrapped.items()} == {1: 10}
    assert {n: each.step for n, each in counts.codes.items()} == {4: 3, 5: 3}
    for _ in range(2):  # from the files, then from the index
        pooled = answer(store, store.entries()[0], settings).pooled
        assert pooled.diagnostics.counts == counts
        assert pooled.diagnostics.faulty == {0, 1, 2, 3}


@pytest.mark.parametrize(("apart", "steps"), [(0, 1), (0, 47), (1, 0), (24, 0)])
def test_a_response_that_changes_within_or_between_hours_or_days_is_in_the_intervals(
    tmp_path: Path, apart: int, steps: int
) -> None:
    """Between recordings, once within one, or in the middle of each of 24 parts of it."""

    def louder(name: str, counts: NDArray[np.int32]) -> NDArray[np.int32]:
        gain = np.full((len(counts), 1), 1.2 if name == "A" else 1.0)
        gain[np.arange(len(gain)) * (steps + 1) // len(gain) % 2 != steps % 2] = 1.0
        return np.asarray(np.rint(counts * gain), np.int32)

    paths = [record(tmp_path / "a.h5", hours=0.5)] if apart else []
    later = START_NS + apart * HOUR_NS
    paths.append(record(tmp_path / "b.h5", hours=0.5, begin_ns=later, seed=2, device=louder))
    store = store_for(tmp_path / "store", paths[0])
    assert fill(store, paths) == []
    found = answer(store, store.entries()[0], replace(SETTINGS, axis_tolerance={"": 0.0}))
    true = 2 * (20 / 1e6) ** 2 / RATE * np.array([1.22, 1.22, 1, 1, 1, 1])
    low, high = (ends[0] for ends in found.result.levels("three-sensor", (0.5, 4.5)).ends())
    assert np.all((low < true) & (true < high))
    assert np.all(high[:2] > 3 * true[:2])
    assert np.all(high[2:] - low[2:] < 0.3 * true[2:])
    (fact,) = [each for each in facts_of_archive(found) if isinstance(each, ResponsesVary)]
    assert fact.channels == ("A.X", "A.Y")
    assert fact.share > 0.6
    assert found.untested == 0


def test_what_is_known_of_sensitivities_is_in_the_intervals(
    paths: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = {("A", "X"): KnownSensitivity(own=0.1, coefficient=1e-3, temperatures=(3.0, 43.0))}
    for module in (task, snapshot_builder):
        monkeypatch.setattr(module, "stated_sensitivities", lambda _: known)
    store = store_for(tmp_path, paths[0])
    assert fill(store, paths[:1]) == []
    direct = estimate(paths[:1], SETTINGS)
    for _ in range(2):  # from the files, then from the index
        found = answer(store, store.entries()[0], SETTINGS)
        own, whole = (each.results["three-sensor"] for each in (found.pooled, direct))
        wide = np.nanmedian(own.high[5:45] / own.noise_psd[5:45], axis=0)
        assert wide[0] == pytest.approx(
            np.nanmedian(whole.high[5:45, 0] / whole.noise_psd[5:45, 0]), rel=0.05
        )
        assert wide[0] > 1.08 * wide[1]
        assert found.levels.high[0, 0, 0] > 1.35 * found.levels.mean[0, 0, 0]


@pytest.mark.parametrize("reject", [pytest.param(False, marks=pytest.mark.long), True])
def test_segments_that_a_channel_lacks_are_named(tmp_path: Path, *, reject: bool) -> None:
    n, third = round(0.3 * 3600 * RATE), round(0.1 * 3600 * RATE)
    path = record(tmp_path / "r.h5", hours=0.3, absent={"B": [(1, third, 2 * third)]})
    other = record(tmp_path / "other.h5", hours=0.3, begin_ns=START_NS + 3 * HOUR_NS, seed=2)
    store = store_for(tmp_path / "store", path, replace(SETTINGS, reject=reject))
    assert fill(store, [path, other]) == []
    for entries, _ in (store.entries(), store.entries()):  # from files, and from the index
        found = answer(store, entries, SETTINGS)
        assert list(found.lacking) == ["B.Y"]
        assert found.lacking["B.Y"] == pytest.approx(third / (5 * RATE), abs=3)
        dropped = found.pooled.left_out[Reason.GAP]
        assert dropped == pytest.approx(found.lacking["B.Y"], abs=3)
        (fact,) = [each for each in facts_of_archive(found) if isinstance(each, AbsencesNotUsed)]
        assert (fact.channels, fact.n_segments) == (("B.Y",), tuple(found.lacking.values()))
    kept = sum(entry.n_segments for entry in entries)
    assert kept + found.lacking["B.Y"] == pytest.approx(2 * n / (5 * RATE), rel=0.02)


def test_a_sensor_that_shortens_recordings_is_named(tmp_path: Path) -> None:
    late = round(600 * RATE)
    paths = [
        record(tmp_path / "a.h5", hours=0.4, late={"C": late}),
        record(
            tmp_path / "b.h5", hours=0.4, begin_ns=START_NS + 3 * HOUR_NS, seed=2, late={"C": late}
        ),
        record(tmp_path / "c.h5", hours=0.4, begin_ns=START_NS + 6 * HOUR_NS, seed=3),
    ]
    store = store_for(tmp_path / "store", paths[0])
    assert fill(store, paths) == []
    for entries, _ in (store.entries(), store.entries()):  # from files, and from the index
        found = answer(store, entries, SETTINGS)
        facts = found.result.facts
        (fact,) = [each for each in facts if isinstance(each, SpanShortened)]
        assert (fact.sensors, fact.at_end) == (("C",), False)
        assert fact.unused == pytest.approx(1200.0, abs=1.0)


def test_a_recording_from_1970_is_in_the_answer(tmp_path: Path) -> None:
    path = record(tmp_path / "first.h5", begin_ns=0, hours=0.3)
    store = store_for(tmp_path / "store", path)
    assert fill(store, [path]) == []
    found = answer(store, store.entries()[0], SETTINGS)
    assert list(found.days_utc_ns) == [0]


def levels_of(found: Answer) -> list[NDArray[np.number[Any]]]:
    """Return the numbers of an answer that come from stretches and days."""
    return [
        found.levels.mean,
        found.levels.low,
        found.levels.high,
        found.density.counts,
        found.recorded.counts,
        found.pooled.data_psd,
    ]


def test_archives_of_format_1_give_the_same_answer(copy: Store) -> None:
    wanted = answer(copy, copy.entries()[0], SETTINGS)
    for entry in copy.entries()[0]:
        with h5py.File(entry.path, "r+") as file:
            del file["months"]
            del file.attrs["daily"]
            file.attrs["format_version"] = 1
        entry.path.rename(copy.folder / entry.path.name)
    for again in range(2):  # the second from the roll-ups that the first has made
        found = answer(copy, copy.entries()[0], SETTINGS)
        assert not found.problems
        for one, other in zip(levels_of(found), levels_of(wanted), strict=True):
            np.testing.assert_array_equal(one, other, err_msg=str(again))


def test_an_answer_opens_no_file_of_a_recording_twice(copy: Store) -> None:
    wanted = answer(copy, copy.entries()[0], SETTINGS)
    for entry in copy.entries()[0]:
        about = entry.path.stat()
        entry.path.write_bytes(b"x" * about.st_size)  # whoever reads it now, fails
        os.utime(entry.path, ns=(about.st_atime_ns, about.st_mtime_ns))
    entries, bad = copy.entries()
    assert not bad
    found = answer(copy, entries, SETTINGS)
    for one, other in zip(levels_of(found), levels_of(wanted), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("damage", [b"", b"nothing", b"SQLite format 3\0" + b"\xff" * 4096])
def test_damaged_indices_and_rollups_are_made_again(copy: Store, damage: bytes) -> None:
    wanted = answer(copy, copy.entries()[0], SETTINGS)
    derived = [copy.folder / INDEX, *copy.folder.glob(f"*/{ROLLUP}*")]
    assert len(derived) == 2
    for path in derived:
        path.write_bytes(damage)
    for one, other in zip(
        levels_of(answer(copy, copy.entries()[0], SETTINGS)), levels_of(wanted), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_thinned_files_answer_as_before_and_other_settings_by_day(copy: Store) -> None:
    wanted = answer(copy, copy.entries()[0], SETTINGS)
    other = answer(copy, copy.entries()[0], replace(SETTINGS, unit="g"))
    before = sum(path.stat().st_size for path in copy.files())
    assert copy.thin(2) == 0
    assert copy.thin(0) == len(copy.entries()[0]) - 1  # the last is not older than itself
    assert copy.thin(0) == 0
    assert sum(path.stat().st_size for path in copy.files()) < before
    for path in copy.folder.glob(f"*/{ROLLUP}*"):
        path.unlink()
    found = answer(copy, copy.entries()[0], SETTINGS)
    for one, two in zip(levels_of(found), levels_of(wanted), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-6)
    daily = answer(copy, copy.entries()[0], replace(SETTINGS, unit="g"))
    np.testing.assert_allclose(daily.levels.mean, other.levels.mean, rtol=1e-2)  # at SNR 625
    assert 0 < daily.density.n_stretches < other.density.n_stretches


def test_hours_in_single_precision_answer_as_before_in_half_of_the_room(copy: Store) -> None:
    wanted = {path: rows_of(path) for path in copy.files()}
    other = answer(copy, copy.entries()[0], replace(SETTINGS, unit="g"))
    n_old = len(copy.files()) - 1
    assert copy.thin(0, single=True) == n_old
    assert copy.thin(0, single=True) == 0
    n_bytes = []
    for path, rows in wanted.items():
        with h5py.File(path) as file:
            n_bytes.append(file["csm"].dtype.itemsize)
        for (start, n, csm), (start_kept, n_kept, kept) in zip(rows, rows_of(path), strict=True):
            assert (start_kept, n_kept) == (start, n)
            largest = np.abs(csm).max(axis=(1, 2), keepdims=True)
            assert np.all(np.abs(kept - csm) <= 1e-7 * largest)
    assert sorted(n_bytes) == [4] * n_old + [8]
    found = answer(copy, copy.entries()[0], replace(SETTINGS, unit="g"))
    np.testing.assert_allclose(found.levels.mean, other.levels.mean, rtol=1e-6 * SNR)
    assert found.density.n_stretches == other.density.n_stretches
    assert copy.thin(0) == n_old  # days of these


@pytest.mark.parametrize(
    "single", [True, pytest.param(False, marks=pytest.mark.long)], ids=["hours", "days"]
)
def test_intervals_know_what_matrices_in_single_precision_cannot_tell(
    tmp_path: Path, *, single: bool
) -> None:
    """Noise 80 dB below the motion is as small as the rounding."""
    settings = replace(SETTINGS, axis_tolerance={"": 0.0})
    paths = [
        record(tmp_path / f"{n}.h5", hours=0.75, begin_ns=START_NS + n * 30 * HOUR_NS, seed=n,
               noise=1e4, motion_counts=1e8)
        for n in range(2)
    ]  # fmt: skip
    store = store_for(tmp_path / "store", paths[0], settings)
    assert fill(store, paths) == []
    truth = 2 / RATE * (1e4 / 1e6) ** 2 / STANDARD_GRAVITY**2
    exact, off = [], []
    for unit, scale in (("g", 1.0), ("mg", 1e6)):  # nothing is kept yet of the second
        if unit == "mg":
            assert store.thin(0, single=single) == 1
        pooled = answer(store, store.entries()[0], replace(settings, unit=unit)).pooled
        noise = pooled.results["three-sensor"]
        low, high, found = (
            each[2:-2] / (scale * truth) for each in (noise.low, noise.high, noise.noise_psd)
        )
        known = np.isfinite(found)  # where rounding leaves no matrix of noise and motion
        assert np.mean((low <= 1) & (high >= 1), where=known) > 0.9
        assert np.mean(known) > (0.9 if unit == "g" else 0.2)
        sources = {each.source for each in contributions(pooled, "three-sensor")}
        exact.append(Source.ROUNDING not in sources)
        off.append(np.sqrt(np.mean((found - 1) ** 2, where=known)))
    assert exact == [True, False]
    assert off[1] > 2 * off[0]


def rows_of(path: Path) -> list[tuple[int, int, NDArray[np.complex128]]]:
    """Return the stretches of a file."""
    with SpectraFile(path) as file:
        return list(file.rows())
