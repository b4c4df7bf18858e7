"""Tests drawn at random, with known noise: whether intervals cover, and advice is true.

The other studies vary one thing at a time. Here sensors, channels, orientation, SNR, colour and
spread of the noise, gains, length and segment are drawn together. Some tests have a sensor of
another response, or one that lags. So combinations are seen that nobody thought of.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from benchmarks.studies.judged import METHODS, Judged
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from estimator.checks.advice import Advice
from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_noise import SharedNoise
from estimator.checks.advice_on_sensors import Delay, Gain, Rotated, UnequalResponses
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.types import FloatArray
from tui.studies.study import ProgressCallback, Study

RANDOM_TESTS = "random-tests"
N_TESTS = 400
SEED = 27
RATE = 100.0
BANDS = ((1.0, 10.0), (10.0, 40.0))
LOW_PASS, LAGS = 0.2, 0.15
"""Shares of tests in which sensor B has a low-pass, and in which sensor C lags by one sample."""
SETTLING = 2000
"""Samples before a filter has forgotten its start."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What a test consists of.

    Attributes
    ----------
    n_sensors, n_channels : int
        Sensors, and channels of each.
    seconds, segment : float
        Length of the test and of a segment, in seconds.
    turned : str
        How the sensors stand: ``parallel``, ``tilted`` by 0.05 rad, or ``anyhow``.
    snr : float
        Power of the motion over that of the noise of a sensor of mean noise.
    spread : float
        Ratio of the largest standard deviation of noise to the smallest, at most.
    colours : tuple of float
        Coefficients of first-order autoregression: of the motion, of the noise.
    gains : float
        Standard deviation of the channels' gains from 1.
    n_directions : int
        Of strong motion; in the others it has a tenth of the amplitude.
    corner : float, optional
        Corner frequency of the low-pass of sensor B, in Hz.
    lag : int
        Of sensor C, in samples.
    lean : float
        By which axes of sensors with one channel are off, rms, in degrees: they feel motion across.
    """

    n_sensors: int
    n_channels: int
    seconds: float
    segment: float
    turned: str
    snr: float
    spread: float
    colours: tuple[float, float]
    gains: float
    n_directions: int
    corner: float | None
    lag: int
    lean: float


def draw_scene(rng: np.random.Generator) -> Scene:
    """Draw a scene."""
    d = int(rng.choice([1, 3, 3]))
    return Scene(
        n_sensors=int(rng.choice([3, 3, 4, 5])),
        n_channels=d,
        seconds=float(rng.choice([120, 300, 600, 1200])),
        segment=float(rng.choice([2, 5, 10])),
        turned=str(rng.choice(["parallel", "tilted", "anyhow"])) if d > 1 else "parallel",
        snr=10 ** rng.uniform(-1.5, 6),
        spread=float(rng.choice([1, 1, 3, 10, 30])),
        colours=(float(rng.choice([0, 0.9, 0.98])), float(rng.choice([0, 0.5, 0.9]))),
        gains=float(rng.choice([0, 0.01, 0.1])),
        n_directions=int(rng.choice([d, d, d, 1])),
        corner=float(rng.uniform(10, 40)) if rng.random() < LOW_PASS else None,
        lag=int(rng.random() < LAGS),
        lean=float(rng.uniform(0.1, 1.0)) if d == 1 else 0.0,
    )


def simulate(scene: Scene, rng: np.random.Generator) -> tuple[dict[str, FloatArray], FloatArray]:
    """Return the samples of each sensor, and the standard deviations of the channels' noise."""
    n, d = round(scene.seconds * RATE), scene.n_channels
    of_motion, of_noise = scene.colours

    def coloured(colour: float, d: int = d) -> FloatArray:
        white = rng.standard_normal((n + SETTLING, d)) * np.sqrt(1 - colour**2)
        return np.asarray(lfilter([1], [1, -colour], white, axis=0)[SETTLING:])

    motion = coloured(of_motion) * np.where(np.arange(d) >= scene.n_directions, 0.1, 1.0)[::-1]
    across = coloured(of_motion, 2)
    samples, deviations = {}, []
    for name in "ABCDE"[: scene.n_sensors]:
        seen = motion @ _turn(scene, rng) * (1 + scene.gains * rng.standard_normal(d))
        if scene.lean:
            lean = np.radians(scene.lean) / np.sqrt(2) * rng.standard_normal(2)
            seen = seen + (across @ lean)[:, None]
        if name == "B" and scene.corner is not None:
            pole = np.exp(-2 * np.pi * scene.corner / RATE)
            seen = lfilter([1 - pole], [1, -pole], seen, axis=0)
        if name == "C" and scene.lag:
            seen = np.roll(seen, scene.lag, axis=0)
        deviation = scene.spread ** rng.uniform(-0.5, 0.5, d) / np.sqrt(scene.snr)
        samples[name] = seen + deviation * coloured(of_noise)
        deviations.append(deviation)
    return samples, np.concatenate(deviations)


def _turn(scene: Scene, rng: np.random.Generator) -> FloatArray:
    if scene.turned == "parallel":
        return np.eye(scene.n_channels)
    if scene.turned == "tilted":
        return np.asarray(Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix())
    return np.asarray(Rotation.random(random_state=rng).as_matrix())


def noise_psd(scene: Scene, deviations: FloatArray, frequency: FloatArray) -> FloatArray:
    """Return the PSD of the noise of each channel, shape (n_freqs, n_channels)."""
    colour = scene.colours[1]
    shape = (1 - colour**2) / np.abs(1 - colour * np.exp(-2j * np.pi * frequency / RATE)) ** 2
    return np.asarray(shape[:, None] * deviations**2 * 2 / RATE)


FALSE: dict[type[Advice], Callable[[Scene], bool]] = {
    Delay: lambda scene: not scene.lag and scene.corner is None,
    Gain: lambda scene: not scene.gains and scene.corner is None,
    Rotated: lambda scene: scene.turned == "parallel",
    UnequalResponses: lambda scene: not scene.lag and scene.corner is None,
    NoSharedMotion: lambda _: True,
    ModelMisfit: lambda scene: not scene.lag and scene.corner is None and not scene.lean,
    SharedNoise: lambda scene: not scene.lag and scene.corner is None,
}
"""Kinds of advice, and in which scenes they are wrong."""


def random_tests(progress: ProgressCallback, length: float = 1.0) -> Study:
    """Judge intervals and advice on tests drawn at random.

    Parameters
    ----------
    progress
        Takes progress.
    length
        Share of `N_TESTS` to simulate.
    """
    n_tests = max(12, round(N_TESTS * length))
    judged = Judged()
    for number in range(n_tests):
        progress("random tests", number / n_tests)
        rng = np.random.default_rng([SEED, number])
        scene = draw_scene(rng)
        samples, deviations = simulate(scene, rng)
        settings = Settings(segment=scene.segment, methods=METHODS)
        snapshot = estimate([recording_of_arrays(samples, RATE)], settings)
        judged.add(
            snapshot,
            settings,
            noise_psd=noise_psd(scene, deviations, snapshot.frequency),
            bands=BANDS,
            snr=scene.snr,
            is_wrong={kind: wrong(scene) for kind, wrong in FALSE.items()},
        )
    return judged.study(RANDOM_TESTS, f"{n_tests} tests drawn at random")
