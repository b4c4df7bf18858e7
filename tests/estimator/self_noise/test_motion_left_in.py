"""Motion that few averages leave in the noise of a quiet sensor among noisy ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from estimator.diagnostics.advice import MissingDimension, MotionLeftIn, WeakMotion
from estimator.diagnostics.diagnose import diagnose
from estimator.likelihood.dimension import bands
from estimator.self_noise.coherency import coherency
from estimator.self_noise.motion_left_in import motion_left_in
from estimator.self_noise.three_sensor import three_sensor
from tests.estimator.csm_models import random_bench, wishart

if TYPE_CHECKING:
    from estimator.types import ComplexArray, FloatArray

FREQUENCY: FloatArray = np.linspace(0, 20, 41)
QUIET = [  # dB of the motion and of the other sensors re the quiet one, averages: the critic's
    (0, 20, 190),
    (0, 20, 570),
    (3, 20, 280),
    (3, 15, 280),
]


def left_in(csm: ComplexArray, dims: tuple[int, ...], n_effective: float) -> FloatArray:
    band = np.where(FREQUENCY > 0, bands(FREQUENCY), -1)
    return motion_left_in(coherency(csm, dims), band, dims=dims, n_effective=n_effective)


def drawn(
    d: int, motion_db: float, others_db: float, n: int, *, seed: int = 1, sensors: int = 3
) -> tuple[ComplexArray, tuple[int, ...]]:
    rng = np.random.default_rng(seed)
    noise = np.repeat([1.0] + [10 ** (others_db / 10)] * (sensors - 1), d)
    dims = (d,) * sensors
    csm = random_bench(rng, dims=dims, snr=10 ** (motion_db / 10), noise_psd=noise)
    return wishart(np.broadcast_to(csm, (len(FREQUENCY), *csm.shape)), n, rng)[0], dims


@pytest.mark.parametrize(("motion_db", "others_db", "n"), QUIET)
@pytest.mark.parametrize("d", [1, 3])
def test_lower_ends_reach_below_the_motion(
    d: int, motion_db: float, others_db: float, n: int
) -> None:
    above, above_without, shares = [], [], []
    for seed in range(6):
        csm, dims = drawn(d, motion_db, others_db, n, seed=seed)
        found = three_sensor(csm, dims=dims, n_effective=n)
        left = left_in(csm, dims, n)[1:, :d]
        noise, low = found.noise_psd[1:, :d], found.low[1:, :d]
        above.append((low - left > 1).mean())
        above_without.append((low > 1).mean())
        shares.append(((noise - left).mean(axis=0), noise.mean(axis=0)))
    # 240 d lower ends: 2.5 % may be above, and 2.5 standard errors more
    assert np.mean(above) < 0.025 + 2.5 * np.sqrt(0.025 / (240 * d))
    assert np.mean(above_without) > 0.05
    low_mean, mean = np.mean(shares, axis=(0, 2))
    assert mean > 1.4
    assert low_mean < 1.1


@pytest.mark.parametrize("d", [1, 3])
@pytest.mark.parametrize(
    ("motion_db", "others_db", "n"), [(10, 0, 60), (20, 0, 20), (20, 10, 100), (40, 20, 40)]
)
def test_motion_that_is_found_leaves_nothing_in(
    d: int, motion_db: float, others_db: float, n: int
) -> None:
    csm, dims = drawn(d, motion_db, others_db, n)
    left = left_in(csm, dims, n)
    assert (left > 0).mean() < 0.01


def test_what_is_left_in_scales_with_the_unit_and_is_local() -> None:
    csm, dims = drawn(3, 3, 20, 280)
    left = left_in(csm, dims, 280)
    np.testing.assert_allclose(left_in(1e-18 * csm, dims, 280), 1e-18 * left)
    unknown = csm.copy()
    unknown[30:] = np.nan
    cut = left_in(unknown, dims, 280)
    np.testing.assert_allclose(cut[:9], left[:9])
    assert not cut[30:].any()


def test_strong_motion_at_one_frequency_hides_and_adds_nothing() -> None:
    csm, dims = drawn(1, 0, 20, 280)
    line = csm.copy()
    line[12] += 1e6
    left = left_in(line, dims, 280)
    assert left[12, 0] == 0
    assert np.all(left[8:12, 0] > 0.5)


def test_fewer_averages_than_two_sensors_have_channels_say_nothing() -> None:
    csm, dims = drawn(3, 3, 20, 12)
    assert not left_in(csm, dims, 6.0).any()


@pytest.mark.parametrize("sensors", [3, 5])
def test_advice_names_the_channels_of_the_quiet_sensor(sensors: int) -> None:
    csm, dims = drawn(3, 0, 20, 280, sensors=sensors)
    found = diagnose(csm, FREQUENCY, dims=dims, n_effective=280)
    kinds = [each for each in found.advice if isinstance(each, MotionLeftIn)]
    (advice,) = [each for each in kinds if each.channels]
    assert advice.channels == (0, 1, 2)
    assert advice.sensors == (0,)
    assert 0.4 < advice.share <= 1
    # of a test in which the noise of A is mostly motion these would be wrong
    assert not [e for e in found.advice if isinstance(e, WeakMotion | MissingDimension)]


def test_strong_motion_beside_a_sensor_of_one_channel_leaves_nothing_in() -> None:
    """Its channel senses what the third one of the others does, and not the first."""
    dims, frequencies = (3, 3, 1), len(FREQUENCY)
    senses = np.vstack([np.eye(3), np.eye(3), [[0.0, 0.0, 1.0]]])
    csm = np.broadcast_to(1e4 * senses @ senses.T + np.eye(7), (frequencies, 7, 7))
    drawn_csm = wishart(csm.astype(np.complex128), 200, np.random.default_rng(1))[0]
    assert not left_in(drawn_csm, dims, 200).any()
