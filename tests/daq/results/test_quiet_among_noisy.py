"""A quiet sensor among noisy ones: its mean noise, its interval, and no false advice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.bench.channel import Channel
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.protocols.block import HostTime
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.results.result import Result
from estimator.checks.advice_on_model import WeakMotion
from estimator.levels.bands import band_levels
from estimator.methods import self_noise
from estimator.self_noise.result import Flag
from tests.estimator.csm_models import wishart

RATE = 100.0
N_AVERAGES = 189.0
BAND = (5.0, 45.0)
SETTINGS = Settings(
    segment=2.0, clocks="nominal", methods=("maximum-likelihood",), dimension=None, band=BAND
)
QUIET, NOISY, MOTION = 1.0, 30.0, 15.0
"""Standard deviations: SNR 225 in the quiet sensor, 0.25 in the noisy ones."""


def quiet_and_noisy(path: Path) -> Snapshot:
    """Estimate two minutes of a quiet and two noisy sensors of two channels."""
    rng = np.random.default_rng(11)
    n_samples = round(240 * RATE)
    channels = tuple(Channel(name=name, sensitivity=1000.0) for name in "xy")
    layouts = [
        SensorLayout(name, channels, RATE, dtype=np.dtype("<i4"), clock="one") for name in "ABC"
    ]
    motion = MOTION * rng.standard_normal((n_samples, 2))
    with ArrayWriter(path, sensors=layouts, created=HostTime(0, 10**18)) as writer:
        for name, own, angle in (("A", QUIET, 0.0), ("B", NOISY, 0.4), ("C", NOISY, 1.1)):
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            samples = motion @ turn + own * rng.standard_normal((n_samples, 2))
            counts = np.round(1000 * samples).astype(np.int32)
            writer.samples(name, counts, first_sample=0, block_rows=1000)
    return estimate([path], SETTINGS)


def test_its_noise_is_within_the_interval_and_the_motion_is_not_called_weak(tmp_path: Path) -> None:
    snapshot = quiet_and_noisy(tmp_path / "a.h5")
    noise = snapshot.results["maximum-likelihood"]
    inside = (snapshot.frequency > BAND[0]) & (snapshot.frequency < BAND[1])
    assert ((noise.flags[inside] & Flag.POOLED) != 0).mean() > 0.9  # what this is about
    truth = np.array([QUIET] * 2 + [NOISY] * 4) ** 2 * 2 / RATE
    means = Result(snapshot, SETTINGS).means(noise.method, BAND)
    for mean, true in zip(means, truth, strict=True):
        assert abs(mean.mean[0] - true) < 4 * mean.spread[0]
    for mean in means[:2]:
        assert mean.low[0] < truth[0] < mean.high[0]
        assert mean.high[0] < MOTION**2 * truth[0] / 5  # at least somewhat certain
        assert mean.low[0] < mean.mean[0] < mean.high[0]
    assert not any(isinstance(each, WeakMotion) for each in snapshot.diagnostics.advice)


@pytest.mark.parametrize("method", ["three-sensor", "maximum-likelihood"])
def test_a_quiet_sensor_takes_nothing_from_the_intervals_of_others(method: str) -> None:
    """Maximum likelihood of single bins leaves to B what C's bound of zero takes."""
    noise = np.array([0.1, 0.01, 1e-5])
    csm = np.broadcast_to(np.ones((3, 3)) + np.diag(noise), (201, 3, 3)).astype(np.complex128)
    covered = []
    for seed in range(20):
        drawn = wishart(csm, round(N_AVERAGES), np.random.default_rng(seed))[0]
        found = self_noise(
            method,
            drawn,
            dims=(1, 1, 1),
            n_effective=N_AVERAGES,
            blocks=np.zeros(201, np.int64),
        )
        band = band_levels(found.noise_psd, found.cumulants, np.array([0, 201]), np.ones(1))
        low, high = band.interval()
        covered.append((low[0] <= noise) & (noise <= high[0]))
    assert np.sum(covered) >= 52  # of 60 at 95 %, with a probability of 99 %


@pytest.mark.parametrize("n", [20, 46])
def test_intervals_of_a_sensor_too_quiet_to_be_seen_reach_zero(n: int) -> None:
    noise = np.array([0.1, 0.01, 1e-4])
    csm = np.broadcast_to(np.ones((3, 3)) + np.diag(noise), (400, 3, 3)).astype(np.complex128)
    drawn = wishart(csm, n, np.random.default_rng(1))[0]
    found = self_noise(
        "maximum-likelihood",
        drawn,
        dims=(1, 1, 1),
        n_effective=n,
        blocks=np.zeros(400, np.int64),
    )
    covered = ((found.low <= noise) & (found.high >= noise)).mean(axis=0)
    # 400 frequencies: 95 % less three standard errors
    assert (covered > 0.95 - 3 * np.sqrt(0.05 * 0.95 / 400)).all()
