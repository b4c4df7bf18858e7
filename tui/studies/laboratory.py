"""The laboratory set-ups: five triaxial sensors side by side, Table 1 and Fig. 14.

Segments are 10 s with a Hann window and half overlap: the paper's rectangular ones would leak the
motion at the structure's modes into bins where it is ten thousand times weaker. Theory is (13)
and (30) with the cross-spectra of the field, as such segments see them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TypeAlias

import numpy as np

from estimator.levels.bands import bin_correlation
from estimator.likelihood.dimension import choose_dimension
from estimator.likelihood.multi_part import multi_part
from estimator.methods import self_noise
from estimator.spectra.parts import PartEnds, Parts, part_bins
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.spectra.windows import get_window
from estimator.types import ComplexArray, FloatArray
from sim_devices.world import paper_scenarios
from sim_devices.world.scenario import Scenario
from sim_devices.world.world import World
from tui.studies.numerical import BIAS, BIAS_LABEL
from tui.studies.study import Panel, Point, ProgressCallback, Series, Study, StudyCurve

HANN = WelchSettings(
    sampling_rate=paper_scenarios.SAMPLING_RATE, segment_length=2000, overlap=0.5, window="hann"
)
DURATION = 3 * 3600.0
SHOWN = slice(5, 901)
"""0.5 to 90 Hz."""
BANDS = ((2.0, 5.0), (5.0, 10.0), (10.0, 20.0), (20.0, 50.0), (50.0, 80.0))
WAVE_BANDS = (*BANDS[:4], (45.0, 55.0))
CHUNK_SIZE, PIECES = 4000, 12
"""Samples simulated at a time, and how many times before they are transformed."""
FINE = 8
"""Points of the true spectrum per bin, where the window smooths it."""
REACH = 3
"""Bins to each side from which a Hann window takes power."""
PSD_LABEL, FREQUENCY_LABEL = "PSD ((m/s²)²/Hz)", "frequency (Hz)"
STYLES = {
    "three-channel": "k-",
    "three-sensor": "C0-",
    "maximum-likelihood": "C2-",
    "multi-part": "C3-",
}


@dataclass(frozen=True, slots=True)
class MeasuredSpectra:
    """Cross-spectral matrix of a scenario, and the same without statistical error.

    That is `motion` (n_freqs, n_channels, n_channels) and `noise` (n_freqs, n_channels) on its
    diagonal.
    """

    scenario: Scenario
    csm: ComplexArray
    motion: ComplexArray
    noise: FloatArray
    n_effective: float
    parts: Parts

    def of(self, sensors: tuple[str, ...]) -> MeasuredSpectra:
        """Return the part that belongs to some sensors, in their order."""
        first = {name: 3 * number for number, name in enumerate(self.scenario.names)}
        used = np.concatenate([first[name] + np.arange(3) for name in sensors])
        square = np.ix_(np.arange(len(self.csm)), used, used)
        return replace(
            self, csm=self.csm[square], motion=self.motion[square], noise=self.noise[:, used]
        )


Laboratory: TypeAlias = Callable[[str], MeasuredSpectra]
"""Returns what the sensors of a set-up read."""


def laboratory(progress: ProgressCallback, *, length: float = 1.0) -> Laboratory:
    """Return what simulates a named scenario, once, and transforms what its sensors read."""

    @cache
    def measured(name: str) -> MeasuredSpectra:
        told = partial(progress, f"{name}: triaxial sensors")
        return measure(paper_scenarios.named(name), duration=DURATION * length, progress=told)

    return measured


def measure(
    scenario: Scenario, *, duration: float, progress: Callable[[float], None]
) -> MeasuredSpectra:
    """Simulate triaxial sensors for a duration in seconds, and transform what they read."""
    world = World(scenario)
    bins = part_bins(len(HANN.frequencies), 3 * len(scenario.names))
    spectra = CrossSpectra(HANN, 3 * len(scenario.names), ends=PartEnds(bins))
    length, hop = HANN.segment_length, HANN.hop
    n_samples = round(duration * HANN.sampling_rate)
    kept: list[FloatArray] = []
    for first in range(0, n_samples, CHUNK_SIZE):
        n = min(CHUNK_SIZE, n_samples - first)
        # all sensors in turn: they share the waves' spectra, and only the last two are kept
        samples = [world.samples(name, first, n) for name in scenario.names]
        kept.append(np.concatenate(samples, axis=1))
        if len(kept) == PIECES or first + n == n_samples:
            together = np.concatenate(kept)
            starts = np.arange(0, len(together) - length + 1, hop)
            spectra.add(together, starts)
            spectra.end_part(spectra.n_segments)
            kept = [together[len(starts) * hop :]]
            progress((first + n) / n_samples)
    return MeasuredSpectra(
        scenario=scenario,
        csm=spectra.csm()[SHOWN],
        motion=smoothed(lambda f: world.motion_csm(scenario.names, f), HANN)[SHOWN],
        noise=smoothed(lambda f: true_noise(scenario, scenario.names, f), HANN)[SHOWN].real,
        n_effective=spectra.n_effective,
        parts=Parts(bins, spectra.parts(spectra.n_segments)),
    )


def smoothed(
    spectrum: Callable[[FloatArray], FloatArray | ComplexArray], settings: WelchSettings
) -> ComplexArray:
    """Spectrum that windowed segments have on average.

    Parameters
    ----------
    spectrum
        From frequency in Hz, shape (n,), to the true spectrum, shape (n, ...).
    settings
        Of the segments.

    Returns
    -------
    complex128, shape (n_freqs, ...)
        The true spectrum, smoothed by the power of the window's transform.
    """
    window = get_window(settings.window, settings.segment_length)
    offsets = np.arange(-REACH * FINE, REACH * FINE + 1) / FINE
    turns = np.outer(offsets, np.arange(settings.segment_length)) / settings.segment_length
    weights = np.abs(np.exp(-2j * np.pi * turns) @ window) ** 2
    weights /= weights.sum()
    bin_width = settings.sampling_rate / settings.segment_length
    total = np.zeros((), dtype=complex)
    for offset, weight in zip(offsets, weights, strict=True):
        frequency = settings.frequencies + offset * bin_width
        part = spectrum(np.abs(frequency))
        part[frequency < 0] = part[frequency < 0].conj()
        total = total + weight * part
    return np.asarray(total)


def true_noise(scenario: Scenario, sensors: tuple[str, ...], frequency: FloatArray) -> FloatArray:
    """Return the true noise PSD of the sensors' channels, shape (n_freqs, n_channels)."""
    return np.transpose(
        [
            scenario.true_noise_psd(sensor, channel, frequency)
            for sensor in sensors
            for channel in range(scenario.n_channels(sensor))
        ]
    )


@dataclass(frozen=True, slots=True)
class Noise:
    """Estimated and true noise of some channels, shapes (n_freqs, n_channels)."""

    method: str
    estimate: FloatArray
    limit: FloatArray
    deviation: FloatArray
    truth: FloatArray


def estimate(
    measured: MeasuredSpectra, sensors: tuple[str, ...], method: str, *, n_channels: int = 1
) -> Noise:
    """Estimate the noise of the leading channels of some sensors.

    Theory expects (13) or (30) with the motion's true cross-spectra.
    """
    part, dims, n = measured.of(sensors), (3,) * len(sensors), measured.n_effective
    truth = true_noise(measured.scenario, sensors, HANN.frequencies[SHOWN])
    found = self_noise(method, part.csm, dims=dims, n_effective=n)
    channel = np.arange(sum(dims))
    expected = part.motion.copy()
    expected[:, channel, channel] += part.noise
    predicted = self_noise(method, expected, dims=dims, n_effective=n)
    limit = part.noise + truth * BIAS[method](part.motion, truth, dims=dims)
    return Noise(
        method=method,
        estimate=found.noise_psd[:, :n_channels],
        limit=limit[:, :n_channels],
        deviation=(predicted.cov * np.abs(predicted.noise_psd))[:, :n_channels],
        truth=truth[:, :n_channels],
    )


def estimate_any_dimension(measured: MeasuredSpectra, *, n_channels: int) -> Noise:
    """Estimate by maximum likelihood, with as many dimensions of motion as the test asks for.

    Theory expects the true noise, though only as far as the motion has no further dimensions.
    """
    sensors = measured.scenario.names[::-1]  # the one in the middle comes first
    dims, n = (3,) * len(sensors), measured.n_effective
    csm = measured.of(sensors).csm
    n_factors, _ = choose_dimension(csm, HANN.frequencies[SHOWN], dims=dims, n_effective=n)
    found = self_noise("maximum-likelihood", csm, dims=dims, n_effective=n, n_factors=n_factors)
    truth = true_noise(measured.scenario, sensors, HANN.frequencies[SHOWN])[:, :n_channels]
    cov = np.where(np.isfinite(found.cov), found.cov, 1.0)[:, :n_channels]  # at zero: one
    return Noise("maximum-likelihood", found.noise_psd[:, :n_channels], truth, cov * truth, truth)


def band_series(
    noise: Noise,
    *,
    label: str,
    bands: tuple[tuple[float, float], ...] = BANDS,
    allowed: Callable[[float], float] = lambda _: 0.0,
) -> Series:
    """Mean fractional bias over each band and all channels, and its limit.

    The error is as if the channels' estimates were wrong all in the same way, as they are where
    the motion is what they share.
    """
    frequency = HANN.frequencies[SHOWN]
    correlation = bin_correlation(get_window(HANN.window, HANN.segment_length), HANN.hop)
    both_sides = np.concatenate([correlation[:0:-1], correlation])
    points = []
    for low, high in bands:
        band = (frequency >= low) & (frequency < high)
        truth = noise.truth[band]
        variance = [
            np.convolve(spread, both_sides, "same") @ spread
            for spread in (noise.deviation[band] / truth).T
        ]
        centre = float(np.sqrt(low * high))
        points.append(
            Point(
                x=centre,
                measured=float(np.mean(noise.estimate[band] / truth - 1)),
                theory=float(np.mean(noise.limit[band] / truth - 1)),
                error=float(np.mean(np.sqrt(variance)) / band.sum()),
                allowed=allowed(high),
            )
        )
    return Series(label, noise.method, "bias", tuple(points))


def _spectra(
    title: str, record: StudyCurve, noises: tuple[Noise, ...], *, benchmark: Noise | None = None
) -> Panel:
    """Draw a record and the noise of its first channel."""
    frequency = HANN.frequencies[SHOWN]
    estimates = [(noise.method, noise.estimate, STYLES[noise.method]) for noise in noises]
    reference = ("true noise", noises[0].truth, "r-")
    if benchmark is not None:
        reference = ("benchmark: E, C, D", benchmark.estimate, "r-")
    curves = [
        StudyCurve(label, frequency, np.where(psd[:, 0] > 0, psd[:, 0], np.nan), style)
        for label, psd, style in (*estimates, reference)
    ]
    return Panel(title, FREQUENCY_LABEL, PSD_LABEL, curves=(record, *curves), log="xy")


def _record(measured: MeasuredSpectra, sensor: str) -> StudyCurve:
    power = measured.of((sensor,)).csm[:, 0, 0].real
    return StudyCurve("motion and noise", HANN.frequencies[SHOWN], power, "k:")


def _biases(title: str, *series: Series) -> Panel:
    return Panel(title, FREQUENCY_LABEL, BIAS_LABEL, series=series, log="x")


def case(measured_of: Laboratory, number: str) -> tuple[Panel, Panel]:
    """Spectra of one case of Table 1, and the bias of both methods by band."""
    setup, sensors = paper_scenarios.CASES[number]
    measured = measured_of(setup)
    noises = tuple(
        estimate(measured, sensors, method) for method in ("three-channel", "three-sensor")
    )
    label = f"case {number} ({', '.join(sensors)})"
    return (
        _spectra(label, _record(measured, sensors[0]), noises),
        _biases(f"{label}: bias", *(band_series(noise, label=label) for noise in noises)),
    )


def setup1(measured_of: Laboratory) -> Study:
    """Cases 0, 1 and 2 of Table 1 (Figs. 7 and 10, a to c)."""
    panels = tuple(panel for number in "012" for panel in case(measured_of, number))
    return Study("setup1", "Set-up 1: A and B turned by 60°", panels)


def setup2(measured_of: Laboratory) -> Study:
    """Case 3 of Table 1 (Figs. 7d and 10d)."""
    return Study("setup2", "Set-up 2: A, B and E all turned", case(measured_of, "3"))


def fig14(measured_of: Laboratory) -> Study:
    """Wider triangles, where coherence fails, and the estimate of all five sensors.

    The benchmark is that of the paper: the estimate of case 0.
    """
    measured = measured_of("setup1")
    benchmark = estimate(measured, paper_scenarios.CASES["0"][1], "three-sensor")
    record = _record(measured, "E")
    panels: list[Panel] = []
    for letter, sensors in (("a", ("E", "A", "C")), ("b", ("E", "A", "D"))):
        noise = estimate(measured, sensors, "three-sensor")
        label = f"({letter}) {', '.join(sensors)}"
        panels += [
            _spectra(label, record, (noise,), benchmark=benchmark),
            _biases(f"{label}: bias", band_series(noise, label=label)),
        ]
    noise = estimate_any_dimension(measured, n_channels=1)
    label = "all five"
    panels += [
        _spectra(label, record, (noise,)),
        _biases(f"{label}: bias", band_series(noise, label=label, allowed=_goal)),
    ]
    return Study("fig14", "Wider triangles are less coherent; five sensors know", tuple(panels))


def waves(measured_of: Laboratory) -> Study:
    """Five sensors of any direction where the motion is far from coherent: beyond the paper."""
    measured = measured_of("waves")
    triangle = estimate(measured, ("E", "C", "D"), "three-sensor", n_channels=3)
    five = estimate_any_dimension(measured, n_channels=15)
    return Study(
        "waves",
        "Waves at 150 m/s, SNR 1000: three sensors, and five",
        (
            _spectra("E", _record(measured, "E"), (triangle, five)),
            _biases(
                "bias",
                band_series(triangle, label="E, C, D", bands=WAVE_BANDS),
                band_series(five, label="all five", bands=WAVE_BANDS, allowed=_goal),
            ),
        ),
    )


def two(measured_of: Laboratory) -> Study:
    """Two sensors in motion whose level changes: beyond the paper."""
    measured = measured_of("two")
    correlation = bin_correlation(get_window(HANN.window, HANN.segment_length), HANN.hop)
    frequency = HANN.frequencies[measured.parts.bins]
    found = multi_part(
        *(measured.parts.csm(), measured.parts.averages, frequency),
        dims=(3, 3),
        correlation=correlation,
        usable=(frequency > 0) & (frequency <= HANN.frequencies[SHOWN][-1]),
    ).noise
    truth = true_noise(measured.scenario, measured.scenario.names, HANN.frequencies[SHOWN])
    deviation = np.sqrt(found.cumulants[0][SHOWN])
    noise = Noise("multi-part", found.noise_psd[SHOWN], truth, deviation, truth)
    return Study(
        "two",
        "Two triaxial sensors, motion that changes by 6 dB, SNR 30",
        (
            _spectra("A and B", _record(measured, "A"), (noise,)),
            _biases("bias", band_series(noise, label="A and B")),
        ),
    )


def _goal(high: float) -> float:
    """Bias that is left to the five sensors: 5 % to 20 Hz, 20 % above."""
    return 0.05 if high <= 20 else 0.2


LABORATORY: Mapping[str, Callable[[Laboratory], Study]] = {
    "setup1": setup1,
    "setup2": setup2,
    "fig14": fig14,
    "waves": waves,
    "two": two,
}
