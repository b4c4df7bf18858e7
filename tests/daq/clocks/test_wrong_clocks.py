"""Clocks that are wrong, in recordings whose clocks are known: seen, and stated truly."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.clocks.clock_model import ClockState
from daq.estimation.estimation import Estimation, estimate
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.recording.reader import Recording
from daq.results.facts.clocks import ClockNotUnderstood, SamplesUncounted
from daq.results.result import Result
from tests.daq.clock_facts import clock_facts
from tests.known_clocks import NOISE, Motion, Oscillator, Scene, Truth, growing, record, seconds_of

SETTINGS = Settings(equalise="off")
scene_of = partial(Scene, rates=(100.0, 100.0, 100.0))
LONG = pytest.mark.long
SECONDS, LATER = 200.0, 100.0
"""Of most recordings, and when something happens in them."""
EDGES = (0.02, 0.1, 0.25, 0.43)
"""Of bands, as fractions of the sampling rate."""


def estimated(path: Path, scene: Scene) -> tuple[Snapshot, Truth]:
    truth = record(path / "r.h5", scene)
    return estimate([path / "r.h5"], SETTINGS), truth


def clocks_of(
    path: Path, settings: Settings = SETTINGS, sensors: set[str] | None = None
) -> tuple[ClockState, ...]:
    """Return the clocks that an estimate would have, without its noise."""
    with Recording.open(path) as recording:
        part = Pass(recording, settings, sensors=sensors)
        part.finish()
        return tuple(part.aligned.clocks)


def errors(snapshot: Snapshot, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return level over truth in dB, and whether the interval holds the truth, by band."""
    edges = np.searchsorted(snapshot.frequency, min(scene.rates) * np.array(EDGES))
    found = Result(snapshot, SETTINGS).spectrum("three-sensor").levels(edges)
    low, high = found.ends()
    with np.errstate(invalid="ignore"):
        error = 10 * np.log10(found.mean / NOISE)
    return error, (low <= NOISE) & (high >= NOISE)


def assert_right(error: np.ndarray, holds: np.ndarray) -> None:
    """Of 27 intervals of 95 % one is expected not to hold the truth, by a little."""
    assert holds.mean() >= 0.85
    assert (abs(error)[~holds] < 0.6).all()


@pytest.mark.parametrize("snr", [3.0, pytest.param(1e4, marks=LONG)])
def test_the_stated_residual_of_a_good_clock_is_that_of_its_filter(
    tmp_path: Path, snr: float
) -> None:
    scene = scene_of(snr=snr, seconds=SECONDS)
    snapshot, truth = estimated(tmp_path, scene)
    assert all(clock.is_understood for clock in snapshot.clocks)
    assert not clock_facts(snapshot)
    stated = np.array(list(snapshot.diagnostics.synchronisation.residual.values()))[1:]
    real = truth.residual(snapshot)[1:]
    assert (stated > real / 2).all()
    assert (stated < 4 * real.max()).all()


WARMING = Oscillator(15.0, 30.0, 180.0)
"""A rate that moves by up to 1e-6/s."""


def test_what_only_arrivals_know_is_followed_and_stated_as_perhaps_the_hosts(
    tmp_path: Path,
) -> None:
    """The motion is too weak to say whether the clock is fast or the host is late."""
    fast = (Oscillator(5.0, 10.0, 120.0), WARMING, Oscillator(-20.0))
    scene = scene_of(motion="red", snr=100.0, clocks=fast, seconds=300.0)
    snapshot, truth = estimated(tmp_path, scene)
    assert not any(clock.refined for clock in snapshot.clocks)
    first, *others = snapshot.diagnostics.synchronisation.residual.values()
    stated = np.hypot(others, first)  # each is against the computer's clock
    real = truth.residual(snapshot)[1:]
    assert (real < 50e-6).all()  # by slower walks it is 200 µs
    assert (stated > real).all()


@pytest.mark.parametrize("bends", [0, pytest.param(2, marks=LONG)])
def test_a_converter_bends_what_it_samples_by_its_own_clock(tmp_path: Path, bends: int) -> None:
    """Between its samples, at the instants that sensors have in common, nothing is seen of it."""
    snapshot, _ = estimated(tmp_path, scene_of(snr=1e6, seconds=300.0, bends=bends))
    assert {each.column // 3 for each in snapshot.dependent} == {bends}


@pytest.mark.parametrize(("sensor", "ppm"), [(1, -987), pytest.param(0, -1000, marks=LONG)])
def test_samples_lost_all_the_time_are_not_taken_for_a_fast_clock(
    tmp_path: Path, sensor: int, ppm: float
) -> None:
    """One of 1000 samples is lost: the delays lie on a line, of a rate that no clock has."""
    slips = {sensor: [(10.0 * n, 1) for n in range(1, 30)]}
    scene = scene_of(seconds=300.0, slips=slips)
    snapshot, _ = estimated(tmp_path, scene)
    if sensor:  # by the reference, if that loses samples, the others' are not understood
        assert [clock.is_understood for clock in snapshot.clocks] == [True, False, True]
    _, holds = errors(snapshot, scene)
    assert holds.all()
    (fact,) = clock_facts(snapshot)
    assert isinstance(fact, ClockNotUnderstood)
    assert fact.sensors == ("AB"[sensor],)
    assert fact.ppm == pytest.approx(ppm, abs=1)


@pytest.mark.parametrize(
    ("scene", "lost"),
    [
        pytest.param({"slips": {1: [(LATER, 1)]}}, {1: 1}, id="one sample"),
        pytest.param({"slips": {2: [(LATER, -1)]}}, {2: -1}, id="one counted twice", marks=LONG),
        pytest.param({"slips": {1: [(LATER, 100)]}}, {1: 100}, id="a block", marks=LONG),
        pytest.param({"slips": {1: [(20.0, 100)]}}, {1: 100}, id="a block at first", marks=LONG),
        pytest.param({"leaps": {1: [(LATER, 37)]}}, {1: -37}, id="a gap that is none", marks=LONG),
        pytest.param({"slips": {0: [(LATER, 2)]}}, {0: 2}, id="in the reference", marks=LONG),
        pytest.param({"slips": {1: [(LATER, 1)]}, "polled": True}, {1: 1}, id="polled", marks=LONG),
        pytest.param(
            {"slips": {1: [(LATER, 1)]}, "snr": 3.0}, {1: 1}, id="weak motion", marks=LONG
        ),
        pytest.param(
            {"slips": {1: [(LATER, 1)]}, "rates": (100.0, 250.0, 200.0)},
            {1: 1},
            id="other rates",
            marks=LONG,
        ),
    ],
)
def test_samples_lost_without_being_counted_are_found_and_corrected(
    tmp_path: Path, scene: dict[str, Any], lost: dict[int, int]
) -> None:
    made = scene_of(**{"seconds": SECONDS, **scene})
    snapshot, truth = estimated(tmp_path, made)
    found = [tuple(slip.n_samples for slip in clock.slips) for clock in snapshot.clocks]
    assert found == [(lost[n],) if n in lost else () for n in range(3)]
    (slip,) = (slip for clock in snapshot.clocks for slip in clock.slips)
    ((when, _),) = next(iter((made.slips or made.leaps).values()))
    assert abs(seconds_of(slip.utc_ns) - when) <= slip.within < 15.0
    error, holds = errors(snapshot, made)
    assert_right(error, holds)
    assert snapshot.n_dropped < 10
    residual = np.array(list(snapshot.diagnostics.synchronisation.residual.values()))
    assert (residual > truth.residual(snapshot) / 3)[1:].all()  # 0.4 with other rates, of 1 µs
    assert (residual < 1e-4).all()
    name = "ABC"[next(iter(lost))]
    (fact,) = clock_facts(snapshot)
    assert isinstance(fact, SamplesUncounted)
    assert (fact.sensors, fact.slips) == ((name,), (slip,))


@LONG
def test_a_sample_lost_every_minute_is_found_every_time(tmp_path: Path) -> None:
    slips = {1: [(60.0 * n, 1) for n in range(1, 5)]}
    scene = scene_of(seconds=300.0, slips=slips)
    snapshot, _ = estimated(tmp_path, scene)
    assert [slip.n_samples for slip in snapshot.clocks[1].slips] == [1, 1, 1, 1]
    error, holds = errors(snapshot, scene)
    assert_right(error, holds)
    (fact,) = clock_facts(snapshot)
    assert fact.sensors == ("B",)
    assert fact.slips == snapshot.clocks[1].slips


def test_a_sample_lost_near_the_end_is_part_of_the_residual(tmp_path: Path) -> None:
    """Too few segments are left to tell a slip from false delays."""
    scene = Scene(seconds=SECONDS, slips={1: [(SECONDS - 10.0, 1)]})
    snapshot, _ = estimated(tmp_path, scene)
    assert not any(clock.slips for clock in snapshot.clocks)
    stated = snapshot.diagnostics.synchronisation.residual["B"]
    assert stated > 4e-4
    _, holds = errors(snapshot, scene)
    assert holds.all()


def test_between_two_sensors_arrivals_say_which_lost_samples(tmp_path: Path) -> None:
    for slipped in (0, 1):
        scene = scene_of(seconds=SECONDS, slips={slipped: [(LATER, 8)]})
        record(tmp_path / f"{slipped}.h5", scene)
        settings = replace(SETTINGS, methods=("two-channel",))
        clocks = clocks_of(tmp_path / f"{slipped}.h5", settings, sensors={"A", "B"})
        found = [[slip.n_samples for slip in clock.slips] for clock in clocks]
        assert found == [[8] * (slipped == 0), [8] * (slipped == 1)]


@pytest.mark.parametrize(
    ("motion", "polled"),
    [
        ("hum", False),
        pytest.param("coloured", True, marks=LONG),
        pytest.param("white", False, marks=LONG),
        pytest.param("red", True, marks=LONG),
    ],
)
def test_no_slip_is_found_in_a_healthy_recording(
    tmp_path: Path, motion: Motion, *, polled: bool
) -> None:
    """Nor a clock doubted, where hum lets delays be off by whole cycles."""
    warm = (Oscillator(5.0, 10.0, 120.0), Oscillator(60.0), Oscillator(-40.0, 10.0, 120.0, 2.0))
    for snr in (0.3, 30.0, 1e5):
        scene = scene_of(seconds=200.0, snr=snr, motion=motion, polled=polled, clocks=warm, seed=3)
        record(tmp_path / f"{snr}.h5", scene)
        clocks = clocks_of(tmp_path / f"{snr}.h5")
        assert not any(clock.slips for clock in clocks)
        assert all(clock.is_understood for clock in clocks)


@pytest.mark.parametrize(
    ("snr", "polled"),
    [
        (1e4, True),
        pytest.param(3.0, False, marks=LONG),
        pytest.param(1e6, True, marks=pytest.mark.study),
    ],
)
def test_a_rate_that_follows_the_temperature_is_followed(
    tmp_path: Path, snr: float, *, polled: bool
) -> None:
    """By 1e-6/s: 360 µs were left, and 21 µs stated."""
    warm = (Oscillator(), WARMING, Oscillator(-20.0))
    scene = scene_of(seconds=400.0, snr=snr, clocks=warm, polled=polled)
    snapshot, truth = estimated(tmp_path, scene)
    assert all(clock.is_understood for clock in snapshot.clocks)
    stated = snapshot.diagnostics.synchronisation.residual["B"]
    real = truth.residual(snapshot)[1]
    assert stated / 2 < real < 2 * stated
    assert_right(*errors(snapshot, scene))


@LONG
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.study)])
def test_sensors_that_all_restart_are_aligned_or_left_out(tmp_path: Path, seed: int) -> None:
    """Where restarts of several leave an epoch without a delay, arrivals hardly know it."""
    restarts = dict.fromkeys(range(3), (20.0, 40.0, 1.5))
    scene = scene_of(seconds=600.0, restarts=restarts, polled=True, seed=seed)
    snapshot, truth = estimated(tmp_path, scene)
    assert all(clock.refined and clock.is_understood for clock in snapshot.clocks[1:])
    assert snapshot.n_segments > 50
    assert (truth.residual(snapshot) < 5e-6).all()
    assert max(snapshot.diagnostics.synchronisation.residual.values()) < 2e-5
    assert_right(*errors(snapshot, scene))


@LONG  # of one sensor: tests/daq/estimation/test_follow.py
def test_slips_are_the_same_in_a_recording_that_was_followed(tmp_path: Path) -> None:
    scene = scene_of(seconds=SECONDS, slips={1: [(LATER, 1)], 2: [(130.0, 100)]})
    path = tmp_path / "r.h5"
    following: Estimation | None = None
    for seconds in growing(path, scene, every=20.0):
        following = following or Estimation([path], SETTINGS)
        following.update()
        if seconds > 170.0:
            clocks = following.snapshot().clocks
    assert following is not None
    with following:
        ended = following.finish()
    whole = estimate([path], SETTINGS)
    lost = [[slip.n_samples for slip in clock.slips] for clock in clocks]
    assert lost == [[], [1], [100]]
    assert ended.clocks == whole.clocks
    np.testing.assert_array_equal(ended.csm, whole.csm)
