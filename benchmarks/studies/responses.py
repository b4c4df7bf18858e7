"""Calibration and unequal responses: simulated huddle tests whose sensors are known.

``calibration`` counts how often the truth lies within stated uncertainties. ``edges`` gives one of
three sensors another response: what leaks into its noise is predicted, and is gone once equalised.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from daq.bench.response import PolesZeros
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.formats.arrays import recording_of_arrays
from estimator.levels.bands import bin_correlation
from estimator.responses.calibration import CommonMotion
from estimator.responses.derived_quantities import derived
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.spectra.windows import get_window
from estimator.types import FloatArray
from tui.studies.study import Panel, Point, ProgressCallback, Series, Study

SEED = 20261123
N_DRAWS = 800
N_RUNS = 3
NOISE = 1e-12
RATE, MINUTES = 200.0, 20.0
QUANTITIES = ("matrix", "gain", "rotation_deg", "angle_deg", "orthogonality_deg", "delay", "skew")
_LEVEL, _K = 0.95, 1.96
_ALLOWED = 0.02
_DIMS = (3, 3, 3)


def calibration(progress: ProgressCallback, length: float = 1.0) -> Study:
    """Count how often the truth lies within the uncertainties of a calibration.

    Parameters
    ----------
    progress
        Takes progress.
    length
        Share of `N_DRAWS` to simulate.
    """
    n_draws = max(10, round(N_DRAWS * length))
    rng = np.random.default_rng(SEED)
    points: dict[str, list[Point]] = {name: [] for name in QUANTITIES}
    snrs = (10.0, 1e2, 1e4)
    for step, snr in enumerate(snrs):
        scores: dict[str, list[FloatArray]] = {name: [] for name in QUANTITIES}
        for draw in range(n_draws):
            progress("calibration: simulated tests", (step + draw / n_draws) / len(snrs))
            for name, score in _scores(rng, snr).items():
                scores[name].append(score)
        for name, found in scores.items():
            inside = np.abs(np.array(found)) <= _K
            error = float(np.sqrt(_LEVEL * (1 - _LEVEL) / n_draws))
            points[name].append(Point(snr, float(inside.mean()), _LEVEL, error, allowed=_ALLOWED))
    series = tuple(
        Series(name, "calibration", "share", tuple(found)) for name, found in points.items()
    )
    return Study(
        "calibration",
        f"Share of {n_draws} calibrations whose 95 % uncertainties hold the truth",
        (Panel("(a) coverage", "SNR", "share (1)", series, log="x"),),
    )


def _scores(rng: np.random.Generator, snr: float) -> dict[str, FloatArray]:
    """Return errors over stated standard errors of one simulated calibration."""
    rate, segment, n = 50.0, 200, 12_000
    turns = np.linalg.qr(np.eye(3) + 0.03 * rng.standard_normal((3, 3)))[0]
    turns *= np.sign(np.diag(turns))[:, None]
    truth = np.diag(1 + 0.02 * rng.standard_normal(3)) @ turns
    delay = 1e-3 * rng.standard_normal()
    motion = np.sqrt(snr) * rng.standard_normal((n, 3))
    turn = np.exp(-2j * np.pi * np.arange(n // 2 + 1) * rate / n * delay)
    late = np.fft.irfft(np.fft.rfft(motion, axis=0) * turn[:, None], n, axis=0)
    third = motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
    samples = np.hstack([motion, late @ truth.T, third]) + rng.standard_normal((n, 9))
    spectra = CrossSpectra(WelchSettings(rate, segment), 9)
    spectra.add(samples, np.arange(0, n - segment + 1, segment // 2))
    correlation = bin_correlation(get_window("hann", 512), 256)
    frequency, n_effective = spectra.settings.frequencies, spectra.n_effective
    motion = CommonMotion(spectra.csm(), frequency, _DIMS, 0, n_effective, correlation)
    found = motion.calibrated(1, (1.0, 20.0))
    true = {"delay": np.full(3, delay), "skew": np.zeros(2)} | derived(truth)
    scores = {}
    for name in QUANTITIES:
        value = getattr(found, name)
        some = slice(1, None) if name == "skew" else slice(None)
        scores[name] = np.ravel((value.value[some] - true[name]) / value.error[some])
    return scores


def _low_pass(corner: float, order_zeros: int = 0) -> PolesZeros:
    """Return a Butterworth response of second order; with two zeros at 0 a high-pass."""
    omega = 2 * np.pi * corner
    poles = tuple(complex(omega * (-1 + sign * 1j) / np.sqrt(2)) for sign in (1, -1))
    gain = 1.0 if order_zeros else omega**2
    return PolesZeros(zeros=(0j,) * order_zeros, poles=poles, normalization=gain)


def _resonance(frequency: float, quality: float) -> PolesZeros:
    omega = 2 * np.pi * frequency
    real, imaginary = -omega / (2 * quality), omega * np.sqrt(1 - 1 / (4 * quality**2))
    poles = (complex(real, imaginary), complex(real, -imaginary))
    return PolesZeros(zeros=(), poles=poles, normalization=omega**2)


CASES = (
    ("low-pass of 30 Hz", 1e5, None, _low_pass(30.0), (15.0, 25.0)),
    ("high-pass of 0.5 Hz", 1e6, None, _low_pass(0.5, 2), (2.0, 6.0)),
    ("corner of 0.51 not 0.50 Hz", 1e6, _low_pass(0.5, 2), _low_pass(0.51, 2), (0.7, 1.3)),
    ("resonance of 10 Hz, Q 100", 1e5, None, _resonance(10.0, 100.0), (2.0, 6.0)),
)
"""Name, SNR, response of sensors A and C, response of sensor B, and band."""


def edges(progress: ProgressCallback, length: float = 1.0) -> Study:
    """Predict and equalise what unequal responses leak, at segments of 10 s.

    Parameters
    ----------
    progress
        Takes progress.
    length
        Share of `N_RUNS` to simulate.
    """
    n_runs = max(1, round(N_RUNS * length))
    predicted: list[Point] = []
    left: dict[str, list[Point]] = {"known": [], "estimated": []}
    for number, case in enumerate(CASES):
        rng = np.random.default_rng(SEED + number)
        runs = []
        for run in range(n_runs):
            progress(f"edges: {case[0]}", (number + run / n_runs) / len(CASES))
            runs.append(_run(rng, case))
        mean = {name: float(np.mean([each[name] for each in runs])) for name in runs[0]}
        error = mean["scatter"] / np.sqrt(n_runs)
        seen = mean["off"]
        predicted.append(
            Point(number, mean["predicted"] / seen, 1.0, error * (1 + 1 / seen), allowed=0.2)
        )
        for name, points in left.items():
            points.append(Point(number, mean[name], 0.0, error, allowed=0.03))
    names = ", ".join(f"{number}: {case[0]}" for number, case in enumerate(CASES))
    return Study(
        "edges",
        f"Leakage of unequal responses at the edges of segments of 10 s ({names})",
        (
            Panel(
                "(a) predicted over seen",
                "case",
                "share (1)",
                (Series("predicted", "three-sensor", "share", tuple(predicted)),),
            ),
            Panel(
                "(b) left once equalised",
                "case",
                "fraction of the noise",
                tuple(
                    Series(name, "three-sensor", "bias", tuple(points))
                    for name, points in left.items()
                ),
            ),
        ),
    )


def _run(
    rng: np.random.Generator,
    case: tuple[str, float, PolesZeros | None, PolesZeros, tuple[float, float]],
) -> dict[str, float]:
    """Return the bias of sensor B without equalisation, as predicted, and with it."""
    _, snr, usual, other, band = case
    n = round(60 * MINUTES * RATE)
    frequency = np.maximum(np.arange(n // 2 + 1) * RATE / n, 1e-6)
    amplitude = np.sqrt(NOISE * RATE / 2)
    motion = np.sqrt(snr) * amplitude * rng.standard_normal((n, 3))
    samples = {}
    for name, response in (("A", usual), ("B", other), ("C", usual)):
        turned = motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
        if response is not None:
            spectrum = np.fft.rfft(turned, axis=0) * response.at(frequency)[:, None]
            turned = np.fft.irfft(spectrum, n, axis=0)
        samples[name] = turned + amplitude * rng.standard_normal((n, 3))
    found = {}
    for mode in ("off", "known", "estimated"):
        recording = recording_of_arrays(samples, RATE, unit="m/s²")
        for sensor, response in zip(recording.sensors, (usual, other, usual), strict=True):
            if mode == "known" and response is not None:
                sensor.channels = tuple(
                    replace(each, response=response) for each in sensor.channels
                )
        snapshot = estimate([recording], Settings(segment=10.0, equalise=mode))
        to_counts = other.at(snapshot.frequency) if mode == "known" else None
        found[mode] = _bias(snapshot, band, to_counts)
        if mode == "off":
            inside = _inside(snapshot, band)
            leaks = snapshot.diagnostics.edge_leakage
            left = np.zeros(1) if leaks is None else leaks.left[inside, 3:6]
            found["predicted"] = float(left.mean()) / NOISE
            # correlated frequencies, three channels
            count = 3 * inside.sum() / 1.9
            found["scatter"] = float(np.sqrt(2.5 / snapshot.n_effective / count))
    return found


def _inside(snapshot: Snapshot, band: tuple[float, float]) -> np.ndarray:
    return np.asarray((snapshot.frequency >= band[0]) & (snapshot.frequency < band[1]))


def _bias(snapshot: Snapshot, band: tuple[float, float], response: np.ndarray | None) -> float:
    """Return the mean noise of sensor B in a band over the true one, less 1."""
    inside = _inside(snapshot, band)
    noise = snapshot.results["three-sensor"].noise_psd[inside, 3:6]
    if response is not None:  # noise in units of the motion
        noise = noise * np.abs(response[inside, None]) ** 2
    return float(noise.mean() / NOISE - 1)
