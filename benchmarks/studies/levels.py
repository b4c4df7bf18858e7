"""Levels and intervals from time series with known noise: coverage, width, decisions.

``python -m benchmarks.studies.levels [DRAWS]`` prints the tables of ``docs/validation/levels.md``.
The generator shares nothing with the estimator but Welch's method: random sensors in random
directions, motion and noise in the time domain.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from estimator.levels.bands import band_levels, bin_correlation
from estimator.levels.interval import NORMAL_95, interval, like_psd
from estimator.levels.pooled import blocks_of
from estimator.likelihood.fisher import cramer_rao_cov
from estimator.methods import self_noise
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.spectra.windows import effective_averages, get_window
from estimator.types import FloatArray

LENGTH = 256
"""Samples of a segment."""
EDGES = np.geomspace(8, LENGTH // 2 - 1, 10).astype(np.int64)
"""Bands of about a third of an octave, in bins; the last end is below the Nyquist frequency."""
DRAWS = 100
JUDGED_DB = 3.0
BONFERRONI = 3.5
"""Quantile of the intervals of a verdict on nine channels in nine bands."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What is drawn again and again.

    Attributes
    ----------
    name : str
    snr : float
        PSD of the motion along one direction over that of noise of level 1.
    n_segments : int
    n_sensors, n_channels : int
    noise : tuple of float
        PSD of each sensor's noise, repeated as needed.
    strong : int
        Directions in which the motion is 1000 times stronger.
    ripple : float
        By which responses vary over frequency.
    colour, noise_colour : float
        Of motion and noise: coefficients of first-order autoregression.
    window : str
    overlap : float
    """

    name: str
    snr: float
    n_segments: int = 190
    n_sensors: int = 3
    n_channels: int = 3
    noise: tuple[float, ...] = (1.0,)
    strong: int = 0
    ripple: float = 0.0
    colour: float = 0.0
    noise_colour: float = 0.0
    window: str = "rectangular"
    overlap: float = 0.0


SCENES = (
    *(Scene(f"SNR {snr:g}", snr) for snr in (0.05, 0.1, 0.3, 1, 30, 1e4)),
    *(Scene(f"SNR {snr:g}, 10 segments", snr, n_segments=10) for snr in (0.3, 30)),
    *(Scene(f"SNR {snr:g}, 20 segments", snr, n_segments=20) for snr in (0.1, 1, 1e4)),
    *(Scene(f"one channel, SNR {snr:g}", snr, n_channels=1) for snr in (0.1, 1, 1e4)),
    *(Scene(f"two channels, SNR {snr:g}", snr, n_channels=2) for snr in (0.1, 1, 1e4)),
    Scene("four sensors, SNR 0.3", 0.3, n_sensors=4),
    Scene("five sensors, SNR 0.1", 0.1, n_sensors=5),
    Scene("five unequal sensors, SNR 1", 1.0, n_sensors=5, noise=(1, 3, 10, 0.3, 0.1)),
    Scene("one 30 dB quieter, SNR 0.3", 0.3, noise=(1e-3, 1, 1)),
    Scene("one 30 dB quieter, SNR 30", 30.0, noise=(1e-3, 1, 1)),
    Scene("coloured motion, SNR 0.3", 0.3, colour=0.95),
    Scene("coloured motion, SNR 30", 30.0, colour=0.98, window="hann", overlap=0.5),
    *(
        Scene(f"coloured noise, SNR {snr:g}", snr, noise_colour=0.9, window="hann", overlap=0.5)
        for snr in (0.3, 30)
    ),
    # Hann: unequal responses leak at the edges of rectangular windows, which is not the subject
    *(
        Scene(
            f"{word} × 1000, responses ±10 %", 0.3, strong=n, ripple=0.1, window="hann", overlap=0.5
        )
        for n, word in ((1, "one axis"), (2, "two axes"))
    ),
    *(Scene(f"at what a bin resolves, SNR {snr:g}", snr, n_segments=60) for snr in (0.4, 0.8, 2)),
    Scene("Hann 50 %, SNR 0.3", 0.3, window="hann", overlap=0.5),
    Scene("Hann 50 %, SNR 1e4", 1e4, window="hann", overlap=0.5),
)


def directions(scene: Scene, rng: np.random.Generator) -> FloatArray:
    """Return the direction of each channel, shape (n_channels, d): sensors turned anyhow."""
    d = scene.n_channels
    turned = [np.linalg.qr(rng.standard_normal((d, d)))[0] for _ in range(scene.n_sensors)]
    return np.concatenate(turned) * (1 + 0.02 * rng.standard_normal((scene.n_sensors * d, 1)))


def samples(scene: Scene, axes: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return time series, shape (n_samples, n_channels), of noise PSD 2 x `noise` at rate 1."""
    p, d = axes.shape
    hop = LENGTH - round(LENGTH * scene.overlap)
    n = LENGTH + hop * (scene.n_segments - 1) + 200
    motion = rng.standard_normal((n, d)) * np.sqrt(1 - scene.colour**2)
    motion = lfilter([1.0], [1.0, -scene.colour], motion, axis=0)
    power = np.where(np.arange(d) < scene.strong, 1e3, 1.0) * scene.snr
    seen = (motion * np.sqrt(power)) @ axes.T
    for channel in range(p):  # 1 + r cos(w + phase): varies by r over the spectrum
        late = scene.ripple * rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.0)
        seen[:, channel] = lfilter([1.0, late], [1.0], seen[:, channel])
    levels = np.resize(np.asarray(scene.noise, float), scene.n_sensors).repeat(scene.n_channels)
    noise: FloatArray = rng.standard_normal((n, p)) * np.sqrt(1 - scene.noise_colour**2)
    noise = lfilter([1.0], [1.0, -scene.noise_colour], noise, axis=0)
    return (seen + np.sqrt(levels) * noise)[200:]


def true_psd(scene: Scene, frequency: FloatArray) -> FloatArray:
    """Return the PSD of the noise of each channel, shape (n_freqs, n_channels)."""
    levels = np.resize(np.asarray(scene.noise, float), scene.n_sensors).repeat(scene.n_channels)
    a = scene.noise_colour
    shape = (1 - a**2) / np.abs(1 - a * np.exp(-2j * np.pi * frequency)) ** 2
    return np.asarray(2 * shape[:, None] * levels)


@dataclass(frozen=True, slots=True)
class Found:
    """Results of one scene, over all draws, bands (or bins) and channels; in noise levels."""

    bands: float
    bins: float
    joint: float
    width: float
    passed: float
    failed: float
    quiet: float
    least: float


def study(scene: Scene, n_draws: int, *, seed: int = 17) -> Found:
    """Return coverage of bands and bins, joint coverage, width over the bound, and decisions."""
    rng = np.random.default_rng([seed, SCENES.index(scene)])
    settings = WelchSettings(1.0, LENGTH, scene.overlap, scene.window, "none")
    window = get_window(scene.window, LENGTH)
    correlation = bin_correlation(window, settings.hop)
    n_effective = effective_averages(window, settings.hop, scene.n_segments)
    frequency = settings.frequencies
    psd = true_psd(scene, frequency)
    truth = np.add.reduceat(psd[: EDGES[-1]], EDGES[:-1]) / np.diff(EDGES)[:, None]
    dims = (scene.n_channels,) * scene.n_sensors
    inner = slice(int(EDGES[0]), int(EDGES[-1]))
    bands, bins, joint, width, passed, failed, quiet, least = ([] for _ in range(8))
    for _ in range(n_draws):
        axes = directions(scene, rng)
        spectra = CrossSpectra(settings, len(axes))
        x = samples(scene, axes, rng)
        spectra.add(x, np.arange(scene.n_segments) * settings.hop)
        noise = self_noise(
            "three-sensor",
            spectra.csm(),
            dims=dims,
            n_effective=n_effective,
            real=settings.real(frequency),
            blocks=blocks_of(frequency),
            correlation=correlation,
        )
        found = band_levels(noise.noise_psd, noise.cumulants, EDGES, correlation)
        low, high = found.interval()
        bands.append((low <= truth) & (truth <= high))
        bins.append((noise.low <= psd)[inner] & (psd <= noise.high)[inner])
        strict = found.interval(BONFERRONI)
        joint.append(np.all((strict[0] <= truth) & (truth <= strict[1])))
        factor = 10 ** (JUDGED_DB / 10)
        passed.append(np.all(strict[1] <= factor * truth))
        failed.append(np.any(strict[0] >= truth / factor, axis=0).all())
        quietest = truth[0] == truth[0].min()
        quiet.append((high / truth)[:, quietest])
        if scene.ripple or scene.colour or scene.noise_colour:
            continue
        power = np.where(np.arange(axes.shape[1]) < scene.strong, 1e3, 1.0) * scene.snr * 2
        csm = ((axes * power) @ axes.T + np.diag(truth[0])).astype(complex)[None]
        worth = np.array([_worth(b, correlation) for b in np.diff(EDGES)])
        bound = np.concatenate(
            [cramer_rao_cov(csm, truth[:1], n_effective=n_effective * w) for w in worth]
        )
        least.append(1 + NORMAL_95 * bound[:, quietest])
        if len(set(scene.noise)) == 1:
            ends = interval(np.ones_like(bound), like_psd(np.ones_like(bound), bound), NORMAL_95)
            known = np.isfinite(high) & np.isfinite(ends[1])
            ratio = (high - low) / truth / (ends[1] - ends[0])
            width.append(np.where(known, ratio, np.nan))
    return Found(
        bands=float(np.mean(bands)),
        bins=float(np.mean(bins)),
        joint=float(np.mean(joint)),
        width=float(np.nanmedian(width)) if width else float("nan"),
        passed=float(np.mean(passed)),
        failed=float(np.mean(failed)),
        quiet=float(np.median(np.concatenate(quiet))),
        least=float(np.median(np.concatenate(least))) if least else float("nan"),
    )


def _worth(count: int, correlation: FloatArray) -> float:
    lag = np.arange(1, len(correlation))
    pairs = np.maximum(1 - lag / count, 0.0) @ correlation[1:]
    return float(count / (1 + 2 * pairs))


def main(n_draws: int) -> None:
    """Print a row for each scene."""
    print(f"{n_draws} draws a scene; three-sensor; 9 bands of about a third of an octave\n")
    print("| scene | bands | bins | all bands | width | PASS | FAIL | upper end | least |")
    print("|---|---|---|---|---|---|---|---|---|")
    for scene in SCENES:
        found = study(replace(scene), n_draws)
        width = "" if np.isnan(found.width) else f"{found.width:.2f}"
        least = "" if np.isnan(found.least) else f"{found.least:.1f}"
        print(
            f"| {scene.name} | {found.bands:.3f} | {found.bins:.3f} | {found.joint:.2f} |"
            f" {width} | {found.passed:.2f} | {found.failed:.2f} | {found.quiet:.1f} |"
            f" {least} |",
            flush=True,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else DRAWS)
