"""Delays from the samples: sensors of noise alone, connected twice, and equal by chance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.clocks.aligned_recording import AlignedRecording
from daq.estimation.estimation import estimate
from daq.estimation.segments import segment_pass
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from estimator.checks.advice_on_signals import Copies
from tests.daq.clocks.recordings import Sensor, counts, write


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
