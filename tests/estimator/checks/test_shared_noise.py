"""Noise that channels share is named, with its amount and its effect; nothing else is."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.checks.advice import Rank
from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_noise import SharedNoise
from estimator.checks.diagnose import diagnose
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.score_test import pair_scores
from estimator.self_noise.three_sensor import three_sensor
from tests.estimator.csm_models import pentagon, plane_waves, random_bench, rotation, wishart

N = 226
FREQUENCY = np.linspace(1, 60, 160)
DIMS = (3, 3, 3)
INDEPENDENT = np.zeros(0)
ALL = np.ones(len(FREQUENCY), dtype=np.bool_)


def averages(
    rng: np.random.Generator,
    pairs: tuple[tuple[int, int], ...],
    amount: float,
    *,
    level: tuple[float, ...] = (1.0,) * 9,
    phase: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Three sensors of any direction at SNR 1000, whose noise some channels share."""
    directions = np.concatenate([rotation(rng, 3) for _ in DIMS])
    noise = np.broadcast_to(np.eye(9, dtype=np.complex128), (len(FREQUENCY), 9, 9)).copy()
    for i, j in pairs:
        noise[:, i, j] = amount * np.exp(1j * phase)
        noise[:, j, i] = noise[:, i, j].conj()
    root = np.sqrt(level)
    csm = 1e3 * directions @ np.diag([1.0, 1.5, 0.8]) @ directions.T + noise * np.outer(root, root)
    return np.asarray(wishart(csm, N, rng)[0])


def found_in(csm: np.ndarray, dims: tuple[int, ...] = DIMS) -> list[SharedNoise]:
    found = diagnose(csm, FREQUENCY, dims=dims, n_effective=N, neighbours=INDEPENDENT)
    return [advice for advice in found.advice if isinstance(advice, SharedNoise)]


@pytest.mark.parametrize(
    ("pairs", "amount", "sensors"),
    [
        (((1, 5),), 0.06, (0, 1)),
        (((3, 8),), -0.1, (1, 2)),
        (((0, 1),), 0.1, (0,)),
        (((0, 3), (1, 4), (2, 5)), 0.1, (0, 1)),
    ],
    ids=["one pair", "opposite", "within a sensor", "one digitizer"],
)
def test_pairs_are_reported_with_their_amount(
    pairs: tuple[tuple[int, int], ...], amount: float, sensors: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(5)
    (advice,) = found_in(averages(rng, pairs, amount, level=(1.0, 4, 1, 1, 1, 9, 1, 1, 2)))
    assert set(advice.channels) == set(pairs)
    assert advice.sensors == sensors
    for value, error in zip(advice.coherencies, advice.standard_errors, strict=True):
        assert abs(value - amount) < 4 * error
        assert error < 0.02


@pytest.mark.parametrize("delay", [0.02, -0.1])
def test_noise_that_is_late_in_one_channel_is_reported_with_its_amount(delay: float) -> None:
    """Of 0.1 the real part alone shows nothing over all frequencies, the imaginary part as little.

    The effect on the estimates turns over frequencies with the phase, and is that of the worst.
    """
    late = averages(np.random.default_rng(5), ((1, 5),), 0.1, phase=2 * np.pi * delay * FREQUENCY)
    (advice,) = found_in(late)
    assert advice.channels == ((1, 5),)
    assert advice.coherencies[0] == pytest.approx(0.1, abs=4 * advice.standard_errors[0])
    (at_once,) = found_in(averages(np.random.default_rng(5), ((1, 5),), 0.1))
    assert advice.harm == pytest.approx(at_once.harm, rel=0.5)


def test_pairs_that_the_averages_cannot_tell_apart_are_said() -> None:
    """Of these directions, another pair explains the averages better by chance."""
    (advice,) = found_in(averages(np.random.default_rng(67), ((0, 3),), 0.06))
    assert advice.channels == ((5, 8),)
    assert (0, 3) in advice.alternatives


def test_the_effect_on_the_estimates_is_that_of_the_true_matrices() -> None:
    """Within a sensor no estimate has a bias: the noise of a sensor is a matrix."""
    rng = np.random.default_rng(8)
    directions = np.concatenate([rotation(rng, 3) for _ in DIMS])
    motion = 1e3 * directions @ np.diag([1.0, 1.5, 0.8]) @ directions.T
    for pair in ((0, 3), (0, 1)):
        noise = np.eye(9)
        noise[pair, pair[::-1]] = 0.1
        true = (motion + noise).astype(np.complex128)[None]
        drawn = wishart(np.broadcast_to(true[0], (len(FREQUENCY), 9, 9)), N, rng)[0]
        (advice,) = found_in(np.asarray(drawn))
        assert advice.channels == (pair,)
        closed = three_sensor(true, dims=DIMS, n_effective=1e9).noise_psd[0] - 1
        likely = maximise(true, 3, dims=DIMS).psi[0] - 1
        worst = np.abs(closed).max(), np.abs(likely).max()
        # A tenth of the noise is known to about 0.015; the estimate of psi takes a part of it.
        assert abs(advice.three_sensor) == pytest.approx(worst[0], abs=0.02)
        assert abs(advice.maximum_likelihood) == pytest.approx(worst[1], abs=0.02)
    assert advice.three_sensor == pytest.approx(0, abs=1e-6)
    assert advice.maximum_likelihood == pytest.approx(0, abs=1e-6)


def test_reported_shared_noise_is_no_further_misfit() -> None:
    """A quarter of the noise in common fails the model test by far: what is known explains it."""
    csm = averages(np.random.default_rng(2), ((0, 3),), 0.25)
    found = diagnose(csm, FREQUENCY, dims=DIMS, n_effective=N, neighbours=INDEPENDENT)
    assert min(band.test.p_value for band in found.bands) < 1e-6
    kinds = [type(each) for each in found.advice if each.rank is not Rank.TO_KNOW]
    assert SharedNoise in kinds
    assert not [each for each in found.advice if isinstance(each, ModelMisfit)]


def test_noise_shared_in_one_band_is_reported_there() -> None:
    rng = np.random.default_rng(4)
    sound, shared = averages(rng, (), 0.0), averages(np.random.default_rng(4), ((0, 3),), 0.3)
    csm = np.where((FREQUENCY > 20)[:, None, None], sound, shared)
    (advice,) = found_in(csm)
    assert advice.channels == ((0, 3),)
    assert advice.band is not None
    assert advice.band[1] < 30
    assert advice.coherencies[0] == pytest.approx(0.3, abs=0.08)


def test_waves_across_the_bench_are_not_reported_as_shared_noise() -> None:
    waves = plane_waves(FREQUENCY, pentagon(), snr=400.0)
    drawn = np.asarray(wishart(waves, N, np.random.default_rng(3))[0])
    assert not found_in(drawn, (3,) * 5)


def test_sound_tests_seldom_report_shared_noise() -> None:
    """At 1 % for all pairs together, more than three of forty happen once in 3000 such tests."""
    rng = np.random.default_rng(11)
    scores, late = [], 0
    for _ in range(40):
        maximum = maximise(averages(rng, (), 0.0)[::4], 3)
        found = pair_scores(maximum, ALL[::4], n_effective=N, neighbours=INDEPENDENT)
        assert found is not None
        scores.append(found.z)
        late += found.latest(np.ones(36, np.bool_), 0.05) is not None
    assert late <= 7  # more happen once in 1000 such tests
    z = np.array(scores)
    # 40 draws of 36 correlated scores, which have about twelve independent directions
    assert z.std() == pytest.approx(1.0, abs=4 / np.sqrt(2 * 40 * 12))
    assert np.abs(z.mean(axis=0)).max() < 4.5 / np.sqrt(40)
    assert np.mean(np.abs(z).max(axis=1) > 3.63) <= 3 / 40


def test_scores_of_few_averages_are_normal() -> None:
    """Of 17,280 scores 47 exceed three standard deviations by chance, and hardly ever 64."""
    rng, z = np.random.default_rng(3), []
    for _ in range(12):
        turned = np.concatenate([rotation(rng, 3) for _ in DIMS])
        csm = np.broadcast_to(1e3 * turned @ turned.T + np.eye(9), (320, 9, 9))
        maximum = maximise(wishart(csm, 14, rng)[0], 3)
        for band in range(40):
            inside = np.arange(320) // 8 == band
            found = pair_scores(maximum, inside, n_effective=14, neighbours=INDEPENDENT)
            assert found is not None
            z.append(found.z)
    assert np.sum(np.abs(z) > 3) < 64


def test_information_on_some_pairs_is_that_on_all() -> None:
    rng = np.random.default_rng(8)
    csm = random_bench(rng, dims=(3,) * 4, snr=1e3, noise_psd=np.ones(12))
    fit = maximise(wishart(csm, 200, rng, n_draws=12), 3)
    low = np.arange(12) < 6
    halves = [
        pair_scores(fit, band, n_effective=200, neighbours=np.empty(0)) for band in (low, ~low)
    ]
    assert halves[0] is not None
    assert halves[1] is not None
    both = halves[0] + halves[1]
    table = both.between(None)
    np.testing.assert_allclose(table, table.T, atol=1e-12)
    np.testing.assert_allclose(np.diag(table), both.power, rtol=1e-9)
    some = np.array([3, 40, 65])
    np.testing.assert_allclose(both.between(some), table[:, some], atol=1e-12)
    left, kept = both.without(some), both.kept().without(some)
    np.testing.assert_allclose(left.between(None), kept.between(None), atol=1e-12)
    np.testing.assert_allclose(np.diag(left.between(None)), left.power, atol=1e-12)
