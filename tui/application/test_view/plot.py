"""The plots: power spectral densities over frequency, and the drift of clocks over time."""

from __future__ import annotations

import math
from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np
from textual.geometry import Offset
from textual_hires_canvas import Canvas
from textual_plot import HiResMode, LegendLocation, PlotWidget
from textual_plot.axis_formatter import AxisFormatter, NumericAxisFormatter

from tui.application.test_view.braille import cells, joined
from tui.application.test_view.curves import Curve, DrawnLine, level_limits
from tui.application.test_view.units import MOST_TICKS, SpectrumUnit, log_ticks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from textual.app import RenderResult
    from textual_plot.plot_widget import LinePlot, ScatterPlot

    from estimator.types import FloatArray

DOTS_PER_ROW = 4  # of a Braille character
ROUNDING = 1e-6  # of a dot
MARKED, STEPS_MARKED = 12, 5  # points from one mark of a curve to the next; and steps
LEAST_LAG = 1.0  # µs: what is less is not worth a picture that fills the screen
SHORT, LONG, DAYS = 2.0, 300.0, 7200.0  # minutes: below seconds, from there on hours, days
TIME_STEPS = (1 / 60, 1 / 30, 1 / 12, 1 / 6, 0.25, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 180, 360, 720)
LARGE = 2000.0  # µs: above milliseconds


class FrequencyAxis(AxisFormatter):
    """Ticks on an axis of log10 of frequency: decades, and with room 2 and 5."""

    def get_ticks(self, min_: float, max_: float, max_ticks: int = 8) -> list[float]:
        """Return tick positions in log10 of Hz."""
        return log_ticks(min_, max_, max_ticks)

    def get_labels_for_ticks(self, ticks: Sequence[float]) -> list[str]:
        """Return frequencies in Hz."""
        return [f"{10**tick:.3g} Hz" for tick in ticks]


class LevelAxis(AxisFormatter):
    """Ticks at round values of a unit, on an axis in dB."""

    unit = SpectrumUnit("dB", is_db=True)
    rows = 2 * MOST_TICKS

    def get_ticks(self, min_: float, max_: float, max_ticks: int = MOST_TICKS) -> list[float]:
        """Return tick positions in dB, no more than every other row has room for."""
        return self.unit.ticks(min_, max_, min(max_ticks, (self.rows + 3) // 2))

    def get_labels_for_ticks(self, ticks: Sequence[float]) -> list[str]:
        """Return values in the unit."""
        return self.unit.labels(ticks)


class TimeAxis(AxisFormatter):
    """Ticks on an axis of minutes: few enough for their labels in sixty columns."""

    def get_ticks(self, min_: float, max_: float, max_ticks: int = 6) -> list[float]:
        """Return tick positions at round steps of seconds, minutes, hours or days."""
        least = (max_ - min_) / max(min(max_ticks, 6) - 1, 1)
        step = next((s for s in TIME_STEPS if s >= least), 1440 * math.ceil(least / 1440))
        return [float(t) for t in np.arange(math.ceil(min_ / step) * step, max_ + 1e-9, step)]

    def get_labels_for_ticks(self, ticks: Sequence[float]) -> list[str]:
        """Return minutes, or hours or days where these are many, or seconds where they are few."""
        if ticks and max(ticks) < SHORT:
            return [f"{60 * tick:.3g} s" for tick in ticks]
        if ticks and max(ticks) >= DAYS:
            return [f"{tick / 1440:.3g} d" for tick in ticks]
        if ticks and max(ticks) >= LONG:
            return [f"{tick / 60:.3g} h" for tick in ticks]
        return [f"{tick:.3g} min" for tick in ticks]


class LagAxis(NumericAxisFormatter):
    """Ticks on an axis of microseconds."""

    def get_labels_for_ticks(self, ticks: Sequence[float]) -> list[str]:
        """Return microseconds, or milliseconds where these are many."""
        if ticks and max(abs(tick) for tick in ticks) >= LARGE:
            return [f"{tick / 1e3:.3g} ms".replace("-", "−") for tick in ticks]
        return [f"{tick:.3g} µs".replace("-", "−") for tick in ticks]


class FullPlot(PlotWidget, can_focus=False):
    """A plot that leaves room for tick labels only: they carry the units."""

    def __init__(
        self,
        x: AxisFormatter,
        y: AxisFormatter,
        *,
        id: str | None = None,  # noqa: A002 - Textual's name
    ) -> None:
        super().__init__(id=id, allow_pan_and_zoom=False)
        self.set_x_formatter(x)
        self.set_y_formatter(y)
        self._legend: object = None

    def render(self) -> RenderResult:
        """Render the plot; each canvas is refreshed once, not for each of its cells."""
        with ExitStack() as batches:
            for canvas in self.query(Canvas):
                batches.enter_context(canvas.batch_refresh())
            rendered = super().render()
        self._position_legend()
        return rendered

    def _render_scatter_plot(self, dataset: ScatterPlot) -> None:
        """Draw dots as arrays: one by one, those of a band take tens of milliseconds.

        A marker of several characters is a name, which begins at its point.
        """
        if len(dataset.marker) > 1:
            canvas = self.query_one("#plot", Canvas)
            column, row = self.get_pixel_from_coordinate(dataset.x[0], dataset.y[0])
            for n, character in enumerate(dataset.marker[: max(0, canvas.size.width - column)]):
                canvas.set_pixel(column + n, row, character, dataset.marker_style)
        elif dataset.hires_mode is None:
            super()._render_scatter_plot(dataset)
        else:
            self._set_dots(*self._dots(dataset), dataset.marker_style)

    def _render_line_plot(self, dataset: LinePlot) -> None:
        """Draw a line as an array of dots."""
        self._set_dots(*joined(*self._dots(dataset)), dataset.line_style)

    def _dots(self, dataset: LinePlot | ScatterPlot) -> tuple[FloatArray, FloatArray]:
        """Return columns and rows of dots."""
        box = self._scale_rectangle
        x = box.x + (dataset.x - self._x_min) * box.width / (self._x_max - self._x_min)
        y = box.bottom - (dataset.y - self._y_min) * box.height / (self._y_max - self._y_min)
        # what is on the border of two dots, to rounding, is in one whatever its last bit
        return np.floor(2 * x + ROUNDING), np.floor(4 * y + ROUNDING)

    def _set_dots(self, x: FloatArray, y: FloatArray, style: str) -> None:
        canvas = self.query_one("#plot", Canvas)
        for column, row, character in cells(x, y, canvas.size.width, canvas.size.height):
            canvas.set_pixel(column, row, character, style)

    def _update_legend(self) -> None:
        """Leave the legend as it is: `write_legend` is called once all curves are there."""

    def write_legend(self, curves: object) -> None:
        """Write the legend, unless it is of the same curves: a change lays out the screen again."""
        if curves != self._legend:
            self._legend = curves
            super()._update_legend()

    def _position_legend(self) -> None:
        """Put the legend into its corner, wherever it came to be before the plot had its size."""
        self._legend_location = LegendLocation.TOPRIGHT
        self._legend_relative_offset = Offset()
        super()._position_legend()

    @property
    def n_points(self) -> int:
        """How many points across it can show."""
        return max(8, self.size.width - self.margin_left - 2)

    def on_mount(self) -> None:
        """Leave room for tick labels."""
        super().on_mount()
        self.margin_left = 9
        self.margin_top = 0
        self.margin_bottom = 1


class DriftPlot(FullPlot):
    """What each clock does over time."""

    def __init__(self, *, id: str | None = None) -> None:  # noqa: A002 - Textual's name
        super().__init__(TimeAxis(), LagAxis(), id=id)

    def show(self, lines: Sequence[DrawnLine]) -> None:
        """Draw these lines and no others; the last one on top."""
        self.clear()
        if not lines:
            return
        x, y = (np.concatenate([getattr(line, axis) for line in lines]) for axis in "xy")
        most = max(LEAST_LAG, 1.1 * float(np.abs(y).max()))
        self.set_xlimits(float(x.min()), float(x.max()))
        self.set_ylimits(-most, most)
        for line in lines:
            self.plot(
                line.x,
                line.y,
                line_style=line.style,
                hires_mode=HiResMode.BRAILLE,
            )


class PsdPlot(FullPlot):
    """Curves with their 95 % bands, redrawn as a whole when any of them changes."""

    def __init__(self, *, id: str | None = None) -> None:  # noqa: A002 - Textual's name
        self._level_axis = LevelAxis()
        super().__init__(FrequencyAxis(), self._level_axis, id=id)

    def on_mount(self) -> None:
        """Say which curve is which."""
        super().on_mount()
        self.show_legend(LegendLocation.TOPRIGHT)

    def show(
        self,
        curves: Sequence[Curve],
        *,
        unit: SpectrumUnit,
        span: tuple[float, float] | None = None,
        cursor: float | None = None,
    ) -> None:
        """Draw these curves and no others; the last one on top.

        Parameters
        ----------
        curves : sequence of Curve
        unit : SpectrumUnit
            Of the labels.
        span : (float, float), optional
            Shown part, as log10 of Hz.
        cursor : float, optional
            Frequency of a vertical line, as log10 of Hz.
        """
        self.clear()
        if not curves:
            return
        self._level_axis.unit = unit
        frequencies = np.concatenate([curve.log_frequency for curve in curves])
        first, last = span or (float(frequencies.min()), float(frequencies.max()))
        curves = [curve.within(first, last) for curve in curves]
        curves = [curve for curve in curves if curve.log_frequency.size]
        low, high = level_limits(curves)
        self.set_xlimits(first, last)
        self.set_ylimits(low, high)
        if cursor is not None:
            self.add_v_line(cursor, "#e8edf6")
        self._level_axis.rows = rows = max(4, self.size.height - self.margin_bottom - 2)
        dot = (high - low) / (rows * DOTS_PER_ROW)
        column = (last - first) / self.n_points
        for curve in curves:
            if curve.band_style or curve.is_stepped:
                self._draw_band(curve, dot=dot, limits=(low, high))
        for curve in curves:
            self.plot(
                *curve.line,
                line_style=curve.style,
                hires_mode=HiResMode.BRAILLE,
                label=None if curve.marker else curve.label or None,
            )
        for number, curve in enumerate(curve for curve in curves if curve.marker):
            apart = STEPS_MARKED if curve.is_stepped else MARKED
            chosen = slice((1 + number) * apart // 3, None, apart)
            self.scatter(
                curve.log_frequency[chosen],
                curve.level_db[chosen],
                marker=curve.marker,
                marker_style=curve.style,
                label=curve.label,
            )
        self._write_names(curves, column=column, row=DOTS_PER_ROW * dot, top=high)
        self.write_legend(tuple((c.label, c.style, c.marker) for c in curves if c.label))

    def _write_names(
        self, curves: Sequence[Curve], *, column: float, row: float, top: float
    ) -> None:
        """Write names on their curves, above their beginnings, and none upon another."""
        taken: list[tuple[float, float]] = []
        for curve in curves:
            known = np.flatnonzero(np.isfinite(curve.level_db))
            if not curve.name or not known.size:
                continue
            x = float(curve.log_frequency[known[0]]) + column
            y = float(curve.level_db[known[0]]) + row
            y -= 2 * row if y > top else 0.0
            while any(abs(y - other) < row and abs(x - at) < 24 * column for at, other in taken):
                y -= row
            taken.append((x, y))
            self.scatter([x], [y], marker=f"{curve.name} ", marker_style=curve.style)

    def _draw_band(self, curve: Curve, *, dot: float, limits: tuple[float, float]) -> None:
        """Fill the 95 % interval with dots, two across each column as Braille has them."""
        low = np.clip(np.where(np.isnan(curve.low_db), curve.level_db, curve.low_db), *limits)
        high = np.clip(curve.high_db, *limits)
        known = np.isfinite(low) & np.isfinite(high)
        if known.any():
            counts = np.ceil((high[known] - low[known]) / dot).astype(int) + 1
            step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
            x = np.repeat(curve.log_frequency[known], counts)
            y = np.minimum(np.repeat(low[known], counts) + step * dot, limits[1])
            if not curve.is_stepped:
                half = np.ptp(curve.log_frequency) / (2 * self.n_points)
                x, y = np.concatenate((x, x + half)), np.concatenate((y, y))
            self.scatter(
                x,
                y,
                marker_style=curve.style if curve.is_stepped else curve.band_style,
                hires_mode=HiResMode.BRAILLE,
            )
        below = curve.negative
        if below.any():  # all that is known is an upper bound, or not even that
            y = np.where(np.isfinite(high), high, limits[0])[below]
            self.scatter(curve.log_frequency[below], y, marker="▾", marker_style=curve.style)
