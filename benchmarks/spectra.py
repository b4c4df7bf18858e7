"""The estimator: cross-spectral matrix, methods, memory and live updates."""

from __future__ import annotations

import subprocess
import sys
from functools import partial

import numpy as np
import scipy.fft
from scipy import signal

from benchmarks.row import Row, least_work
from estimator.checks.shared_noise import shared_noise
from estimator.likelihood.dimension import bands
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.goodness_of_fit import HANN_HALF
from estimator.methods import self_noise
from estimator.spectra.equaliser import design
from estimator.spectra.welch import CrossSpectra, WelchSettings

RATE, LENGTH, HOURS = 200, 2000, 3
REPEATS = 7
TRIAXIAL = (3, 3, 3)

# The peak of the program itself: getrusage would count its parent before the exec.
STREAM = """
import sys
import numpy as np
from benchmarks.row import peak_memory
from estimator.methods import self_noise
from estimator.spectra.welch import CrossSpectra, WelchSettings

settings = WelchSettings(200.0, 2000)
chunk = np.random.default_rng(0).standard_normal((120_000, 9))
starts = np.arange(0, len(chunk) - 1999, settings.hop)
spectra = CrossSpectra(settings, 9)
for _ in range(round(6 * float(sys.argv[1]))):
    spectra.add(chunk, starts)
self_noise("three-sensor", spectra.csm(), dims=(3, 3, 3), n_effective=spectra.n_effective)
print(peak_memory())
"""


def run(*, smallest: bool = False) -> list[Row]:
    """Measure every row of the design's table that is the estimator's alone."""
    n_samples = round((0.05 if smallest else HOURS) * 3600 * RATE)
    few, many = (0.1, 0.2) if smallest else (4.0, 24.0)
    repeats = 1 if smallest else REPEATS
    return [
        *_speed(n_samples, repeats),
        *_beside(n_samples, repeats),
        *_memory(few, many),
        *_live(repeats),
    ]


def _records(n_sensors: int, n_samples: int, snr: float = 1e4) -> np.ndarray:
    """Triaxial sensors, turned at random, on one white motion, with noise of 0.01."""
    rng = np.random.default_rng(0)
    motion = 0.01 * np.sqrt(snr) * rng.standard_normal((n_samples, 3))
    turned = [motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(n_sensors)]
    return np.concatenate(turned, axis=1) + 0.01 * rng.standard_normal((n_samples, 3 * n_sensors))


def _speed(n_samples: int, repeats: int) -> list[Row]:
    samples = _records(3, n_samples)
    span = f"{n_samples / RATE / 3600:g} h"
    rows = []
    for name, settings in (
        ("Hann, 50 % overlap", WelchSettings(RATE, LENGTH)),
        ("rectangular, no overlap", WelchSettings(RATE, LENGTH, 0.0, "rectangular")),
    ):
        starts = np.arange(0, len(samples) - LENGTH + 1, settings.hop)
        windows = np.lib.stride_tricks.sliding_window_view(samples, LENGTH, axis=0)
        segments = np.ascontiguousarray(windows[starts])
        result: dict[str, CrossSpectra] = {}

        def estimate(
            settings: WelchSettings = settings,
            starts: np.ndarray = starts,
            result: dict[str, CrossSpectra] = result,
        ) -> None:
            result["spectra"] = spectra = CrossSpectra(settings, 9)
            spectra.add(samples, starts)
            averages = spectra.n_effective
            self_noise("three-sensor", spectra.csm(), dims=TRIAXIAL, n_effective=averages)

        def bare(segments: np.ndarray = segments) -> None:
            scipy.fft.rfft(segments, axis=-1, workers=1)

        def one_row_of_pairs(settings: WelchSettings = settings) -> None:
            window = "boxcar" if settings.window == "rectangular" else "hann"
            for q in range(9):
                signal.csd(
                    samples[:, q],
                    samples[:, 0],
                    RATE,
                    window,
                    LENGTH,
                    LENGTH - settings.hop,
                )

        ours, bare_time = least_work(estimate, bare, repeats=repeats)
        (pairs,) = least_work(one_row_of_pairs, repeats=1)
        title = f"9×9 matrix and three-sensor estimate, {span} at 200 Hz, {name}"
        rows += [
            Row(title, ours / bare_time, "× bare rfft", at_most=1.2),
            Row(title, 9 * pairs / ours, "× faster than the csd loop", at_least=50),
        ]
    csm = result["spectra"].csm()
    three, likelihood = least_work(
        *(
            partial(self_noise, method, csm, dims=TRIAXIAL, n_effective=1080.0)
            for method in ("three-sensor", "maximum-likelihood")
        ),
        repeats=repeats,
    )
    title = "maximum likelihood, 1001 frequencies × 9 channels"
    return [*rows, Row(title, likelihood / three, "× three-sensor", at_most=10)]


def _beside(n_samples: int, repeats: int) -> list[Row]:
    """Measure equalisation and score tests against one three-sensor estimate: processor time."""
    samples = _records(3, n_samples)
    span = f"{n_samples / RATE / 3600:g} h"
    settings = WelchSettings(RATE, LENGTH)
    starts = np.arange(0, len(samples) - LENGTH + 1, settings.hop)
    grid = settings.frequencies
    wanted = np.ones((len(grid), 9), dtype=np.complex128)
    wanted[:, 3:6] = ((1 + 1j * grid / 30) / (1 + 1j * grid / 60))[:, None]  # of one sensor
    filters = design(wanted, RATE, longest=LENGTH // 4)
    result: dict[str, CrossSpectra] = {}

    def estimate() -> None:
        result["spectra"] = spectra = CrossSpectra(settings, 9)
        spectra.add(samples, starts)
        self_noise("three-sensor", spectra.csm(), dims=TRIAXIAL, n_effective=spectra.n_effective)

    def equalise() -> None:
        step = 120 * RATE
        for first in range(0, len(samples) - step, step):
            filters.apply(samples[first : first + step + 2 * filters.reach])

    (one,) = least_work(estimate, repeats=repeats)
    csm, n = result["spectra"].csm()[1:-1], result["spectra"].n_effective
    maximum = maximise(csm, 3)
    number = bands(grid[1:-1])
    separate = [number == each for each in np.unique(number)]

    def score() -> None:
        shared_noise(maximum, separate, dims=TRIAXIAL, n_effective=n, neighbours=HANN_HALF)

    filtering, scoring = least_work(equalise, score, repeats=repeats)
    return [
        Row(
            f"equalisation of one sensor and score tests, {span} × 9 × 200 Hz",
            (filtering + scoring) / one,
            "× three-sensor estimate",
            at_most=1.0,
            note=f"equalisation {filtering / one:.2f}, score tests {scoring / one:.2f}",
        )
    ]


def _memory(few: float, many: float) -> list[Row]:
    peaks = [
        float(subprocess.check_output([sys.executable, "-c", STREAM, str(hours)]))
        for hours in (few, many)
    ]
    return [
        Row(
            f"memory of an estimate of {many:g} h × 9 × 200 Hz, streamed",
            peaks[1],
            "MB",
            at_most=250,
        ),
        Row(f"the same, over that of {few:g} h", peaks[1] / peaks[0], "×", at_most=1.5),
    ]


def _live(repeats: int) -> list[Row]:
    settings = WelchSettings(RATE, LENGTH)
    rows = []
    for method, snr, share in (
        ("three-sensor", 1e4, 1.0),
        ("maximum-likelihood", 1e4, 10.0),
        ("maximum-likelihood", 0.1, 10.0),
    ):
        samples = _records(5, 110 * RATE, snr)
        spectra = CrossSpectra(settings, 15)
        spectra.add(samples, np.arange(0, len(samples) - LENGTH, settings.hop))

        def update(
            method: str = method,
            spectra: CrossSpectra = spectra,
            samples: np.ndarray = samples,
        ) -> None:
            spectra.add(samples[-LENGTH:], np.array([0]))
            self_noise(method, spectra.csm(), dims=(3,) * 5, n_effective=spectra.n_effective)

        (seconds,) = least_work(update, repeats=repeats)
        rows.append(
            Row(
                f"live update, five triaxial sensors, SNR {snr:g}, {method}",
                100 * seconds / (settings.hop / RATE),
                "% of the time its new samples took",
                at_most=share,
                note=""
                if snr > 1
                else "motion lost in the noise everywhere; updates are spaced (Throttle)",
            )
        )
    return rows
