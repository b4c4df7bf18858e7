"""Recordings with many gaps, and delays that are measured from their samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.clocks.aligned_recording import AlignedRecording
from daq.clocks.resampling import resample
from daq.clocks.sensor_reader import from_instants
from daq.estimation.estimation import estimate
from daq.estimation.segments import segment_pass
from daq.estimation.settings import Settings
from daq.estimation.snapshot import NoResultError
from daq.protocols.block import HostTime
from daq.recording.reader import Recording
from daq.recording.sensor_record import SensorRecord
from daq.results.facts.recordings import NotInLiveEstimate, SensorLost, SpanShortened
from daq.results.result import Result
from estimator.checks.advice_on_signals import Copies
from tests.daq.clocks.recordings import ORIGIN, Sensor, blocks, counts, create, write, write_polled

RATE, N_SAMPLES = 50, 18_000
NAMES = ("a", "b", "c")


def lossy_minutes(n_gaps: int, seed: int) -> NDArray[np.bool_]:
    """Single samples are lost in the last ten seconds of each minute."""
    rng = np.random.default_rng(seed)
    late = np.arange(1, N_SAMPLES - 1)
    late = late[(late // RATE % 60 >= 50) & (late % 2 == 0)]
    gone = np.zeros(N_SAMPLES, dtype=np.bool_)
    gone[rng.choice(late, n_gaps, replace=False)] = True
    return gone


class Work:
    """How often the expensive steps were taken."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.n_rows = self.n_reads = self.n_resampled = 0
        for name in ("counts", "instants_ns"):
            self._count(monkeypatch, getattr(SensorRecord, name), name)

        def resampled(inputs: NDArray[Any], positions: NDArray[Any], **options: float) -> object:
            self.n_resampled += len(positions)
            return resample(inputs, positions, **options)

        monkeypatch.setattr("daq.clocks.grid.resample", resampled)

    def _count(self, monkeypatch: pytest.MonkeyPatch, read: Any, name: str) -> None:  # noqa: ANN401
        def counted(record: SensorRecord, first_row: int, last_row: int) -> object:
            self.n_reads += 1
            self.n_rows += last_row - first_row
            return read(record, first_row, last_row)

        monkeypatch.setattr(SensorRecord, name, counted)


def work_of(path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Work, int]:
    with monkeypatch.context() as patch:
        work = Work(patch)
        snapshot = estimate([path], Settings(segment=4.0))
    return work, snapshot.n_segments


@pytest.mark.long
def test_many_gaps_of_polled_sensors_do_not_increase_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    none, n_whole = work_of(
        write_polled(tmp_path / "0.h5", {name: lossy_minutes(0, 1) for name in NAMES}), monkeypatch
    )
    for n_gaps in (20, 1000):
        lost = {name: lossy_minutes(n_gaps, seed) for seed, name in enumerate(NAMES)}
        path = write_polled(tmp_path / f"{n_gaps}.h5", lost)
        work, n_segments = work_of(path, monkeypatch)
        assert n_whole / 2 < n_segments < n_whole
        assert work.n_reads <= none.n_reads
        assert work.n_rows <= none.n_rows
        assert work.n_resampled <= none.n_resampled


def test_polled_sensor_keeps_one_clock_across_gaps(tmp_path: Path) -> None:
    lost = {name: lossy_minutes(300, seed) for seed, name in enumerate(NAMES)}
    with Recording.open(write_polled(tmp_path / "r.h5", lost)) as recording:
        aligned = AlignedRecording(recording)
        assert [clock.n_epochs for clock in aligned.clocks] == [1, 1, 1]
        # Instants are uniform within 0.1 ms: 301 stretches of 345 s in all leave 2 ppm.
        assert max(abs(clock.ppm) for clock in aligned.clocks) < 4 * 2.1
        samples, valid = aligned.read(0, aligned.n_available)
        whole = write_polled(tmp_path / "w.h5", {name: lossy_minutes(0, 0) for name in NAMES})
        with Recording.open(whole) as without:
            reference = AlignedRecording(without)
            expected, _ = reference.read(0, reference.n_available)
    kept = np.flatnonzero(valid[: min(len(samples), len(expected))])
    assert len(kept) > N_SAMPLES / 2
    assert np.abs(samples[kept] - expected[kept]).max() < 1e-5  # resampling errs by -110 dB


def test_a_backward_step_of_time_begins_an_epoch() -> None:
    seconds = np.array([0.0, 0.1, 0.2, 0.5, 0.6, 0.3, 0.4, 0.5])
    clock = from_instants(
        "a",
        seconds,
        sampling_rate=10.0,
        first_samples=np.array([0, 5, 9]),
        first_rows=np.array([0, 3, 5]),
    )
    assert [(epoch.first_sample, epoch.end_sample) for epoch in clock.epochs] == [(0, 7), (9, 12)]
    assert clock.epochs[0].position(np.array([0.35])) == pytest.approx(3.5)  # straight across
    assert clock.at(np.array([1.0, 6.0, 9.0, 11.0])) == pytest.approx([0.1, 0.6, 0.3, 0.5])
    assert clock.state.ppm == pytest.approx(0.0)


def test_loss_of_half_of_all_samples_is_reported_immediately(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    lost = {name: rng.random(N_SAMPLES // 3) < 0.5 for name in NAMES}
    for gone in lost.values():
        gone[0] = False
    path = write_polled(tmp_path / "r.h5", lost)
    with pytest.raises(NoResultError, match="not one whole segment"):
        estimate([path], Settings(segment=4.0))


@pytest.mark.parametrize("names", ["AB", "ABC"])
def test_a_sensor_that_never_sent_is_named_and_left_out(tmp_path: Path, names: str) -> None:
    sensors = {name: Sensor(counts(3000, 3, ord(name))) for name in names}
    writer = create(tmp_path / "r.h5", sensors | {"D": Sensor(counts(1, 3, 1))})
    for name, sensor in sensors.items():
        for block in blocks(name, sensor, 2.0):
            writer.append(block)
    writer.commit()
    with pytest.raises(NoResultError, match="no samples of D, and an estimate needs"):
        estimate([tmp_path / "r.h5"], Settings(segment=4.0))  # it may still send some
    writer.close()
    found = estimate([tmp_path / "r.h5"], Settings(segment=4.0))
    alone = estimate([write(tmp_path / "alone.h5", sensors)], Settings(segment=4.0))
    np.testing.assert_array_equal(found.csm, alone.csm)
    assert (found.not_estimated, found.not_in_memory) == (("D",), ())
    facts = Result(found, Settings(segment=4.0)).facts
    (lost,) = [each for each in facts if isinstance(each, SensorLost)]
    assert (lost.sensors, lost.never_seen) == (("D",), True)
    assert not [each for each in facts if isinstance(each, NotInLiveEstimate)]


@pytest.mark.parametrize(
    ("silent", "said"),
    [
        (("D", "D"), ["sensor-lost True None"]),
        (("", "D"), ["sensor-lost False 30"]),
        (("D", ""), ["span-shortened 30"]),
    ],
)
def test_a_sensor_that_is_silent_in_one_of_two_files_is_named(
    tmp_path: Path, silent: tuple[str, str], said: list[str]
) -> None:
    """The recorder went on in a second file: with D silent in both, both count for the others."""
    run_id = ""
    for number, without in enumerate(silent):
        path = tmp_path / ("r.h5", "r-2.h5")[number]
        sensors = {name: Sensor(counts(3000, 3, ord(name) + number)) for name in "ABCD"}
        later = number * 30 * 10**9
        at = HostTime(ORIGIN.monotonic_ns + later, ORIGIN.utc_ns + later)
        writer = create(path, sensors, created=at, continues=run_id)
        for name, sensor in sensors.items():
            for block in blocks(name, sensor, origin=at) if name not in without else ():
                writer.append(block)
        writer.close()
        with Recording.open(path) as recording:
            run_id = recording.run_id
    settings = Settings(segment=4.0)
    found = estimate([tmp_path / "r.h5"], settings)
    assert found.n_segments == (26 if silent == ("D", "D") else 13)
    assert [clock.sensor for clock in found.clocks][:3] == ["A", "B", "C"]
    facts = Result(found, settings).facts
    lost = [each for each in facts if isinstance(each, SensorLost)]
    late = [each for each in facts if isinstance(each, SpanShortened)]
    assert [
        *(f"{e.name} {e.never_seen} {None if e.never_seen else round(e.missing)}" for e in lost),
        *(f"{e.name} {round(e.unused)}" for e in late),
    ] == said


def test_many_gaps_of_free_running_sensors_do_not_increase_the_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    motion = counts(N_SAMPLES, 1, 3)
    reads = {}
    for n_gaps in (0, 200):
        gaps = tuple((3000 + 20 * number, 3001 + 20 * number) for number in range(n_gaps))
        sensors = {
            name: Sensor(motion + counts(N_SAMPLES, 1, 7 + number) // 100, 50.0, gaps=gaps)
            for number, name in enumerate(NAMES)
        }
        path = write(tmp_path / f"{n_gaps}.h5", sensors)
        work, n_segments = work_of(path, monkeypatch)
        assert n_segments > 10
        reads[n_gaps] = work.n_reads
    assert reads[200] <= 1.5 * reads[0]


# --- delays from the samples -----------------------------------------------------------------


def test_a_first_sensor_with_noise_only_does_not_prevent_refinement_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(segment_pass, "_VALUES_AT_ONCE", 1)  # as if there were very many sensors
    motion = np.cumsum(np.random.default_rng(9).standard_normal((12_000, 1)), axis=0)

    def seen(seed: int) -> NDArray[np.int32]:
        noise = np.random.default_rng(seed).standard_normal((12_000, 1))
        return np.round(1e5 * (motion + 0.01 * noise)).astype(np.int32)

    sensors = {
        "a": Sensor(counts(12_000, 1, 4)),
        "b": Sensor(seen(1)),
        "c": Sensor(seen(2)),
        "d": Sensor(seen(3), late=27e-3),  # nearly three samples
    }
    snapshot = estimate([write(tmp_path / "r.h5", sensors)], Settings(segment=4.0))
    assert [clock.refined for clock in snapshot.clocks] == [False, False, True, True]
    apart = snapshot.drift[:, 3:] - snapshot.drift[:, 2:3]
    assert np.abs(apart).max() < 1e-4  # 2.7e-2 by arrival times


@pytest.mark.parametrize(
    ("late", "missed"),
    [
        pytest.param(2e-4, 0, marks=pytest.mark.long),
        pytest.param(7.3e-3, 0, marks=pytest.mark.long),
        (7.3e-3, 130),
    ],
)
def test_a_sensor_connected_twice_is_reported_and_does_not_stop_the_estimate(
    tmp_path: Path, late: float, missed: int
) -> None:
    motion = np.cumsum(np.random.default_rng(1).standard_normal((16_000, 2)), axis=0)

    def seen(seed: int) -> NDArray[np.int32]:
        noise = np.random.default_rng(seed).standard_normal(motion.shape)
        return np.round(1e4 * (motion + 0.05 * noise)).astype(np.int32)

    twice = seen(2)
    sensors = {n: Sensor(c) for n, c in (("a", seen(1)), ("b", twice), ("c", seen(3)))}
    restarts = (6000,) if missed else ()  # of one of the wires
    sensors["d"] = Sensor(twice[missed:], start=missed / 100.0, late=late, restarts=restarts)
    methods = ("three-sensor", "maximum-likelihood")
    path = write(tmp_path / "r.h5", sensors)
    snapshot = estimate([path], Settings(segment=4.0, methods=methods))
    copies = snapshot.diagnostics.advice[0]
    assert isinstance(copies, Copies)
    assert copies.channels == ((2, 6), (3, 7))  # d's and b's
    apart = snapshot.drift[:, 4] - snapshot.drift[:, 2]
    assert np.abs(apart - missed / 100.0).max() < 1e-6
    for method in methods:
        assert np.isfinite(snapshot.results[method].noise_psd[4:160, [0, 1, 4, 5]]).all()


def test_coarse_counts_equal_by_chance_do_not_make_one_sensor(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(0)
    tones, phases = rng.uniform(0.5, 40.0, (100, 1)), rng.uniform(0.0, 2 * np.pi, (100, 1))

    def seen(ppm: float) -> Sensor:  # without noise, from the same instant on
        rate = 100.0 * (1 + ppm * 1e-6)
        motion = np.sin(2 * np.pi * tones * np.arange(12_000) / rate + phases).sum(axis=0)
        return Sensor(np.round(motion / 14)[:, None].astype(np.int32), rate=rate, nominal=100.0)

    sensors = {"a": seen(0.0), "b": seen(10.0)}
    assert np.array_equal(sensors["a"].counts[:500], sensors["b"].counts[:500])
    with Recording.open(write(tmp_path / "r.h5", sensors)) as recording:
        rates = [state.ppm for state in AlignedRecording(recording).clocks]
    assert rates == pytest.approx([0.0, 10.0], abs=0.01)
