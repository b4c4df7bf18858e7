"""Intervals cover the mean noise of a recording during which the noise changed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import signal

import huddle
from daq.estimation import snapshot_builder
from daq.estimation.estimation import estimate
from daq.estimation.noise_estimates import Estimates, noise_estimates
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.results.facts.precision import NoiseInGusts
from daq.results.result import Result
from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_noise import DisturbedSegments, NoiseChanges

RATE = 40.0
N = round(1200 * RATE)
EDGES = np.array([5, 20, 45, 90])
"""Of bands: from 1 to 18 Hz."""


def turned(
    rng: np.random.Generator,
    motion: np.ndarray,
    level: np.ndarray | float = 1.0,
    names: str = "ABC",
) -> dict[str, np.ndarray]:
    """Return what sensors in any direction feel of a motion, with noise of this level."""
    d = motion.shape[1]
    return {
        name: motion @ np.linalg.qr(rng.standard_normal((d, d)))[0]
        + level * rng.standard_normal(motion.shape)
        for name in names
    }


def level_of(sensor: str, case: str) -> np.ndarray:
    """Return the standard deviation of a sensor's noise at every sample."""
    level = np.ones(N)
    if case == "step" and sensor == "A":
        level[N // 2 :] = 3.0
    elif case == "burst" and sensor == "B":
        level[N // 3 : N // 3 + N // 20] = 10.0
    elif case == "gusts" and sensor == "C":  # of 3 s, every 23 s
        runs = np.random.default_rng(5).exponential((20.0, 3.0), (200, 2)).ravel() * RATE
        level = np.repeat(np.tile([1.0, 3.0], 200), runs.astype(int) + 1)[:N]
    return level


@pytest.mark.parametrize(
    ("case", "sensor", "covered"), [("step", 0, 0.93), ("burst", 1, 0.8), ("gusts", 2, 0.93)]
)
def test_intervals_cover_the_mean_noise(case: str, sensor: int, covered: float) -> None:
    """Intervals of steady noise cover 89 % after the step, 43 % with the burst, 83 % in gusts."""
    rng = np.random.default_rng(2)
    hits = []
    for _ in range(2):
        motion = 30 * rng.standard_normal((N, 3))
        samples, truth = {}, []
        for name in "ABC":
            turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
            level = level_of(name, case)
            samples[name] = motion @ turn + level[:, None] * rng.standard_normal((N, 3))
            truth.append(float((level**2).mean()) * 2 / RATE)
        found = huddle.self_noise(samples, fs=RATE, segment="2s").snapshot.results["three-sensor"]
        inside, own = slice(5, 90), slice(3 * sensor, 3 * sensor + 3)
        low, high = found.low[inside, own], found.high[inside, own]
        hits.append(np.mean((low <= truth[sensor]) & (truth[sensor] <= high)))
    assert np.mean(hits) > covered


@pytest.mark.parametrize("by", [{}, {"octaves": True}, {"reject": True}])
def test_a_mean_over_many_frequencies_is_known_no_better_than_its_loudness(
    by: dict[str, bool],
) -> None:
    """Gusts of 3 s, 9.5 dB: the variance is 1.74 for 5.2 s, a mean over 1200 s has .087 (1 σ)."""
    settings, rng = Settings(segment=2.0, **by), np.random.default_rng(3)  # type: ignore[arg-type]
    motion = 30 * rng.standard_normal((N, 3))
    samples = {
        name: motion + level_of(name, "gusts")[:, None] * rng.standard_normal((N, 3))
        for name in "ABC"
    }
    found = Result(estimate([recording_of_arrays(samples, RATE)], settings), settings)
    (gusts,) = [fact for fact in found.facts if isinstance(fact, NoiseInGusts)]
    assert {name[0] for name in gusts.channels} == {"C"}
    assert gusts.wider > 1
    assert 2 < gusts.lasts <= 100  # two parts
    spread = [float(each.high[0] / each.low[0]) for each in found.means(found.method, (2, 18))]
    assert max(spread[:6]) < 1.15
    # of its standard deviation, by 12 parts at least, 16 % (1 σ)
    assert np.log(np.mean(spread[6:])) == pytest.approx(2 * 1.96 * 0.087, rel=3 * 0.16 + 0.1)


@pytest.mark.parametrize(
    ("n_sensors", "ratio"), [(5, 0.2), (3, 1e4), pytest.param(3, 0.2, marks=pytest.mark.long)]
)
def test_gusts_are_noise_that_changes(n_sensors: int, ratio: float) -> None:
    """Beside weak motion their scatter is taken for motion: of five sensors, 85 % hold the noise.

    Strong motion takes no more of their noise than of steady noise.
    """
    rng = np.random.default_rng(5)
    n = round(600 * RATE)
    motion = np.sqrt(ratio) * rng.standard_normal((n, 2))
    level = np.exp(0.7 * rng.standard_normal(n // 200)).repeat(200)[:, None]  # of 5 s each
    samples = turned(rng, motion, level, "ABCDE"[:n_sensors])
    found = huddle.self_noise(samples, fs=RATE, segment="2s").snapshot
    noise, truth = next(iter(found.results.values())), float((level**2).mean()) * 2 / RATE
    low, high = noise.low[5:72], noise.high[5:72]
    assert np.mean((low <= truth) & (truth <= high)) > 0.9
    assert np.abs(10 * np.log10(noise.noise_psd[5:72].mean() / truth)) < 0.3
    assert NoiseChanges in [type(each) for each in found.diagnostics.advice]


@pytest.mark.parametrize("seed", range(2))
def test_motion_of_other_directions_at_each_frequency_is_no_noise_that_changes(seed: int) -> None:
    """Directions of a band leave a part of it: noise "changes" by 60 %, scores by 30 times."""
    rng = np.random.default_rng(seed)
    n, taps = round(600 * RATE), np.exp(-np.arange(24) / 6)[:, None, None]
    responses = taps * rng.standard_normal((24, 3, 3))
    white = rng.standard_normal((n + 23, 3))
    motion = sum(white[23 - k : n + 23 - k] @ each for k, each in enumerate(responses))
    motion *= np.where(np.arange(n) < n / 2, 1, 3)[:, None] / np.std(motion)
    samples = {
        name: motion @ np.linalg.qr(np.eye(3) + 0.3 * rng.standard_normal((3, 3)))[0]
        + rng.standard_normal((n, 3))
        for name in "ABC"
    }
    found = huddle.self_noise(samples, fs=RATE, segment="2s").snapshot.diagnostics
    assert NoiseChanges not in [type(each) for each in found.advice]
    steady = found.diagnosis.stability if found.diagnosis else None
    assert steady is None or steady.inflation < 1.5


def test_bursts_of_motion_that_directions_leave_are_no_noise_that_changes() -> None:
    """Four parts of eleven have most of it: too few for products of all parts alike."""
    rng, rate = np.random.default_rng(7), 20.0
    n = round(900 * rate)
    motion = 0.6 * rng.standard_normal((n, 3))
    for first in rng.integers(0, n, 4):
        motion[first : first + int(rng.uniform(3, 40) * rate)] *= rng.uniform(2, 30)
    samples = {
        name: motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
        + rng.uniform(0.3, 3) * rng.standard_normal((n, 3))
        for name in "ABC"
    }
    found = huddle.self_noise(samples, fs=rate).snapshot.diagnostics
    assert NoiseChanges not in [type(each) for each in found.advice]


def test_levels_are_estimated_once_with_the_noise_that_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(8)
    level = np.exp(rng.standard_normal(N // 200)).repeat(200)[:, None]  # of 5 s each
    motion = 3 * rng.standard_normal((N, 3))
    samples = {}
    for name in "ABC":
        fast = np.diff(level * rng.standard_normal((N, 3)), n=3, axis=0, prepend=np.zeros((3, 3)))
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        samples[name] = motion @ turn + rng.standard_normal((N, 3)) + fast / 5
    made: list[tuple[Any, Estimates]] = []

    def kept(*given: Any, **options: Any) -> Estimates:  # noqa: ANN401
        made.append((options["stability"], noise_estimates(*given, **options)))
        return made[-1][1]

    monkeypatch.setattr(snapshot_builder, "noise_estimates", kept)
    huddle.self_noise(samples, fs=RATE, segment="2s")
    (stability,) = [used for used, found in made if found.results]
    assert stability.inflations.min() == 1 < stability.inflations.max()


@pytest.mark.parametrize("seed", [4, 8])
def test_one_burst_of_motion_is_no_noise_that_changes(seed: int) -> None:
    """Noise of all channels "changed" by 90 %: scales of single frequencies turned the motion."""
    rng, d = np.random.default_rng(seed), 1 + seed % 3
    motion = 0.3 * rng.standard_normal((12000, d))
    motion[4000:4400] *= 20
    samples = {
        name: motion @ np.linalg.qr(rng.standard_normal((d, d)))[0]
        + 10 ** rng.uniform(-0.3, 0.3) * rng.standard_normal((12000, d))
        for name in "ABC"
    }
    found = huddle.self_noise(samples, fs=20.0, segment="5s").snapshot.diagnostics
    assert NoiseChanges not in [type(each) for each in found.advice]
    steady = found.diagnosis.stability if found.diagnosis else None
    assert steady is None or steady.inflation == 1


def test_gusts_beside_weaker_motion_are_no_gain_that_changes() -> None:
    """What stands for the motion has their noise: all of its gains "changed" by 50 %."""
    rng, n = np.random.default_rng([2, 47]), 30000

    def gust(size: float) -> np.ndarray:
        return np.exp(size * np.interp(np.arange(n) / 150, np.arange(203), rng.normal(size=203)))

    motion = np.sqrt(0.3) * rng.standard_normal(n) * gust(0.8)
    samples = {name: motion + rng.standard_normal(n) * gust(0.6) for name in "ABC"}
    found = huddle.self_noise(samples, fs=50.0, segment="10s").snapshot.diagnostics
    assert "response-changes" not in {each.name for each in found.advice}


def test_motion_by_other_axes_is_a_misfit_and_no_noise_that_changes() -> None:
    rng = np.random.default_rng(1)
    loud = 14 * np.exp(rng.standard_normal(12)).repeat(N // 12)[:, None]
    motion = loud * rng.standard_normal((N, 3))
    axes = np.hstack([np.ones((4, 1)), 0.1 * rng.standard_normal((4, 2))])
    samples = {
        name: motion @ axis[:, None] + rng.standard_normal((N, 1))
        for name, axis in zip("ABCD", axes, strict=True)
    }
    found = huddle.self_noise(samples, fs=RATE, segment="5s").snapshot.diagnostics.advice
    assert {ModelMisfit, NoiseChanges} & {type(each) for each in found} == {ModelMisfit}


def test_noise_that_changes_is_said_of_bands_whose_model_holds() -> None:
    """Motion by other axes below 3 Hz was named alone, with noise 1.7 times as high above it."""
    rng = np.random.default_rng(11)
    loud = 14 * np.exp(rng.standard_normal(12)).repeat(N // 12)[:, None]
    motion = 14 * rng.standard_normal((N, 1))
    low_pass = signal.butter(4, 3.0, fs=RATE)
    other = loud * signal.lfilter(*low_pass, rng.standard_normal((N, 2)), axis=0)
    samples = {}
    for name, axis in zip("ABCD", 0.1 * rng.standard_normal((4, 2, 1)), strict=True):
        level = np.where((np.arange(N) > N // 2) & (name == "A"), 1.7, 1.0)[:, None]
        samples[name] = motion + other @ axis + level * rng.standard_normal((N, 1))
    found = huddle.self_noise(samples, fs=RATE, segment="5s").snapshot.diagnostics.advice
    (misfit,) = (each for each in found if isinstance(each, ModelMisfit))
    (changed,) = (each for each in found if isinstance(each, NoiseChanges))
    assert misfit.band is not None
    assert changed.band is not None
    assert changed.band[0] > misfit.band[1]
    assert changed.sensors == (0,)


@pytest.mark.long
def test_gusts_are_no_motion_and_bound_no_level() -> None:
    """Few segments hold most of the noise: its averages are few, and look like more motion."""
    rng = np.random.default_rng(3)
    n = round(600 * RATE)
    motion = 1000 * rng.standard_normal((n, 3))
    level = np.exp(rng.standard_normal(n // 200)).repeat(200)[:, None]  # of 5 s each
    samples = turned(rng, motion, level, "ABCDE")
    estimate = huddle.self_noise(samples, fs=RATE, segment="5s")
    snapshot, truth = estimate.snapshot, float((level**2).mean()) * 2 / RATE
    found = Result(snapshot, Settings()).spectrum("maximum-likelihood").levels(EDGES)
    low, high = found.ends()
    assert np.mean((low <= truth) & (truth <= high)) > 0.93
    assert np.abs(10 * np.log10(found.mean / truth)).max() < 1.5
    assert {choice.n_factors for choice in snapshot.diagnostics.dimensions} == {3}
    kinds = [type(each) for each in snapshot.diagnostics.advice]
    assert NoiseChanges in kinds
    assert DisturbedSegments not in kinds


def test_noise_that_sensors_share_opens_every_octave() -> None:
    """Only the octave of the clearest motion counted: below it, noise was up to 1.3 times off."""
    rng = np.random.default_rng([2, 3])
    samples = turned(rng, 100 * rng.standard_normal((24000, 3)))
    shared = np.sqrt(0.5) * rng.standard_normal(24000)
    for each in samples.values():
        each[:, 0] += shared
    snapshot = huddle.self_noise(samples, fs=20.0, segment="5s", octaves=True).snapshot
    result = Result(snapshot, Settings())
    for band in ((0.5, 2.0), (2.0, 4.0), (5.0, 9.0)):
        for mean in result.means(result.method, band)[::3]:
            assert mean.low[0] <= 0.01
            assert mean.high[0] >= 0.15
