"""Noise against frequency, with limits and noise models: in a report, or in a file of its own."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from functools import partial
from itertools import cycle, groupby
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.units import levels_db
from daq.results.decision.limits import concerns, mask_psd
from daq.whole_file import write_whole
from estimator.errors import InsufficientDataError
from estimator.levels.bands import log_edges
from estimator.self_noise.result import Flag, SelfNoise
from tui.page import drawing
from tui.page.blocks import Plot
from tui.page.drawing import WIDTH, look, stack, stack_height
from tui.page.ticks import even_ticks, set_log_ticks
from tui.wording.formatting import power_of_ten

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daq.bench.masks.mask import Mask
    from daq.estimation.snapshot import Snapshot
    from daq.results.band_summary import BandMeans
    from daq.results.result import Result
    from estimator.types import FloatArray
    from tui.page.axes import Axes


POINTS = 240
"""Most points of a curve: more than print resolves. Each is a mean over its share of the axis."""
NOISE_HEIGHT = 1.45
LONGEST_TITLE = 28
"""Letters of a name above a panel."""
KEY_COLUMN = 1.2
"""Width of an entry of the key, in inches."""
MODEL_RANGE_DB = 60.0
"""By how many dB a noise model may widen the vertical scale."""


@dataclass(frozen=True, slots=True)
class _Curves:
    """One channel on a logarithmic axis: PSD in unit²/Hz over edges of points in Hz.

    `noise` is that of the first method, `others` have the means of the others by name; `limits`
    and `models` have points and PSD of each mask, the latter by name.
    """

    edges: FloatArray
    frequency: FloatArray
    data: FloatArray
    noise: BandMeans | None
    others: Mapping[str, FloatArray]
    limits: tuple[tuple[FloatArray, FloatArray], ...]
    models: Mapping[str, tuple[FloatArray, FloatArray]]
    quantisation: FloatArray


@dataclass(frozen=True, slots=True)
class _NoisePanel:
    """Draws one channel."""

    curve: _Curves
    name: str
    noise_label: str
    scale: tuple[float, float]
    band: tuple[float, float] | None
    unit: str
    with_amplitude: bool

    def __call__(self, axes: Axes) -> None:
        curve, scale = self.curve, self.scale
        frequency = curve.frequency
        axes.set(title=self.name, ylim=scale, ylabel=f"dB re 1 ({self.unit})²/Hz")
        logarithmic(axes, (float(curve.edges[0]), float(curve.edges[-1])))
        line = partial(axes.plot, lw=0.8)
        line(frequency, levels_db(curve.data), color=drawing.DATA, label="recorded")
        floor = 10 ** (scale[0] / 10)
        if curve.noise is not None:
            self._draw_noise(axes, curve.noise, floor)
        styles = zip(drawing.LINES[1:], drawing.DASHES, strict=False)
        for (label, psd), (colour, dashes) in zip(curve.others.items(), styles, strict=False):
            line(frequency, levels_db(psd), color=colour, dashes=dashes, label=_shown(label))
        if (curve.quantisation > floor).any():
            level, colour = levels_db(curve.quantisation), drawing.QUANTISATION
            line(frequency, level, color=colour, dashes=(1, 1.5), label="quantisation")
        for at, mask in curve.limits:
            limit = levels_db(mask)
            line(at, limit, color=drawing.LIMIT, lw=1.0, dashes=(5, 2), label="limit")
        models = zip(curve.models.items(), cycle(drawing.MODEL_DASHES), strict=False)
        for (label, (at, psd)), dashes in models:
            level, name = levels_db(psd), _shown(label)
            line(at, level, color=drawing.MODEL, lw=0.7, dashes=dashes, label=name)
        for edge in self.band or ():
            axes.axvline(edge, color=drawing.INK, lw=0.5, dashes=(1, 2))
        if curve.noise is not None:
            _nothing(axes, curve.edges, curve.noise)
        levels = even_ticks(*scale, 6)
        axes.yaxis.set_ticks(levels, [f"{each:.0f}".replace("-", "−") for each in levels])
        if self.with_amplitude:
            _amplitude_scale(axes, scale, self.unit)

    def _draw_noise(self, axes: Axes, noise: BandMeans, floor: float) -> None:
        frequency = self.curve.frequency
        is_bound = noise.is_bound
        high = levels_db(np.where((noise.high > 0) & ~is_bound, noise.high, np.nan))
        low = levels_db(np.where(noise.low > floor, noise.low, floor))
        draw = partial(axes.plot, frequency, color=drawing.NOISE)
        axes.fill_between(
            frequency, low, high, color=drawing.NOISE, alpha=0.25, lw=0, label="95 % interval"
        )
        draw(levels_db(np.where(is_bound, np.nan, noise.mean)), lw=0.9, label=self.noise_label)
        if is_bound.any():
            bound, label = np.where(is_bound, noise.high, np.nan), f"{self.noise_label} is below"
            draw(levels_db(bound), lw=0.8, dashes=(3, 2), label=label)


def noise_plots(
    result: Result,
    models: Sequence[Mask] = (),
    *,
    width: float = WIDTH,
) -> tuple[Plot, ...]:
    """Return a plot for each sensor, or for three channels where a sensor has but one.

    Parameters
    ----------
    snapshot : Snapshot
        With the results of one method or more; the interval shown is that of the first.
    settings : Settings
    bench : Bench or None
        Its limits are shown.
    models : sequence of Mask
        Noise models to show.
    width : float
        Of each plot, in inches.

    Raises
    ------
    WrongSettingError
        If a model cannot be turned into the unit of the snapshot.
    """
    snapshot = result.snapshot
    if not snapshot.results and len(snapshot.dims) >= _LEAST_SENSORS:
        return ()
    curves = _curves(result, models)
    scale = _scale(curves)
    first = next(iter(snapshot.results), "")
    noise_label = "self-noise" if len(snapshot.results) == 1 else f"self-noise, {first}"
    band = result.settings.band
    groups = list(_groups(snapshot))
    widest = max(map(len, groups))
    plots = []
    for number, columns in enumerate(groups):
        names = [_title(snapshot.channels[column].name) for column in columns]
        panels = [
            _NoisePanel(
                curves[column], name, noise_label, scale, band, snapshot.unit, column == columns[-1]
            )
            for column, name in zip(columns, names, strict=True)
        ]
        plots.append(
            Plot(
                "" if number else snapshot.caveats.nouns().capitalize(),
                tuple(panels),
                n_columns=max(widest, 2),
                height=NOISE_HEIGHT,
                right=0.55,
                titled=True,
                key_rows=_key_rows(curves, width) if number == 0 else 0,
                is_continued=len(columns)
                <= max(map(len, groups[number + 1 : number + 2]), default=0),
                alt=f"PSD of data and noise against frequency: {', '.join(names)}",
            )
        )
    return tuple(plots)


def _groups(snapshot: Snapshot) -> Iterator[list[int]]:
    """Yield columns that go side by side: of one sensor, or of sensors with a channel each."""
    by_sensor = max(snapshot.dims) > 1
    labelled = enumerate(snapshot.channels)
    for _, columns in groupby(labelled, key=lambda entry: by_sensor and entry[1].sensor):
        numbers = [number for number, _ in columns]
        for first in range(0, len(numbers), 3):
            yield numbers[first : first + 3]


def _title(name: str) -> str:
    """Return a name of a channel that is no wider than its panel."""
    return name if len(name) <= LONGEST_TITLE else f"…{name[-LONGEST_TITLE:]}"


def _shown(label: str) -> str:
    """Return a label that the key shows: matplotlib hides those that begin with an underscore."""
    return f" {label}" if label.startswith("_") else label


def _key_rows(curves: list[_Curves], width: float) -> int:
    """Return the rows of a key of all that may be in a plot."""
    curve = curves[0]
    n_labels = 4 + len(curve.others) + len(curve.models)
    n_labels += bool(curve.limits) + any(
        each.noise is not None and each.noise.is_bound.any() for each in curves
    )
    n_labels += bool(np.isfinite(curve.quantisation).any())
    return math.ceil(n_labels / max(1, int(width / KEY_COLUMN)))


def _curves(result: Result, models: Sequence[Mask]) -> list[_Curves]:
    snapshot, bench = result.snapshot, result.bench
    method, *others = snapshot.results or [None]
    frequency, data = snapshot.frequency, snapshot.data_psd
    edges = log_edges(frequency, POINTS)
    centre = centres(frequency, edges)
    width = np.gradient(frequency)
    found = None if method is None else result.spectrum(method).levels(edges)
    curves = []
    for column, label in enumerate(snapshot.channels):
        means = None if found is None else found.of_channel(column)
        limits = [] if bench is None else [lim for lim in bench.limits if concerns(lim, label)]
        masks = []
        for limit in limits:
            at = _inside(limit.mask.points(centre), frequency)
            masks.append((at, mask_psd(bench, limit, label, at) if bench else at))
        curves.append(
            _Curves(
                np.append(frequency[edges[:-1]], frequency[edges[-1] - 1]),
                centre,
                _mean(data[:, column], edges, width),
                means,
                {
                    name: _mean(_estimates(snapshot.results[name])[:, column], edges, width)
                    for name in others
                    if name is not None
                },
                tuple(masks),
                {
                    each.name: (points, each.at(points, label.unit))
                    for each in models
                    for points in [_inside(each.points(centre), frequency)]
                },
                _quantisation(snapshot, column, centre),
            )
        )
    return curves


def _estimates(noise: SelfNoise) -> FloatArray:
    """Return the noise of a method without bounds, shape (n_freqs, n_channels)."""
    return np.where((noise.flags & Flag.UNIDENTIFIED) != 0, np.nan, noise.noise_psd)


def _mean(psd: FloatArray, edges: NDArray[np.int64], width: FloatArray) -> FloatArray:
    """Return the mean of each point of a curve; NaN where a frequency of it is not known."""
    inside, starts = slice(int(edges[0]), int(edges[-1])), edges[:-1] - edges[0]
    power = np.add.reduceat((psd * width)[inside], starts)
    return np.asarray(power / np.add.reduceat(width[inside], starts))


def _inside(at: FloatArray, frequency: FloatArray) -> FloatArray:
    """Return the points that an axis shows, and one to either side of it."""
    first, last = np.searchsorted(at, (frequency[1], frequency[-1]))
    return at[max(0, first - 1) : last + 1]


def _quantisation(snapshot: Snapshot, column: int, frequency: FloatArray) -> FloatArray:
    """Return the noise of counting in whole numbers; NaN where samples are not whole."""
    if snapshot.quantisation_psd is None:
        return np.full(frequency.shape, np.nan)
    return np.asarray(
        np.interp(frequency, snapshot.frequency, snapshot.quantisation_psd[:, column])
    )


def centres(frequency: FloatArray, edges: NDArray[np.int64]) -> FloatArray:
    """Return the middle of each point on a logarithmic axis."""
    return np.asarray(np.sqrt(frequency[edges[:-1]] * frequency[edges[1:] - 1]))


def _scale(curves: list[_Curves]) -> tuple[float, float]:
    """Return the range in dB that holds all curves, in steps of ten."""
    values = []
    for curve in curves:
        values += [curve.data, *curve.others.values()]
        values += [] if curve.noise is None else [curve.noise.mean]
        values += [mask for _, mask in curve.limits]
    level = levels_db(np.concatenate(values))
    level = level[np.isfinite(level)]
    if not level.size:
        return -10.0, 10.0
    low, high = np.percentile(level, (0.5, 100))
    if curves[0].models:
        span = curves[0].frequency[[0, -1]]
        psd = [psd[(at >= span[0]) & (at <= span[1])] for at, psd in curves[0].models.values()]
        shown = levels_db(np.concatenate(psd))
        low = min(low, max(shown.min(initial=math.inf), low - MODEL_RANGE_DB))
        high = max(high, min(shown.max(initial=-math.inf), high + MODEL_RANGE_DB))
    return 10 * math.floor(low / 10 - 0.3), 10 * math.ceil(high / 10 + 0.1)


def _amplitude_scale(axes: Axes, scale: tuple[float, float], unit: str) -> None:
    """Show the root of the PSD at the right."""
    other = axes.twinx()
    other.grid(visible=False)
    other.set(frame_on=False, ylim=scale, ylabel=f"({unit})/√Hz")
    step = 20 * max(1, math.ceil((scale[1] - scale[0]) / 120))
    levels = np.arange(math.ceil(scale[0] / step) * step, scale[1] + 1, step)
    other.yaxis.set_ticks(levels.tolist(), [power_of_ten(level / 20) for level in levels])


def _nothing(axes: Axes, edges: FloatArray, noise: BandMeans) -> None:
    """Shade where nothing can be said: no number, or all of its interval below zero."""
    unknown = ~(np.isfinite(noise.mean) & (noise.high > 0))
    ends = edges[np.flatnonzero(np.diff(unknown, prepend=False, append=False))]
    shade = partial(axes.axvspan, color=drawing.NOTHING, alpha=0.4, lw=0, zorder=0.5)
    for start, stop in ends.reshape(-1, 2).tolist():
        shade(start, stop, label="nothing can be said")


def logarithmic(axes: Axes, span: tuple[float, float]) -> None:
    """Make the horizontal axis one of frequency."""
    axes.set(xscale="log", xlim=span, xlabel="frequency (Hz)")
    set_log_ticks(axes.xaxis, *span, "{:g}".format)


_LEAST_SENSORS = 2
"""Sensors of which there may be noise: of one alone, the PSD is drawn."""
RESOLUTION = 300
"""Dots per inch of a PNG, as journals ask for."""


def write_figure(
    result: Result,
    path: Path,
    *,
    models: Sequence[Mask] = (),
    width: float,
) -> None:
    """Write the curves of the report as SVG, PNG or PDF, as the suffix says.

    Letters of an SVG are shapes, so that it looks alike wherever it is opened; those of a PDF are
    text. The same estimate gives the same file.

    Parameters
    ----------
    snapshot : Snapshot
    settings : Settings
    bench : Bench or None
        Its limits are shown.
    path : Path
    models : sequence of Mask
        Noise models to show.
    width : float
        Of the figure in inches.

    Raises
    ------
    InsufficientDataError
        If there is no estimate of two sensors or more by any method.
    WrongSettingError
        If a noise model cannot be turned into the unit of the estimate.
    OSError
        If the file cannot be written; an earlier one stays.
    """
    plots = noise_plots(result, models, width=width)
    if not plots:
        raise InsufficientDataError(
            "no noise estimate by any method: nothing can be drawn; the PSD is written by"
            " huddle estimate FILE --csv psd.csv"
        )
    write_plots(plots, path, width=width, title=_TITLE)


def write_plots(plots: Sequence[Plot], path: Path, *, width: float, title: str) -> None:
    """Write plots below each other as a figure with a title; as `write_figure`.

    Raises
    ------
    OSError
        If the file cannot be written; an earlier one stays.
    """
    import matplotlib as mpl  # noqa: PLC0415 - takes a third of a second
    from matplotlib.figure import Figure  # noqa: PLC0415

    kind = path.suffix.lower().removeprefix(".")
    about: dict[str, str | None] = {"Title": title, **_ABOUT[kind]}
    content = io.BytesIO()
    with look(), mpl.rc_context({"svg.fonttype": "path"}):
        figure = Figure(figsize=(width, stack_height(plots)), facecolor="white")
        stack(plots, figure)
        figure.savefig(content, format=kind, dpi=RESOLUTION, metadata=about)
    write_whole(path, content.getvalue())


_TITLE = "Self-noise of every channel, one-sided power spectral density"
_ABOUT: dict[str, dict[str, str | None]] = {
    "svg": {"Creator": "huddle", "Date": None},
    "png": {"Software": "huddle"},
    "pdf": {"Creator": "huddle", "Producer": None, "CreationDate": None},
}
"""What a file says of itself; no date, so that the same estimate gives the same file."""
