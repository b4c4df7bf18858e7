"""Free-running sensors, from their samples and block times to their noise: the short study."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies.clocks import free_running, residuals, study
from benchmarks.studies.synthesis import Latency, synthesise
from daq.clocks.clock_model import ClockSource, ClockState
from daq.estimation.diagnosis import residuals as residuals_between
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.results.result import Result
from sim_devices.world.scenario import Scenario
from tests.command import huddle

LATENCIES = pytest.mark.parametrize(
    "latency",
    [
        pytest.param(Latency("batching", 16e-3), marks=pytest.mark.long),
        pytest.param(Latency(), marks=pytest.mark.study),
    ],
    ids=lambda x: x.kind,
)


@LATENCIES
def test_refined_clocks_give_what_true_clocks_give(tmp_path: Path, latency: Latency) -> None:
    rows = {
        row.clocks: row for row in study(tmp_path, snr=1e4, duration=120.0, latency=latency, seed=3)
    }
    assert np.abs(rows["face value"].against_oracle[3:]).min() > 10  # garbage
    assert rows["refined"].residual_us.max() < 2.0
    assert np.abs(rows["refined"].against_oracle).max() < 0.02
    assert rows["refined"].cov == pytest.approx(rows["oracle"].cov, rel=0.05)
    if latency.kind == "batching":
        assert np.abs(rows["arrival times"].against_oracle).max() > 0.1


@pytest.mark.long
def test_the_command_takes_samples_at_face_value_only_if_told(tmp_path: Path) -> None:
    scenario = free_running(snr=1e4, duration=60.0, seed=6)
    path = synthesise(tmp_path / "r.h5", scenario, duration=60.0)
    told = {}
    for clocks in ("refined", "nominal"):
        asked = ["estimate", str(path), "--segment", "2s", "--clocks", clocks, "--json", "-"]
        result = huddle(*asked)
        told[clocks] = json.loads(result.stdout)["diagnostics"]
    sources = {clocks: {each["source"] for each in told[clocks]["clocks"]} for clocks in told}
    assert sources == {"refined": {"arrival times"}, "nominal": {"nominal rate"}}
    # Lined up by the first arrivals to the sample, and left there.
    drift = np.array(told["nominal"]["drift_s"])[:, 1:] * 200.0
    assert np.ptp(drift, axis=0).max() == pytest.approx(0.0, abs=1e-6)
    assert np.abs(drift - np.round(drift)).max() < 1e-6
    assert np.abs(drift[0] - [0.0, 6.42, 11.46]).max() < 1.0  # 32.1 and 57.3 ms, and latency


def test_a_refined_rate_is_known_no_better_than_the_reference(tmp_path: Path) -> None:
    """The motion tells rates against each other; against the host's clock, arrivals do."""
    scenario = free_running(snr=1e4, duration=120.0, seed=6)
    path = synthesise(tmp_path / "r.h5", scenario, duration=120.0)
    states = estimate([path], Settings()).clocks
    least = min(state.ppm_std for state in states if not state.refined)
    assert sum(state.refined for state in states) == 2
    for state in states:
        assert state.ppm_std >= least > 0


@pytest.mark.long
def test_what_is_left_is_stated_with_its_effect_on_the_noise(tmp_path: Path) -> None:
    scenario = free_running(snr=1e4, duration=200.0, seed=5)
    path = synthesise(tmp_path / "r.h5", scenario, duration=200.0)
    snapshot = estimate([path])
    stated = snapshot.diagnostics.synchronisation
    left = residuals(snapshot, scenario)
    told = [stated.residual[name] for name in scenario.names]
    assert told[0] == 0.0  # the reference
    assert np.all(left < 2 * np.array(told[1:]))
    assert np.all(left > 0.2 * np.array(told[1:]))
    at = int(np.searchsorted(snapshot.frequency, 80.0))
    assert stated.noise_bias is not None
    # Coherent power over noise is the SNR, for a channel that sees the weaker direction.
    expected = (2 * np.pi * 80 * told[2]) ** 2 * 1e4
    assert stated.noise_bias[at - 20 : at + 20, 4].mean() == pytest.approx(expected, rel=0.4)


@LATENCIES
def test_half_a_minute_is_stated_by_its_samples_not_by_its_arrivals(
    tmp_path: Path, latency: Latency
) -> None:
    left, stated = [], []
    for seed in range(2):
        scenario = free_running(snr=1e4, duration=30.0, seed=seed)
        path = tmp_path / f"{seed}.h5"
        synthesise(path, scenario, duration=30.0, latency=latency, seed=seed)
        snapshot = estimate([path], Settings(segment=2.0))
        left.append(residuals(snapshot, scenario))
        told = snapshot.diagnostics.synchronisation.residual
        stated.append([told[name] for name in scenario.names[1:]])
    # Some µs a segment leave half a µs; the arrivals know no better than 5 µs, and 1 ms.
    ratio = np.sqrt(np.mean(np.square(stated)) / np.mean(np.square(left)))
    assert 0.4 < ratio < 2.5


def test_a_clock_that_samples_could_not_refine_is_as_far_off_as_the_arrivals_leave_it() -> None:
    states = [
        ClockState(name, ClockSource.ARRIVAL_TIMES, 0.0, 0.0, 0.0, 0.0, residual, 1, refined)
        for name, residual, refined in (("A", 3e-6, False), ("B", 1e-6, True), ("C", 4e-6, False))
    ]
    moved = np.array([[1e-3, 1e-3, 1e-3 + 12e-6], [0.0, 0.0, -12e-6]])  # taken by older clocks
    left, against = residuals_between(states, (True, False, False), moved)
    assert left == pytest.approx({"A": 0.0, "B": 1e-6, "C": 13e-6})
    assert against == "A"


@pytest.mark.long
def test_what_is_stated_holds_though_arrivals_are_polled(tmp_path: Path) -> None:
    latency = Latency("batching", 16e-3)
    left, told = [], []
    for seed in range(2):
        scenario = free_running(snr=0.3, duration=100.0, seed=seed)
        path = synthesise(
            tmp_path / f"{seed}.h5", scenario, duration=100.0, latency=latency, seed=seed
        )
        snapshot = estimate([path])
        stated = snapshot.diagnostics.synchronisation.residual
        left += residuals(snapshot, scenario).tolist()
        told += [stated[name] for name in scenario.names[1:]]
    # Both are of one slope mostly, and two of three share the reference's. Blind to polls, 700
    # times too little is said of one clock.
    assert np.all(np.array(left) < 3 * np.array(told))
    assert np.sqrt(np.mean(np.square(left))) < 2 * np.sqrt(np.mean(np.square(told)))


@pytest.mark.parametrize("behind", [0.0004, pytest.param(-0.7, marks=pytest.mark.long)])
def test_device_utc_and_host_times_meet_though_the_hosts_utc_is_off(
    tmp_path: Path, behind: float
) -> None:
    table = free_running(snr=1e4, duration=120.0, seed=7).to_dict()
    table["sensors"]["A"]["clock"] = {"offset": 0.125}
    scenario = Scenario.from_dict(table)
    path = synthesise(tmp_path / "r.h5", scenario, duration=120.0, utc={"A": behind})
    snapshot = estimate([path])
    assert [clock.source for clock in snapshot.clocks] == ["device UTC", *["arrival times"] * 2]
    assert [clock.refined for clock in snapshot.clocks] == [False, True, True]
    assert residuals(snapshot, scenario).max() < 2e-6
    noise = snapshot.results["three-sensor"].noise_psd
    band = (snapshot.frequency > 5) & (snapshot.frequency < 90)
    # 23 segments, 850 frequencies: 0.5 % an average.
    assert noise[band].mean(axis=0) == pytest.approx(1e-13, rel=0.03)
    assert snapshot.start_utc_ns > 0


@pytest.mark.long
def test_weak_motion_makes_nothing_worse_than_arrival_times(tmp_path: Path) -> None:
    rows = {row.clocks: row for row in study(tmp_path, snr=0.3, duration=100.0, seed=4)}
    alone, refined = rows["arrival times"], rows["refined"]
    assert np.all(refined.residual_us < alone.residual_us + 1.0)
    assert np.abs(refined.against_oracle).max() < np.abs(alone.against_oracle).max() + 1e-3


@pytest.mark.long
def test_where_the_resampler_damps_nothing_is_said(tmp_path: Path) -> None:
    scenario = free_running(snr=1e4, duration=100.0, seed=1)
    table = scenario.to_dict()
    fourth = {"ppm": 7.0, "wander": 0.2, "offset": 0.011}
    table["sensors"]["D"] = table["sensors"]["C"] | {"clock": fourth}  # so that there is a test
    path = synthesise(
        tmp_path / "r.h5", Scenario.from_dict(table, sampling_rate=200.0), duration=100.0
    )
    snapshot = estimate([path], Settings(methods=("three-sensor",)))
    beyond = snapshot.frequency > 90.0  # 0.45 of 200 Hz
    noise = snapshot.results["three-sensor"].noise_psd
    assert np.isnan(noise[beyond]).all()
    assert np.isfinite(noise[2:][~beyond[2:]]).all()  # the trend is not in the first bins
    said = "\n".join(each.line for each in Result(snapshot, Settings()).facts)
    assert "no estimate above 90 Hz" in said
    assert "not finite" not in said
    found = snapshot.diagnostics.diagnosis
    assert found is not None
    highest = found.bands[-1]
    assert highest.high == pytest.approx(90.0)
    assert highest.test.p_value > 1e-3
    assert len(found.per_frequency.p_value) == len(snapshot.frequency)
    assert "singular" not in said
    as_it_is = estimate([path], Settings(clocks="nominal"))  # nothing is resampled
    assert np.isfinite(as_it_is.csm[2:]).all()
