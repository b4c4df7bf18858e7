"""The sensors of a bench as tables, and what the checks before a test say. No Textual here."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from rich.cells import cell_len
from rich.style import Style
from rich.text import Text

from daq.bench.durations import format_duration
from daq.errors import HuddleError
from daq.preflight.findings import Check, CheckOutcome
from daq.preflight.preflight import check_list, is_complete
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.wording import listed
from tui.application.test_view.braille import DOTS, FIRST
from tui.application.test_view.clocks import COLOURS
from tui.application.test_view.curves import Curve, data_curve, model_curves
from tui.application.test_view.plotted import MARKERS
from tui.output.check_list import sentence
from tui.wording.formatting import readings

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from numpy.typing import NDArray

    from daq.bench.masks.mask import Mask
    from daq.bench.model import Bench
    from daq.preflight.preview import SensorPreview
    from tui.application.state import State

SPECTRUM_SEGMENT, SPECTRUM_POINTS = 2.0, 120
"""Seconds of a segment of the spectra before a test, and points of a curve at most."""
GAP = 2
"""Blanks between columns."""
TAP = 6.0
"""How far the motion of the last second must exceed the usual one for its row to light up."""
LEAST_RECORD = 2.0
"""Seconds of samples from which a tap is seen."""


def columns(
    titles: Sequence[str], rows: Sequence[Sequence[Text]], *, right: Collection[str] = ()
) -> Text:
    """Return a header and a line for each row; columns are as wide as what is in them.

    Parameters
    ----------
    titles : sequence of str
    rows : sequence of sequence of Text
        A cell for each title.
    right : collection of str
        Titles of columns that are aligned to the right.
    """
    widths = _widths(titles, rows)
    lines = Text(no_wrap=True, end="")
    header = [Text(title, f"bold {MUTED}") for title in titles]
    for number, cells in enumerate([header, *rows]):
        line = Text()
        for n, (cell, width) in enumerate(zip(cells, widths, strict=True)):
            room = " " * (width - cell.cell_len)
            if titles[n] in right:
                line.append(room)
            line.append_text(cell)
            if n + 1 < len(widths):
                line.append(" " * GAP if titles[n] in right else room + " " * GAP)
        lines.append("\n" if number else "").append_text(line)
    return lines


def width_of(titles: Sequence[str], rows: Sequence[Sequence[Text]]) -> int:
    """Return the columns that these take, with the gap to one more behind them."""
    return sum(_widths(titles, rows)) + GAP * len(titles)


def _widths(titles: Sequence[str], rows: Sequence[Sequence[Text]]) -> list[int]:
    return [
        max([cell_len(title), *(row[n].cell_len for row in rows)]) for n, title in enumerate(titles)
    ]


def trace(values: NDArray[np.float64], *, width: int) -> str:
    """Return one row that shows the range of the values in each of its dot columns.

    The scale is that of the values: their range is the height of the row. Constant values are a
    line in the middle.
    """
    n_columns = 2 * width
    if len(values) < 2 or width < 1:
        return " " * max(width, 0)
    edges = np.linspace(0, len(values), min(n_columns, len(values)) + 1).astype(int)
    high = np.maximum.reduceat(values, edges[:-1])
    low = np.minimum.reduceat(values, edges[:-1])
    bottom, span = float(low.min()), float(np.ptp(values))
    if span == 0:
        first = last = np.full(len(high), 2)
    else:
        first, last = (
            np.clip(np.floor((1 - (each - bottom) / span) * 4), 0, 3).astype(int)
            for each in (high, low)
        )
    column = np.arange(n_columns)
    at, row = column * len(high) // n_columns, np.arange(4)
    is_set = (row >= first[at, None]) & (row <= last[at, None])
    cells = (is_set * DOTS[column % 2]).sum(axis=1).reshape(width, 2).sum(axis=1)
    text: bytes = (FIRST + cells).astype("<u2").tobytes()
    return text.decode("utf-16-le")


MUTED, GOOD, DOUBTFUL, BAD = "#9aa5b8", "green", "yellow", "bold #ff6b6b"
OLD = 3.0
"""Seconds since its last sample from which on a sensor is not called live."""
LEAST_TRACE, WIDEST_TRACE = 12, 60  # columns
NUMBERS = {"Hz", "°C"}


def sensors_of_bench(state: State, *, chosen: str = "") -> Text:
    """Return a row per sensor of the bench file."""
    if state.bench is None:
        return Text("This recording has no bench file: it was imported.")
    titles = ("model", "driver", "port", "channels")
    failures = {sensor.name: _failure(sensor.name, state.failure) for sensor in state.bench.sensors}
    return columns(
        ("sensor", *(("start",) if any(failures.values()) else ()), *titles),
        [
            [
                name_cell(sensor.name, chosen),
                *((Text(failures[sensor.name], BAD),) if any(failures.values()) else ()),
                *map(Text, (sensor.model, sensor.driver, sensor.port)),
                Text(" ".join(channel.name for channel in sensor.channels)),
            ]
            for sensor in state.bench.sensors
        ],
    )


def name_cell(sensor: str, chosen: str) -> Text:
    """Return the name of a sensor, which a click chooses."""
    click = {"@click": f"screen.choose({sensor!r})"}
    return Text(sensor, Style(bold=True, reverse=sensor == chosen, meta=click))


def _failure(sensor: str, failures: str) -> str:
    """Return in short why a sensor kept a recording from starting; empty if it did not."""
    for line in failures.splitlines():
        about, _, reason = line.partition(": ")
        if repr(sensor) in about:
            return f"▲ {reason.partition(';')[0].partition(':')[0]}"
    return ""


def sensor_states(
    sensors: Sequence[SensorPreview], *, width: int, chosen: str = "", is_frozen: bool = False
) -> Text:
    """Return a row per sensor: state, identity, actual rate, temperature, port."""
    rows = []
    for each in sensors:
        about, rate = each.information, each.measured_rate
        temperature = None if about is None else about.temperature
        rows.append(
            (
                name_cell(each.sensor.name, chosen),
                Text("○ frozen", DOUBTFUL) if is_frozen else _state(each),
                Text("" if about is None else about.model or each.sensor.model),
                Text("" if about is None else about.serial_number),
                Text("…" if rate is None else f"{rate:.1f}"),
                Text("" if temperature is None else f"{temperature:.1f}"),
            )
        )
    titles = ("sensor", "state", "model", "serial no.", "Hz", "°C")
    room = max(8, width - width_of(titles, rows))
    return columns(
        (*titles, "port"),
        [
            (*row, Text(tail(each.sensor.port, room)))
            for row, each in zip(rows, sensors, strict=True)
        ],
        right=NUMBERS,
    )


def tail(text: str, room: int) -> str:
    """Return the end of a text: that of a port says more than its start."""
    return text if len(text) <= room else f"…{text[1 - room :]}"


def _state(each: SensorPreview) -> Text:
    if each.trouble:
        return Text("▲ trouble", BAD)
    if len(each.samples) == 0:
        return Text("○ waiting", DOUBTFUL)
    if each.age > OLD:
        return Text(f"○ silent {format_duration(round(each.age))}", DOUBTFUL)
    return Text("▲ clipping", BAD) if each.is_clipping else Text("● live", GOOD)


def channel_traces(sensors: Sequence[SensorPreview], *, width: int) -> Text:
    """Return a row per channel: the last second as numbers, the last ten as a trace."""
    names, units, shown, numbers = [], [], [], []
    for each in sensors:
        second = each.samples[-max(1, round(each.sensor.sampling_rate)) :]
        for n, channel in enumerate(each.sensor.channels):
            if channel.auxiliary or len(second) == 0:
                continue
            values = second[:, n]
            mean = float(values.mean())
            names.append(Text(f"{each.sensor.name}.{channel.name}", "bold"))
            units.append(channel.unit)
            shown.append(each.samples[:, n])
            numbers.append((mean, float(values.std()), float(np.abs(values - mean).max())))
    rows: list[tuple[Text, ...]] = [(name,) for name in names]
    titles = ["channel"]
    for n, title in enumerate(("mean", "RMS", "peak")):
        cells, header = _readings(title, [each[n] for each in numbers], units)
        rows = [(*row, Text(cell)) for row, cell in zip(rows, cells, strict=True)]
        titles.append(header)
    room = min(max(LEAST_TRACE, width - width_of(titles, rows)), WIDEST_TRACE)
    return columns(
        (*titles, "last 10 s"),
        [
            (*row, Text(trace(values, width=room), "#4cc9f0"))
            for row, values in zip(rows, shown, strict=True)
        ],
        right=titles[1:],
    )


def _readings(
    title: str, column: Sequence[float], units: Sequence[str]
) -> tuple[Sequence[str], str]:
    """Return the cells of a column and its header, which has the unit if all channels share it."""
    cells = [""] * len(column)
    found = ""
    for unit in dict.fromkeys(units):
        at = [n for n, each in enumerate(units) if each == unit]
        texts, found = readings([column[n] for n in at], unit)
        for n, text in zip(at, texts, strict=True):
            cells[n] = text if len(at) == len(units) else f"{text} {found}"
    return cells, f"{title}, {found}" if len(set(units)) == 1 else title


def spectra(sensors: Sequence[SensorPreview], models: Sequence[Mask]) -> list[Curve]:
    """Return the spectrum of every channel, by the last seconds, and noise models beside them.

    Channels of one unit only, that of the first: of the others no level would be comparable. A
    colour and a mark for each sensor, whose first channel is labelled.
    """
    units = [c.unit for each in sensors for c in each.sensor.channels if not c.auxiliary]
    unit, found = units[0] if units else "", []
    highest = 0.0
    for number, each in enumerate(sensors):
        length = round(SPECTRUM_SEGMENT * each.sensor.sampling_rate)
        if len(each.samples) < 2 * length or length < 8:
            continue
        frequency, psd = _welch(each.samples, length, each.sensor.sampling_rate)
        highest = max(highest, float(frequency[-1]))
        of_sensor = 0
        for column, channel in enumerate(each.sensor.channels):
            if channel.auxiliary or channel.unit != unit:
                continue
            style = COLOURS[number % len(COLOURS)]
            curve = data_curve(frequency, psd[:, column], n_points=SPECTRUM_POINTS, style=style)
            label = "" if of_sensor else each.sensor.name
            marker = "" if of_sensor else MARKERS[number % len(MARKERS)]
            found.append(replace(curve, label=label, band_style="", marker=marker))
            of_sensor += 1
    if not found:
        return []
    frequency = np.linspace(0.0, highest, 1 + round(highest * SPECTRUM_SEGMENT))
    fitting = [model for model in models if _fits(model, unit)]
    return [*model_curves(fitting, frequency, unit, n_points=SPECTRUM_POINTS), *found]


def _fits(model: Mask, unit: str) -> bool:
    try:
        model.check_unit(unit)
    except HuddleError:  # a channel in V, say
        return False
    return True


def _welch(
    samples: NDArray[np.float64], length: int, rate: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies and mean one-sided PSD of segments that overlap by half."""
    settings = WelchSettings(
        sampling_rate=rate, segment_length=length, overlap=0.5, window="hann", detrend="linear"
    )
    found = CrossSpectra(settings, samples.shape[1])
    starts = np.arange(0, len(samples) - length + 1, settings.hop)
    found.add(np.ascontiguousarray(samples), starts)
    psd = np.diagonal(found.csm(), axis1=1, axis2=2).real
    return settings.frequencies, np.ascontiguousarray(psd)


def checks(bench: Bench, sensors: Sequence[SensorPreview]) -> list[Text]:
    """Return what the check list finds; the last line says whether all is ready.

    Rows that passed are not shown, and what is not checked is named in the last line.
    """
    rows = check_list(bench, sensors)
    failing = [row.finding for row in rows if row.outcome is CheckOutcome.FAILED and row.finding]
    unknown = {row.check for row in rows if row.outcome is CheckOutcome.NOT_CHECKED}
    lines = [Text(f"✗ {sentence(each)}", BAD) for each in failing]
    if not is_complete(sensors):
        return [*lines, Text("checking …", MUTED)]
    if failing:
        wrong = {each.sensor for each in failing}
        named = [e.sensor.name for e in sensors if e.sensor.name in wrong] or ["the bench"]
        return [*lines, Text(f"not ready: put {listed(named)} right first", BAD)]
    if unknown:
        left = listed([each.value for each in Check if each in unknown])
        return [Text(f"? nothing wrong is seen; not checked: {left}", DOUBTFUL)]
    return [Text("✓ ready: s starts a test", f"bold {GOOD}")]


def motion_of(sensor: SensorPreview) -> NDArray[np.float64]:
    """Return how far the channels are from their means, as one length for each sample."""
    main = [n for n, channel in enumerate(sensor.sensor.channels) if not channel.auxiliary]
    if len(sensor.samples) == 0:
        return np.zeros(0)
    values = sensor.samples[:, main]
    away: NDArray[np.float64] = np.linalg.norm(values - values.mean(0), axis=1)
    return away


def tapped(sensors: Sequence[SensorPreview]) -> str:
    """Return the sensor whose motion in the last second most exceeds its usual one; or none.

    All sensors feel a tap on one of them: only the one that feels it most.
    """
    best, name = TAP, ""
    for each in sensors:
        rate = each.sensor.sampling_rate
        motion, second = motion_of(each), max(1, round(rate))
        if len(motion) < LEAST_RECORD * rate:
            continue
        usual = float(np.median(motion[:-second]))
        if usual > 0 and (ratio := float(motion[-second:].max()) / usual) > best:
            best, name = ratio, each.sensor.name
    return name
