"""Noise against frequency, and where the model test fails."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import groupby, pairwise
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from scipy import special

from daq.results.band_summary import correlation_of
from daq.results.limits import concerns, mask_psd
from estimator.likelihood.goodness_of_fit import REJECT, neighbour_correlation
from estimator.self_noise.band_means import band_means, log_edges
from estimator.spectra.windows import get_window
from tui.report.figures import drawing
from tui.report.parts import Plot
from tui.report.wording import power_of_ten

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from estimator.self_noise.band_means import BandMeans, FloatArray

    BoolArray = NDArray[np.bool_]

POINTS = 240
"""Most points of a curve: more than print resolves. Each is a mean over its share of the axis."""
TEST_POINTS = 90
NOISE_HEIGHT, TEST_HEIGHT = 1.45, 1.25
_SHAPE_LENGTH = 512  # only the window's shape and overlap matter to the correlation of bins


@dataclass(frozen=True, slots=True)
class _Curves:
    """One channel on a logarithmic axis: PSD in unit²/Hz over edges of points in Hz."""

    edges: FloatArray
    frequency: FloatArray
    data: FloatArray
    noise: BandMeans
    limits: tuple[tuple[FloatArray, FloatArray], ...]
    quantisation: FloatArray


@dataclass(frozen=True, slots=True)
class _NoisePanel:
    """Draws one channel."""

    curve: _Curves
    name: str
    scale: tuple[float, float]
    band: tuple[float, float] | None
    unit: str
    with_amplitude: bool

    def __call__(self, axes: Axes) -> None:
        curve, scale = self.curve, self.scale
        frequency = curve.frequency
        axes.set_title(self.name)
        _logarithmic(axes, (float(curve.edges[0]), float(curve.edges[-1])))
        _nothing(axes, curve)
        axes.plot(frequency, _decibels(curve.data), color=drawing.DATA, lw=0.8, label="recorded")
        floor = 10 ** (scale[0] / 10)
        high = np.where(curve.noise.high > 0, curve.noise.high, np.nan)
        axes.fill_between(
            frequency,
            _decibels(np.where(curve.noise.low > floor, curve.noise.low, floor)),
            _decibels(high),
            color=drawing.NOISE,
            alpha=0.25,
            lw=0,
            label="95 % interval",
        )
        axes.plot(
            frequency, _decibels(curve.noise.mean), color=drawing.NOISE, lw=0.9, label="self-noise"
        )
        if (curve.quantisation > floor).any():
            axes.plot(
                frequency,
                _decibels(curve.quantisation),
                color=drawing.QUANTISATION,
                lw=0.8,
                dashes=(1, 1.5),
                label="quantisation",
            )
        for at, mask in curve.limits:
            axes.plot(
                at, _decibels(mask), color=drawing.LIMIT, lw=1.0, dashes=(5, 2), label="limit"
            )
        for edge in self.band or ():
            axes.axvline(edge, color=drawing.INK, lw=0.5, dashes=(1, 2))
        axes.set_ylim(scale)
        axes.yaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 2, 5, 10], integer=True))
        axes.yaxis.set_major_formatter(
            FuncFormatter(lambda value, _: f"{value:.0f}".replace("-", "−"))
        )
        axes.set_ylabel(f"dB re 1 ({self.unit})²/Hz")
        if self.with_amplitude:
            _amplitude_scale(axes, scale, self.unit)


def noise_plots(snapshot: Snapshot, settings: Settings, bench: Bench | None) -> tuple[Plot, ...]:
    """Return a plot for each sensor, or for three channels where a sensor has but one."""
    if not snapshot.results:
        return ()
    curves = _curves(snapshot, settings, bench)
    scale = _scale(curves)
    band = settings.band
    groups = list(_groups(snapshot))
    widest = max(len(columns) for _, columns in groups)
    plots = []
    for number, (title, columns) in enumerate(groups):
        panels = []
        for place, column in enumerate(columns):
            label = snapshot.channels[column]
            name = label.channel if title else f"{label.sensor}.{label.channel}"
            last = place == len(columns) - 1
            panels.append(_NoisePanel(curves[column], name, scale, band, snapshot.unit, last))
        plots.append(
            Plot(
                title,
                tuple(panels),
                n_columns=max(widest, 2),
                height=NOISE_HEIGHT,
                right=0.55,
                titled=True,
                key_rows=1 if number == 0 else 0,
                alt=f"Power spectral density of data and noise against frequency: {title}",
            )
        )
    return tuple(plots)


def model_test_plot(snapshot: Snapshot, settings: Settings) -> Plot | None:
    """Return the statistic of the model test over its expectation; None where there is none."""
    found = snapshot.diagnostics.diagnosis
    if found is None or not np.isfinite(found.per_frequency.statistic[1:-1]).any():
        return None
    statistic, degrees = found.per_frequency.statistic, found.per_frequency.degrees
    window = get_window(settings.window, _SHAPE_LENGTH)
    hop = max(1, round(_SHAPE_LENGTH * (1 - settings.overlap)))
    r = neighbour_correlation(window, hop, max(1, snapshot.n_segments))
    edges = log_edges(snapshot.frequency, TEST_POINTS)
    known = np.isfinite(statistic)
    count = np.add.reduceat(known.astype(float), edges[:-1])[: edges.size - 1]
    ratio, limit = np.full((2, edges.size - 1), np.nan)
    for number, (first, stop) in enumerate(pairwise(edges)):
        inside = slice(int(first), int(stop))
        n = int(known[inside].sum())
        if n == 0:
            continue
        total = float(degrees[inside][known[inside]].sum())
        pairs = np.maximum(n - np.arange(1, len(r) + 1), 0)
        spread = 1 + 2 * float(pairs @ r**2) / n  # as estimator.likelihood.goodness_of_fit.pool
        ratio[number] = float(statistic[inside][known[inside]].sum()) / total
        limit[number] = special.chdtri(total / spread, REJECT) * spread / total
    if not count.any():
        return None
    centre = _centres(snapshot.frequency, edges)
    return Plot(
        "",
        (partial(_draw_test, centre, ratio, limit, _span(snapshot.frequency)),),
        n_columns=1,
        height=TEST_HEIGHT,
        key_rows=1,
        alt="Statistic of the model test over its expectation against frequency",
    )


def _groups(snapshot: Snapshot) -> Iterator[tuple[str, list[int]]]:
    """Yield columns that go side by side, under the name of their sensor if they share one."""
    if max(snapshot.dims) == 1:
        for first in range(0, len(snapshot.channels), 3):
            yield "", list(range(first, min(first + 3, len(snapshot.channels))))
        return
    labelled = enumerate(snapshot.channels)
    for sensor, columns in groupby(labelled, key=lambda entry: entry[1].sensor):
        numbers = [number for number, _ in columns]
        for first in range(0, len(numbers), 3):
            yield f"Sensor {sensor}", numbers[first : first + 3]


def _curves(snapshot: Snapshot, settings: Settings, bench: Bench | None) -> list[_Curves]:
    noise = next(iter(snapshot.results.values()))
    frequency, data = snapshot.frequency, snapshot.data_psd
    edges = log_edges(frequency, POINTS)
    centre = _centres(frequency, edges)
    width = np.gradient(frequency)
    correlation = correlation_of(settings)
    share = np.add.reduceat(width[edges[0] : edges[-1]], edges[:-1] - edges[0])
    added = snapshot.added_by_clocks
    curves = []
    for column, label in enumerate(snapshot.channels):
        means = band_means(
            noise.noise_psd[:, column],
            noise.cov[:, column],
            edges,
            correlation,
            weights=width,
            added=None if added is None else added[:, column],
        )
        single = np.diff(edges) == 1  # has an interval of its own, better at few averages
        means.low[single] = noise.low[edges[:-1][single], column]
        means.high[single] = noise.high[edges[:-1][single], column]
        power = (data[:, column] * width)[edges[0] : edges[-1]]
        limits = [] if bench is None else [lim for lim in bench.limits if concerns(lim, label)]
        masks = []
        for limit in limits:
            at = np.unique(np.concatenate([limit.frequency, centre]))
            at = at[(at >= limit.frequency[0]) & (at <= limit.frequency[-1])]
            masks.append((at, mask_psd(bench, limit, label, at) if bench else at))
        curves.append(
            _Curves(
                np.append(frequency[edges[:-1]], frequency[edges[-1] - 1]),
                centre,
                np.add.reduceat(power, edges[:-1] - edges[0]) / share,
                means,
                tuple(masks),
                _quantisation(snapshot, column, centre),
            )
        )
    return curves


def _quantisation(snapshot: Snapshot, column: int, frequency: FloatArray) -> FloatArray:
    """Return the noise of counting in whole numbers; NaN where samples are not whole."""
    if snapshot.quantisation_psd is None:
        return np.full(frequency.shape, np.nan)
    return np.asarray(
        np.interp(frequency, snapshot.frequency, snapshot.quantisation_psd[:, column])
    )


def _centres(frequency: FloatArray, edges: NDArray[np.int64]) -> FloatArray:
    return np.asarray(np.sqrt(frequency[edges[:-1]] * frequency[edges[1:] - 1]))


def _span(frequency: FloatArray) -> tuple[float, float]:
    return float(frequency[1]), float(frequency[-1])


def _scale(curves: list[_Curves]) -> tuple[float, float]:
    """Return the range in dB that holds all curves, in steps of ten."""
    values = []
    for curve in curves:
        values += [curve.data, curve.noise.mean, *(mask for _, mask in curve.limits)]
    level = _decibels(np.concatenate(values))
    level = level[np.isfinite(level)]
    if not level.size:
        return -10.0, 10.0
    low, high = np.percentile(level, (0.5, 100))
    return 10 * math.floor(low / 10 - 0.3), 10 * math.ceil(high / 10 + 0.1)


def _decibels(psd: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(psd > 0, 10 * np.log10(np.where(psd > 0, psd, 1)), np.nan))


def _amplitude_scale(axes: Axes, scale: tuple[float, float], unit: str) -> None:
    """Show the root of the PSD at the right."""
    other = axes.twinx()
    other.grid(visible=False)
    other.spines[:].set_visible(False)
    other.set_ylim(scale)
    step = 20 * max(1, math.ceil((scale[1] - scale[0]) / 120))
    first = math.ceil(scale[0] / step) * step
    other.set_yticks(np.arange(first, scale[1] + 1, step))
    other.yaxis.set_major_formatter(FuncFormatter(lambda value, _: power_of_ten(value / 20)))
    other.set_ylabel(f"({unit})/√Hz")


def _nothing(axes: Axes, curve: _Curves) -> None:
    """Hatch where nothing can be said: no number, or all of its interval below zero."""
    unknown = ~(np.isfinite(curve.noise.mean) & (curve.noise.high > 0))
    for start, stop in _runs(unknown):
        axes.axvspan(
            float(curve.edges[start]),
            float(curve.edges[stop]),
            facecolor="none",
            edgecolor=drawing.NOTHING,
            hatch="////",
            lw=0,
            label="nothing can be said",
        )


def _runs(true: BoolArray) -> Iterator[tuple[int, int]]:
    """Yield first and last + 1 of each run."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], true, [False])).astype(np.int8)))
    for first, stop in edges.reshape(-1, 2):
        yield int(first), int(stop)


def _draw_test(
    centre: FloatArray, ratio: FloatArray, limit: FloatArray, span: tuple[float, float], axes: Axes
) -> None:
    _logarithmic(axes, span)
    axes.set_yscale("log")
    failing = ratio > limit
    axes.plot(centre, limit, color=drawing.LIMIT, lw=0.9, dashes=(5, 2), label="1 % limit")
    axes.plot(
        centre[~failing],
        ratio[~failing],
        "o",
        ms=2.4,
        color=drawing.NOISE,
        label="explained",
        clip_on=False,
    )
    if failing.any():
        axes.plot(
            centre[failing],
            ratio[failing],
            "D",
            ms=2.6,
            color=drawing.LIMIT,
            label="not explained",
            clip_on=False,
        )
    finite = np.concatenate([ratio[ratio > 0], limit[np.isfinite(limit)], [1.0]])
    finite = finite[np.isfinite(finite)]
    axes.set_ylim(min(0.7, 0.9 * finite.min()), max(1.6, 1.25 * finite.max()))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_ylabel("statistic / expected")


def _logarithmic(axes: Axes, span: tuple[float, float]) -> None:
    axes.set_xscale("log")
    axes.set_xlim(span)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("frequency (Hz)")
