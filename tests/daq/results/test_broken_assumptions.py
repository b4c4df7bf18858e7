"""Recordings that break an assumption of the model each: their intervals hold the truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from daq.estimation.contributions import by_two, leaks
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.formats.arrays import recording_of_arrays
from daq.results.facts.fact import Finding
from daq.results.facts.model import SharedByTwo
from daq.results.facts.precision import NoiseInGusts
from daq.results.result import Result
from estimator.checks.advice import Rank
from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_noise import NoiseChanges, SharedNoise

RATE, N_SAMPLES = 100.0, 24_000
SETTINGS = Settings(segment=2.0)
BANDS = ((2.0, 5.0), (5.0, 10.0), (10.0, 20.0), (20.0, 40.0))


def felt(rng: np.random.Generator, n_sensors: int, snr: float) -> list[np.ndarray]:
    """Return one motion, white in three directions, as triaxial sensors of any direction feel it.

    In units of the noise of a channel.
    """
    motion = np.sqrt(snr) * rng.standard_normal((N_SAMPLES, 3))
    return [motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0].T for _ in range(n_sensors)]


def estimated(motion: list[np.ndarray], noise: np.ndarray) -> Snapshot:
    """Return the estimate of motion and noise, the latter of shape (n_sensors, n_samples, 3)."""
    samples = {f"s{n}": each + own for n, (each, own) in enumerate(zip(motion, noise, strict=True))}
    return estimate([recording_of_arrays(samples, RATE)], SETTINGS)


def held(snapshot: Snapshot, noise: np.ndarray) -> np.ndarray:
    """Return which intervals hold the true noise, shape (n_bands, n_channels)."""
    (result,) = snapshot.results.values()
    truth = noise.transpose(1, 0, 2).reshape(N_SAMPLES, -1).var(axis=0) * 2 / RATE
    means = [Result(snapshot, SETTINGS).means(result.method, band) for band in BANDS]
    return np.array(
        [
            [mean.low[0] <= true <= mean.high[0] for mean, true in zip(band, truth, strict=True)]
            for band in means
        ]
    )


def white(rng: np.random.Generator, n_sensors: int) -> np.ndarray:
    return rng.standard_normal((n_sensors, N_SAMPLES, 3))


@pytest.mark.parametrize("n_sensors", [3, 4])
def test_weak_motion_of_its_own_may_be_all_noise_of_a_sensor(n_sensors: int) -> None:
    """Below 5 Hz all feel one motion; above, the last one another, of three times its noise."""
    rng = np.random.default_rng(6)
    noise, motion = white(rng, n_sensors), felt(rng, n_sensors, 100.0)
    below = np.fft.rfftfreq(N_SAMPLES, 1 / RATE)[:, None] < 5.0
    for n, each in enumerate(motion):
        spectrum = np.fft.rfft(each, axis=0)
        weak = np.fft.rfft(10 * rng.standard_normal((N_SAMPLES, 3)), axis=0)
        above = np.sqrt(0.03) * (weak if n == n_sensors - 1 else spectrum)
        motion[n] = np.fft.irfft(np.where(below, spectrum, above), N_SAMPLES, axis=0)
    assert held(estimated(motion, noise), noise)[2:, -3:].all()


def test_drifts_of_red_noise_are_no_leakage_that_hides_shared_noise() -> None:
    """The first sensor is 2 ms late; the last two share half of the noise of a channel."""
    rng = np.random.default_rng(0)
    noise, motion = white(rng, 5), felt(rng, 5, 1000.0)
    frequency = np.fft.rfftfreq(N_SAMPLES, 1 / RATE)[:, None]
    late = np.exp(-2j * np.pi * frequency * 0.002) * np.fft.rfft(motion[0], axis=0)
    motion[0] = np.fft.irfft(late, N_SAMPLES, axis=0)
    noise[3:, :, 0] = np.sqrt(0.5) * (noise[3:, :, 0] + rng.standard_normal(N_SAMPLES))
    red = np.fft.rfft(noise, axis=1) / np.maximum(frequency, 0.1)
    snapshot = estimated(motion, np.fft.irfft(red, N_SAMPLES, axis=1))
    assert SharedByTwo in {type(each) for each in Result(snapshot, SETTINGS).facts}


def test_noise_of_a_sensor_that_feels_other_motion_has_no_lower_end() -> None:
    rng = np.random.default_rng(6)
    noise, motion = white(rng, 5), felt(rng, 5, 100.0)
    motion[1] = 10 * rng.standard_normal((N_SAMPLES, 3))
    snapshot = estimated(motion, noise)
    inside = held(snapshot, noise)
    assert inside[:, 3:6].all()
    assert inside.mean() > 0.9
    (result,) = snapshot.results.values()
    means = Result(snapshot, SETTINGS).means(result.method, BANDS[0])
    assert [each.low[0] > 0 for each in means] == [True] * 3 + [False] * 3 + [True] * 9


@pytest.mark.parametrize("snr", [0.05, pytest.param(0.02, marks=pytest.mark.long)])
def test_motion_that_the_test_of_fewer_dimensions_hides_is_in_the_interval(snr: float) -> None:
    """Of five per cent in all directions, one factor takes up enough to pass, and leaves most."""
    rng = np.random.default_rng(1)
    noise = white(rng, 4)
    snapshot = estimated(felt(rng, 4, snr), noise)
    fewer = [each.n_factors < each.usual for each in snapshot.diagnostics.dimensions]
    assert np.mean(fewer) > 0.9  # what this is about
    assert held(snapshot, noise).mean() >= 0.95


def test_a_square_of_bursts_has_no_lower_end() -> None:
    """Bursts are too many to be disturbances, and too few to show a square."""
    rng = np.random.default_rng(16)
    noise, motion = white(rng, 3), felt(rng, 3, 1e4)
    for first in np.linspace(500, N_SAMPLES - 1500, 4).astype(int):
        for each in motion:
            each[first : first + 600] *= 30
    motion[0][:, 1] += 2e-3 * motion[0][:, 1] ** 2 / motion[0][:, 1].std()
    inside = held(estimated(motion, noise), noise)
    assert inside[:, 1].all()
    assert inside.mean() > 0.9


def test_noise_that_changes_is_no_gradient_of_the_motion() -> None:
    """Positions fitted to it would hold one sensor alone, and take its noise for motion."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        noise = white(rng, 5)
        noise[0, N_SAMPLES // 2 :] *= 4
        snapshot = estimated(felt(rng, 5, 1e3), noise)
        assert not any(each.gradients for each in snapshot.diagnostics.dimensions)
        assert held(snapshot, noise).mean() >= 0.93


@pytest.mark.long
def test_noise_that_two_channels_share_is_in_their_intervals() -> None:
    """It is no further dimension of the motion, and the one channel predicts it of the other."""
    rng = np.random.default_rng(1)
    noise = white(rng, 5)
    noise[:2, :, 0] += 0.7 * rng.standard_normal(N_SAMPLES)
    snapshot = estimated(felt(rng, 5, 1e3), noise)
    choices = snapshot.diagnostics.dimensions
    assert {each.pairs for each in choices} <= {(), ((0, 1),)}
    assert any(each.pairs for each in choices)
    inside = held(snapshot, noise)
    assert inside[:, [0, 3]].all()
    assert inside.mean() >= 0.93


def test_a_band_that_no_dimension_explains_costs_a_mean_its_own_share() -> None:
    """Three motions of 10 to 14 Hz differ between six sensors; the mean is over 2 to 40 Hz."""
    rng = np.random.default_rng(1)
    n, frequency = 20_000, np.fft.rfftfreq(20_000, 1 / RATE)
    spectrum = np.fft.rfft(rng.standard_normal((n, 3)), axis=0)
    spectrum[(frequency < 10) | (frequency > 14)] = 0
    samples = 3 * np.fft.irfft(spectrum, axis=0) @ rng.standard_normal((3, 6))
    samples += 30 * rng.standard_normal((n, 1)) + rng.standard_normal((n, 6))
    recording = recording_of_arrays(
        {f"s{i}": each[:, None] for i, each in enumerate(samples.T)}, RATE
    )
    result, true = Result(estimate([recording], SETTINGS), SETTINGS), 2 / RATE
    for each in result.means(result.method, (11.0, 13.0)):
        assert np.isneginf(each.low[0])  # what this is about
    for each in result.means(result.method, (2.0, 40.0)):
        assert 0.3 * true < each.low[0] < true < each.high[0] < 3 * true
        assert np.isfinite(each.estimate[0])


@pytest.mark.parametrize("n_sensors", [3, pytest.param(4, marks=pytest.mark.long)])
def test_noise_that_all_sensors_share_is_in_the_intervals(n_sensors: int) -> None:
    """No bound by the others, which predict it; no finite interval where the test fails."""
    rng = np.random.default_rng(1)
    samples = np.array(felt(rng, n_sensors, 3.0))[:, :10_000]
    samples += 2 * rng.standard_normal((samples.shape[1], 1))
    samples += rng.standard_normal(samples.shape)
    recording = recording_of_arrays({f"s{i}": each for i, each in enumerate(samples)}, RATE)
    settings = Settings(segment=1.0)
    result, true = Result(estimate([recording], settings), settings), 5 * 2 / RATE
    for each in (each for band in BANDS for each in result.means(result.method, band)):
        assert np.isneginf(each.low[0])
        assert true < each.high[0] < 4 * true


def test_of_three_sensors_beside_a_dead_one_two_may_share_noise() -> None:
    """Of what the model assumes: its test has one degree of freedom then."""
    rng = np.random.default_rng(1)
    motion = 3 * rng.standard_normal((6000, 1))
    samples = {name: motion + rng.standard_normal((6000, 1)) for name in "abc"}
    samples["d"] = np.zeros((6000, 1))
    settings = Settings(segment=1.0)
    result = Result(estimate([recording_of_arrays(samples, RATE)], settings), settings)
    (passes,) = (str(each) for each in result.facts if each.name == "model-passes")
    assert passes.endswith("no motion that they feel to different degrees.")
    assert "no noise that all or two of these three sensors share" in passes


@pytest.mark.parametrize("shared", [0.5, 0.0])
def test_what_two_sensors_alone_have_in_common_may_be_noise(shared: float) -> None:
    """Of one channel each: half of their noise was taken for motion, and their intervals missed."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((5, N_SAMPLES, 1))
    noise[:2] = np.sqrt(1 - shared) * noise[:2] + np.sqrt(shared) * rng.standard_normal(
        (N_SAMPLES, 1)
    )
    motion = np.sqrt(0.1) * rng.standard_normal((N_SAMPLES, 1))
    snapshot = estimated([motion] * 5, noise)
    assert held(snapshot, noise).mean() > 0.9
    of_two = by_two(snapshot).mean(axis=0)
    assert np.all(of_two[2:] == 0)
    assert np.all(of_two[:2] == (1 if shared else 0))
    facts = [fact for fact in Result(snapshot, SETTINGS).facts if isinstance(fact, Finding)]
    named = [each for fact in facts for each in fact.findings if isinstance(each, SharedNoise)]
    assert bool(named) == bool(shared)
    assert all((0, 1) in each.channels + each.alternatives for each in named)


def late(motion: list[np.ndarray], *, corner: float | None = None) -> None:
    """Delay two sensors by 10 and 20 ms, or let these have low passes of the corner, and half."""
    frequency = np.fft.rfftfreq(N_SAMPLES, 1 / RATE)
    for n in (0, 1):
        response = np.exp(-2j * np.pi * frequency * 0.01 * (n + 1))
        if corner is not None:
            response /= 1 + 1j * (n + 1) * frequency / corner
        spectra = np.fft.rfft(motion[n], axis=0) * response[:, None]
        motion[n] = np.fft.irfft(spectra, N_SAMPLES, axis=0)


def facts_that_delay(snapshot: Snapshot) -> set[str]:
    facts = [fact for fact in Result(snapshot, SETTINGS).facts if fact.rank is not Rank.TO_KNOW]
    return {
        type(fact.findings[0] if isinstance(fact, Finding) else fact).__name__ for fact in facts
    }


def test_leakage_of_unlike_responses_is_no_motion_that_sensors_do_not_share() -> None:
    rng = np.random.default_rng(1)
    noise, motion = white(rng, 3), felt(rng, 3, 3e3)
    late(motion, corner=10.0)
    snapshot = estimated(motion, noise)
    assert any(isinstance(each, ModelMisfit) for each in snapshot.diagnostics.advice)
    assert facts_that_delay(snapshot) == {"UnequalResponses"}
    assert held(snapshot, noise).mean() >= 0.95


def test_noise_that_two_sensors_share_is_named_beside_less_leakage() -> None:
    rng = np.random.default_rng(1)
    noise, motion = white(rng, 5), felt(rng, 5, 300.0)
    noise[:2, :, 0] += rng.standard_normal(N_SAMPLES)
    late(motion)
    snapshot = estimated(motion, noise)
    assert 0.1 < leaks(snapshot) < 0.5
    assert facts_that_delay(snapshot) == {"UnequalResponses", "SharedByTwo"}


def test_noise_of_like_sensors_that_changes_is_named_beside_leakage_of_another() -> None:
    """The other one has a high pass, below which the motion is as strong."""
    noise = np.random.default_rng(3).standard_normal((3, 120_000, 3))
    noise[1, 60_000:] *= 2
    rng = np.random.default_rng(1)
    motion = [100.0 * rng.standard_normal((120_000, 3))] * 3
    motion[0] = lfilter(*butter(1, 0.05, "high", fs=RATE), motion[0], axis=0)
    samples = {f"s{n}": each + own for n, (each, own) in enumerate(zip(motion, noise, strict=True))}
    settings = Settings(segment=20.0, band=(0.5, 40.0))
    snapshot = estimate([recording_of_arrays(samples, RATE)], settings)
    facts = Result(snapshot, settings).facts
    named = [each for fact in facts if isinstance(fact, Finding) for each in fact.findings]
    assert {each.sensors for each in named if isinstance(each, NoiseChanges)} == {(1,)}
    (gusts,) = (fact for fact in facts if isinstance(fact, NoiseInGusts))
    assert {each.split(".")[0] for each in gusts.channels} == {"s1"}
