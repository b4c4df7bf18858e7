"""Figures 4, 5, 9, 12 and 13: white motion and noise, uniaxial and biaxial sensors.

All of them are linear in the same ingredients: two directions of motion and six noises. So these
are simulated once, at the paper's full length, and their cross-spectral matrix is estimated from
the samples; the matrix of any geometry and SNR is then that one between two matrices of
direction cosines and levels, exactly as if its own samples had been transformed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Literal

import numpy as np

from estimator.methods import self_noise
from estimator.self_noise.bias import three_channel_bias, three_sensor_bias
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.types import ComplexArray, FloatArray
from sim_devices.errors import ScenarioError
from sim_devices.world import paper_scenarios
from sim_devices.world.scenario import Scenario
from sim_devices.world.spectrum import White
from sim_devices.world.tables import CommonMotion, SensorModel
from sim_devices.world.world import World
from tui.studies.study import Panel, Point, ProgressCallback, Series, Study

PAPER = WelchSettings(
    sampling_rate=paper_scenarios.SAMPLING_RATE,
    segment_length=2000,
    overlap=0.0,
    window="rectangular",
    detrend="none",
)
"""The paper's: 10 s, neither window nor overlap."""
SEGMENTS_3H, SEGMENTS_10H = 1080, 3600
BAND = slice(1, 901)
"""0.1 to 90 Hz, over which the paper averages."""
SEGMENTS_AT_ONCE = 24
N_NOISES = 6
AT = np.array([10.0])
"""A frequency; levels are the same at all frequencies."""

SNRS = (1.0, 10.0, 100.0, 1e3, 1e4)
BIAS = {"three-channel": three_channel_bias, "three-sensor": three_sensor_bias}
ALPHAS = (10.0, 20.0, 30.0, 45.0, 60.0, 75.0, 90.0)
SNR_LABEL = "SNR of the target channel (1)"
ALPHA_LABEL = "channel angle α (°)"
BIAS_LABEL, COV_LABEL = "fractional bias (1)", "coefficient of variation (1)"
THREE_CHANNEL, THREE_SENSOR = "three-channel", "three-sensor"


def unit_scenario(seed: int) -> Scenario:
    """Two directions of motion and six noises, all of unit PSD."""
    unit, rate = White(level=1.0), PAPER.sampling_rate
    noises = SensorModel(
        sampling_rate=rate, directions=((1.0, 0.0),) * N_NOISES, gain=0.0, noise=unit
    )
    return Scenario(
        seed=seed,
        motion=CommonMotion(spectra=(unit, unit)),
        sensors={"motion": SensorModel(sampling_rate=rate), "noises": noises},
    )


class Ingredients:
    """Cross-spectral matrices of unit motions and unit noises, simulated on first use.

    Parameters
    ----------
    progress
        Takes progress.
    length
        Share of the paper's length.
    """

    def __init__(self, progress: ProgressCallback, *, length: float = 1.0) -> None:
        self._progress = progress
        self._length = length
        self._matrices: dict[int, tuple[ComplexArray, int]] = {}

    def csm(self, n_segments: int) -> tuple[ComplexArray, int]:
        """Return the matrix (n_freqs, 8, 8) within BAND, and how many segments it has."""
        if n_segments not in self._matrices:
            n_used = max(1, round(n_segments * self._length))
            self._matrices[n_segments] = self._simulate(n_used), n_used
        return self._matrices[n_segments]

    def _simulate(self, n_segments: int) -> ComplexArray:
        scenario, length = unit_scenario(n_segments), PAPER.segment_length
        world = World(scenario)
        spectra = CrossSpectra(PAPER, 2 + N_NOISES)
        while spectra.n_segments < n_segments:
            first = spectra.n_segments * length
            n = min(SEGMENTS_AT_ONCE, n_segments - spectra.n_segments) * length
            samples = [world.samples(name, first, n) for name in scenario.names]
            spectra.add(np.concatenate(samples, axis=1), np.arange(0, n, length))
            self._progress(
                f"white motion and noise, {n_segments} segments", spectra.n_segments / n_segments
            )
        return spectra.csm()[BAND]


def outcome(
    ingredients: Ingredients, scenario: Scenario, *, n_segments: int, method: str, x: float
) -> tuple[Point, Point]:
    """Bias and c.o.v. of the noise of the first channel of a scenario, with theory.

    Parameters
    ----------
    ingredients
        Components of the samples of the scenario.
    scenario
        White motion with two directions; all noises of the paper's level.
    n_segments
        Of the paper.
    method
        The three-channel method is given the first channel of each sensor, others all.
    x
        Where the points stand on their axis.

    Returns
    -------
    tuple of Point
        Mean over the band against (13) or (30), spread over the band against the delta method.
    """
    units, n = ingredients.csm(n_segments)
    mix, dims = mixture(scenario, leading=method == THREE_CHANNEL)
    used = [0, 1, *range(2, 2 + len(mix))]
    csm = mix @ units[:, used][:, :, used] @ mix.T
    truth = (mix @ mix.T).astype(complex)[None]
    noise = float(scenario.true_noise_psd(scenario.names[0], 0, AT)[0])
    estimate = self_noise(method, csm, dims=dims, n_effective=n).noise_psd[:, 0]
    spread = float(self_noise(method, truth, dims=dims, n_effective=n).cov[0, 0])
    motion = truth - np.diag(np.diag(mix[:, 2:]) ** 2)
    noises = np.diag(mix[:, 2:])[None] ** 2
    bias = float(BIAS[method](motion, noises, dims=dims)[0, 0])
    mean, deviation, n_bins = estimate.mean(), estimate.std(ddof=1), len(estimate)
    bias_error = spread * (1 + bias) / np.sqrt(n_bins)
    # of a normal sample's deviation, and of the mean that it is divided by
    cov_error = spread * np.sqrt((0.5 + spread**2) / n_bins)
    return (
        Point(x, measured=float(mean / noise - 1), theory=bias, error=bias_error),
        Point(x, measured=float(deviation / mean), theory=spread, error=cov_error),
    )


def mixture(scenario: Scenario, *, leading: bool) -> tuple[FloatArray, tuple[int, ...]]:
    """Say what a scenario's channels take of each ingredient, and how many each sensor has.

    Parameters
    ----------
    scenario
        Of common motion, white throughout.
    leading
        Of each sensor, only the first channel.

    Returns
    -------
    mix : float64, shape (n_channels, 2 + n_channels)
        ``samples = ingredients @ mix.T``.
    dims : tuple of int
    """
    if not isinstance(scenario.motion, CommonMotion):
        raise ScenarioError("a field of waves has no ingredients that all sensors share")
    motion = np.sqrt([spectrum.psd(AT)[0] for spectrum in scenario.motion.spectra])
    dims, directions, noise = [], [], []
    for name in scenario.names:
        n = 1 if leading else scenario.n_channels(name)
        dims.append(n)
        directions.append(scenario.directions(name)[:n])
        noise += [scenario.true_noise_psd(name, channel, AT)[0] for channel in range(n)]
    own = np.diag(np.sqrt(noise))
    return np.concatenate([np.concatenate(directions) * motion, own], axis=1), tuple(dims)


def _series(
    ingredients: Ingredients,
    scenario: Callable[..., Scenario],
    *,
    n_segments: int,
    method: str,
    label: str,
    **axis: tuple[float, ...],
) -> tuple[Series, Series]:
    """Bias and c.o.v. along an axis: an argument of the scenario, and its values."""
    ((name, values),) = axis.items()
    both = [
        outcome(ingredients, scenario(**{name: x}), n_segments=n_segments, method=method, x=x)
        for x in values
    ]
    bias, cov = zip(*both, strict=True)
    return Series(label, method, "bias", bias), Series(label, method, "c.o.v.", cov)


def fig4(ingredients: Ingredients) -> Study:
    """Three-channel bias against SNR and misalignment, in two dimensions of motion and in one."""
    panels = []
    for title, ratio in (("(a) $S_y = 1.5\\,S_x$", 1.5), ("(b) $S_y = 0$", 0.0)):
        series = [
            _series(
                ingredients,
                partial(paper_scenarios.fig4, theta=theta, ratio=ratio),
                snr=SNRS,
                n_segments=SEGMENTS_3H,
                method=THREE_CHANNEL,
                label=f"θ = {theta:g}°",
            )[0]
            for theta in (0.0, 5.0, 10.0)
        ]
        panels.append(Panel(title, SNR_LABEL, BIAS_LABEL, tuple(series), log="x"))
    return Study("fig4", "Three-channel method: bias by misalignment", tuple(panels))


def _bias_and_cov(
    name: str,
    title: str,
    lines: Mapping[str, Callable[..., Scenario]],
    ingredients: Ingredients,
    *,
    method: str,
    n_segments: int,
    x_label: str,
    log: Literal["", "x"] = "",
    **axis: tuple[float, ...],
) -> Study:
    """Bias and c.o.v. along an axis, a line for each scenario."""
    both = [
        _series(ingredients, scenario, n_segments=n_segments, method=method, label=label, **axis)
        for label, scenario in lines.items()
    ]
    biases, covs = zip(*both, strict=True)
    panels = (
        Panel("(a) bias", x_label, BIAS_LABEL, biases, log=log),
        Panel("(b) c.o.v.", x_label, COV_LABEL, covs, log="xy" if log else "y"),
    )
    return Study(name, title, panels)


def _by_angle(
    scenario: Callable[..., Scenario], *thetas: float
) -> dict[str, Callable[..., Scenario]]:
    return {f"θ = {theta:g}°": partial(scenario, theta=theta) for theta in thetas}


def fig5(ingredients: Ingredients) -> Study:
    """One other sensor aligned: no bias, but a c.o.v. that grows with SNR and angle."""
    return _bias_and_cov(
        "fig5",
        "Three-channel method: sensor k turned alone",
        _by_angle(paper_scenarios.fig5, 0.0, 10.0, 30.0, 60.0),
        ingredients,
        method=THREE_CHANNEL,
        n_segments=SEGMENTS_3H,
        x_label=SNR_LABEL,
        log="x",
        snr=SNRS,
    )


def fig9(ingredients: Ingredients) -> Study:
    """Three-channel and three-sensor bias against SNR and misalignment."""
    panels = []
    for letter, theta in zip("abc", (0.0, 5.0, 10.0), strict=True):
        series = [
            _series(
                ingredients,
                partial(paper_scenarios.fig9, theta=theta),
                snr=SNRS,
                n_segments=SEGMENTS_3H,
                method=method,
                label=method,
            )[0]
            for method in (THREE_CHANNEL, THREE_SENSOR)
        ]
        panels.append(
            Panel(f"({letter}) θ = {theta:g}°", SNR_LABEL, BIAS_LABEL, tuple(series), log="x")
        )
    return Study("fig9", "Three-channel against three-sensor method", tuple(panels))


_BY_CHANNEL_ANGLE = partial(
    _bias_and_cov,
    method=THREE_SENSOR,
    n_segments=SEGMENTS_10H,
    x_label=ALPHA_LABEL,
    alpha=ALPHAS,
)


def fig12(ingredients: Ingredients) -> Study:
    """Three-sensor bias and c.o.v. against the channel angle, by SNR."""
    lines = {
        f"SNR = {snr:g}": partial(paper_scenarios.fig12, snr=snr) for snr in (10.0, 100.0, 1000.0)
    }
    title = "Three-sensor method: channel angle, θ = 5°"
    return _BY_CHANNEL_ANGLE("fig12", title, lines, ingredients)


def fig13(ingredients: Ingredients) -> Study:
    """Three-sensor bias and c.o.v. against the channel angle, by misalignment."""
    lines = _by_angle(paper_scenarios.fig13, 5.0, 20.0, 45.0, 60.0)
    title = "Three-sensor method: channel angle, SNR 100"
    return _BY_CHANNEL_ANGLE("fig13", title, lines, ingredients)


NUMERICAL: Mapping[str, Callable[[Ingredients], Study]] = {
    "fig4": fig4,
    "fig5": fig5,
    "fig9": fig9,
    "fig12": fig12,
    "fig13": fig13,
}
