"""Noise that two sensors share is left to them: named, and no dimension of the motion."""

from __future__ import annotations

import numpy as np
import pytest

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.results.facts.model import SharedByTwo
from daq.results.result import Result
from estimator.checks.advice_on_noise import SharedNoise
from estimator.likelihood.dimension import choose_dimension
from tests.estimator.csm_models import wishart

RATE, SECONDS = 50.0, 120.0
UNIT = 2 / RATE
"""PSD of noise of variance 1."""
AMPLITUDES = np.array([[4.0, 2.0, 0.0], [0.0, 4.0, 2.0]])
"""Of a source in the channels of the first two sensors, over their own noise."""


def recorded(
    n_sensors: int, d: int, ratio: float, rng: np.random.Generator, *, shared: bool = True
) -> dict[str, np.ndarray]:
    """Return samples of sensors in any direction, of which the first two may share noise."""
    n = round(SECONDS * RATE)
    motion = np.sqrt(ratio) * rng.standard_normal((n, d)) * np.sqrt([1.0, 1.4, 0.7])[:d]
    source = rng.standard_normal(n) * shared
    samples = {}
    for number in range(n_sensors):
        turned = np.linalg.qr(rng.standard_normal((d, d)))[0] if d > 1 else np.eye(1)
        own = rng.standard_normal((n, d))
        if number < 2:
            own += np.outer(source, AMPLITUDES[0 if d == 1 else number][:d])
        samples["ABCDEFGH"[number]] = motion @ turned.T + own
    return samples


@pytest.mark.parametrize(
    ("n_sensors", "d", "ratio"),
    [(5, 3, 0.1), pytest.param(4, 3, 10.0, marks=pytest.mark.long), (6, 1, 0.1)],
)
def test_noise_of_two_sensors_is_left_in_both_and_in_their_intervals(
    n_sensors: int, d: int, ratio: float
) -> None:
    """Before, it was taken for motion: 1.4 [-1.8, 2.9] dB for 12.3, and nothing was reported."""
    rng = np.random.default_rng([46, n_sensors, d])
    settings = Settings(segment=2.0)
    recording = recording_of_arrays(recorded(n_sensors, d, ratio, rng), RATE)
    result = Result(estimate([recording], settings), settings)
    (named,) = [each for each in result.facts if isinstance(each, SharedByTwo)]
    assert named.sensors == ("A", "B")
    assert named.part > 0.8
    truth = UNIT * (1 + np.square(AMPLITUDES[:, :d] if d > 1 else AMPLITUDES[[0, 0], :1])).ravel()
    for noise, true in zip(result.means(result.method, (5.0, 15.0)), truth, strict=False):
        assert noise.mean[0] == pytest.approx(true, rel=0.12)
        assert noise.low[0] <= true <= noise.high[0] * 1.05
        if true > 4 * UNIT:
            assert noise.low[0] < 0.5 * true  # it may be a motion that only they feel


@pytest.mark.parametrize(("ratio", "said"), [(0.1, "A and B share"), (10.0, "two of A, B and C")])
def test_noise_of_two_of_three_sensors_is_in_the_intervals_of_all(ratio: float, said: str) -> None:
    """Three quarters of these intervals excluded the noise: the others predict what they share."""
    settings = Settings(segment=2.0)
    samples = recorded(3, 3, ratio, np.random.default_rng([46, 3]))
    result = Result(estimate([recording_of_arrays(samples, RATE)], settings), settings)
    assert said in " ".join(str(each.words) for each in result.facts)
    truth = UNIT * (1 + np.square([*AMPLITUDES, np.zeros(3)])).ravel()
    for band in ((2.0, 5.0), (5.0, 15.0)):
        means = result.means(result.method, band)
        for noise, true in zip(means, truth, strict=True):
            assert noise.low[0] <= true <= noise.high[0]


@pytest.mark.parametrize("ratio", [1.0, 100.0, 1e4])
def test_two_of_four_channels_are_never_named_without_the_other_two(ratio: float) -> None:
    """Other gains explain what A and B share as noise of C and D: upper ends were at a tenth."""
    settings = Settings(segment=2.0, methods=("auto",))
    samples = recorded(4, 1, ratio, np.random.default_rng([46, 4]))
    result = Result(estimate([recording_of_arrays(samples, RATE)], settings), settings)
    for noise, true in zip(result.means(result.method, (2.0, 20.0)), (17, 17, 1, 1), strict=True):
        assert noise.low[0] <= true * UNIT <= noise.high[0]
    advice = [each for each in result.snapshot.diagnostics.advice if isinstance(each, SharedNoise)]
    named = {pair for each in advice for pair in (*each.channels, *each.alternatives)}
    assert not named or {(0, 1), (2, 3)} <= named


def test_the_bound_of_three_channels_holds_noise_that_two_share() -> None:
    """Other gains explain it, and no test sees it: a third of these intervals held the noise."""
    settings = Settings(segment=2.0)
    samples = recorded(3, 1, 1e5, np.random.default_rng([46, 3, 1]))
    result = Result(estimate([recording_of_arrays(samples, RATE)], settings), settings)
    assert not any(isinstance(each, SharedByTwo) for each in result.facts)
    for noise, true in zip(result.means(result.method, (2.0, 20.0)), (17, 17, 1), strict=True):
        assert noise.low[0] <= true * UNIT <= noise.high[0]


@pytest.mark.parametrize(("n_sensors", "d"), [(4, 3), (6, 1)])
def test_motion_of_all_sensors_is_no_noise_of_two(n_sensors: int, d: int) -> None:
    settings = Settings(segment=2.0)
    for ratio in (0.1, 10.0):
        rng = np.random.default_rng([47, n_sensors, d])
        samples = recorded(n_sensors, d, ratio, rng, shared=False)
        result = Result(estimate([recording_of_arrays(samples, RATE)], settings), settings)
        assert not any(choice.pairs for choice in result.snapshot.diagnostics.dimensions)


FOUR, FIVE = (1.6, 0.45, 1.5, 0.5), (1.0, 0.12, 1.0, 0.25, 0.7)


@pytest.mark.parametrize(
    ("seed", "noise", "motion"),
    [
        (1, FIVE, (3.0, 0.03)),
        (10, FIVE, (3.0, 0.03)),
        (4, FOUR, (1.0, 0.1)),
        (13, FOUR, (1.0, 0.1)),
    ],
)
def test_motion_that_fades_is_no_noise_of_the_two_quietest_sensors(
    seed: int, noise: tuple[float, ...], motion: tuple[float, float]
) -> None:
    """In units of the noise, most of what all feel alike is in the quietest."""
    rng = np.random.default_rng(seed)
    dims, n = (3,) * len(noise), 70
    turned = np.concatenate([np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in dims])
    frequency = np.linspace(0.5, 50.0, 120)
    fading = np.geomspace(*motion, len(frequency))
    csm = fading[:, None, None] * (turned @ turned.T) + np.diag(np.repeat(noise, 3))
    averages = wishart(csm.astype(np.complex128), n, rng)[0]
    _, choices = choose_dimension(
        averages, frequency, dims=dims, n_effective=n, neighbours=np.zeros(0)
    )
    assert any(each.n_factors < 3 for each in choices)
    assert not any(each.pairs for each in choices)
