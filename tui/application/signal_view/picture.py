"""Waveforms and spectrograms in the cells of a terminal. Does not use Textual."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from rich.text import Text

from daq.results.signal import EXCLUDED, Mark, Spectrogram, Waveforms
from estimator.types import FloatArray, IntArray
from tui.application.test_view.braille import cells
from tui.wording.signal import (
    extent,
    loudest,
    moment,
    most_first,
    scale,
    sign,
    time_ticks,
    title,
    words,
)

MUTED, CHOSEN, PLAIN, BAD = "#9aa5b8", "#4cc9f0", "#c5cedb", "bold #ff6b6b"
CURSOR = "on #26324a"
SHADES = " ░▒▓█"
COLOURS = ("#3b4252", "#41557b", "#3f74a8", "#3f97b8", "#58b7a5", "#8fce82", "#cfdc6a", "#fde74c")
"""Of a spectrogram from the lowest level to the highest; its shades say the same without colour."""
TICK_ROOM, FREQUENCY_ROWS = 14, 4
NAME_WIDTH = 13, 16
"""Least and most width of what stands left of the columns: a name, and ` 1.27 mm/s²`."""
RECORDED, NOISE = "recorded", "noise"
_NEAR = 1e-3  # seconds
BESIDE = 4
"""Rows that are neither waveform nor spectrogram: title, marks, times, and what is read off."""


@dataclass(frozen=True, slots=True)
class Look:
    """What of a recording is looked at.

    Attributes
    ----------
    span : (float, float) or None
        UTC in s; None for all.
    channel : int
        Number of the chosen trace.
    spectrum : str
        `RECORDED` or `NOISE` for a spectrogram of the channel; empty for waveforms of all.
    cursor : float or None
        Where values are read off.
    excluded : sequence of (float, float)
        Stretches that the estimate leaves out.
    begun : float or None
        Where a stretch to exclude begins, whose end is not chosen yet.
    """

    span: tuple[float, float] | None = None
    channel: int = 0
    spectrum: str = ""
    cursor: float | None = None
    excluded: tuple[tuple[float, float], ...] = ()
    begun: float | None = None

    @property
    def here(self) -> tuple[float, float] | None:
        """The excluded stretch at the cursor."""
        at = self.cursor
        if at is None:
            return None
        # Ends of stretches are known to a microsecond, the cursor is not.
        return next((s for s in self.excluded if s[0] - _NEAR <= at <= s[1] + _NEAR), None)


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """What is drawn of a look: its waveforms, and the spectrogram if it is known, or why not."""

    waves: Waveforms
    spectrum: Spectrogram | None = None
    why: str = ""
    of: tuple[str, int] = ("", 0)
    """What the look has for spectrum and channel."""


def name_width(waves: Waveforms) -> int:
    """Return the width of what stands left of the columns."""
    longest = max((len(trace.name) for trace in waves.traces), default=0)
    return min(max(longest + 2, NAME_WIDTH[0]), NAME_WIDTH[1])


def picture(drawn: Drawn, look: Look, width: int, height: int) -> Text:
    """Return a picture of so many cells."""
    if drawn.of != (look.spectrum, look.channel):
        drawn = replace(drawn, spectrum=None, why="drawing …")
    waves, left = drawn.waves, name_width(drawn.waves)
    columns, rows = width - left, max(1, height - BESIDE)
    body = (
        _spectrum(drawn, left, columns, rows)
        if look.spectrum
        else _waveforms(waves, look, left, columns, rows)
    )
    lines = [_title(drawn, look, width), *body]
    lines += [Text("", MUTED)] * (rows + 1 - len(lines))
    lines += [_lane(waves, look, left, columns), _axis(waves, left, columns)]
    at = look.cursor
    if at is not None and waves.begin <= at <= waves.end:
        column = left + min(int((at - waves.begin) / _cell(waves, columns)), columns - 1)
        for line in lines[1:-1]:
            line.pad_right(max(0, column + 1 - line.cell_len))
            line.stylize(CURSOR, column, column + 1)
    lines.append(_read_off(waves, look, width))
    return Text("\n").join(lines)


def _cell(waves: Waveforms, columns: int) -> float:
    return (waves.end - waves.begin) / columns


def _title(drawn: Drawn, look: Look, width: int) -> Text:
    waves = drawn.waves
    name = waves.traces[look.channel].name if waves.traces else ""
    text = Text(title(waves), "bold")
    if look.spectrum:
        text.append(f"  {name} {look.spectrum}", CHOSEN)
        if drawn.spectrum is None:
            text.append(f": {drawn.why}", MUTED)
        else:
            text.append(f"  {scale(drawn.spectrum)}", MUTED)
            if text.cell_len + len(most := loudest(drawn.spectrum)) <= width:
                text.append(most, CHOSEN)
    text.truncate(width, overflow="ellipsis")
    return text


def _waveforms(waves: Waveforms, look: Look, left: int, columns: int, rows: int) -> list[Text]:
    """Return rows of Braille, as many of each channel; of those that fit about the chosen one."""
    traces = waves.traces
    height = max(1, rows // max(1, len(traces)))
    fits = rows // height
    first = min(max(0, look.channel - fits // 2), max(0, len(traces) - fits))
    lines = []
    for number, trace in list(enumerate(traces))[first : first + fits]:
        style = CHOSEN if number == look.channel else PLAIN
        grid = [[" "] * columns for _ in range(height)]
        for column, row, character in _dots(*trace.scaled, columns, height):
            grid[row][column] = character
        beside = [trace.name, f" {extent(trace)}"] + [""] * height
        mark = "▸" if number == look.channel else " "
        for row in range(height):
            text = f"{mark if row == 0 else ' '}{beside[row]}"[: left - 1].ljust(left)
            label = Text(text, f"bold {style}" if row == 0 else MUTED)
            lines.append(label.append("".join(grid[row]), style))
    return lines


def _dots(
    low: FloatArray, high: FloatArray, columns: int, height: int
) -> list[tuple[int, int, str]]:
    """Return the cells between extremes, two columns of which are in each."""
    known = np.isfinite(low)
    most = 4 * height - 1
    top: IntArray = np.rint((1 - high[known]) / 2 * most).astype(np.int64)
    bottom: IntArray = np.rint((1 - low[known]) / 2 * most).astype(np.int64)
    length = bottom - top + 1
    x = np.repeat(np.flatnonzero(known), length)
    y = np.repeat(top, length) + np.arange(length.sum())
    y -= np.repeat(np.cumsum(length) - length, length)
    return list(cells(x.astype(float), y.astype(float), columns, height))


def _spectrum(drawn: Drawn, left: int, columns: int, rows: int) -> list[Text]:
    """Return rows of shades, the highest frequency first."""
    found, waves = drawn.spectrum, drawn.waves
    if found is None:
        return []
    middle, share = found.grid(waves.begin, waves.end, columns, rows)
    lines = []
    for row in range(rows - 1, -1, -1):
        is_named = (rows - 1 - row) % FREQUENCY_ROWS == 0
        label = f"{middle[row]:.3g} Hz" if is_named else ""
        line = Text(label.rjust(left - 1).ljust(left), MUTED)
        for each in share[row]:
            if np.isnan(each):
                line.append(" ")
            else:
                shade = SHADES[1 + min(int(each * 4), 3)]
                line.append(shade, COLOURS[min(int(each * len(COLOURS)), len(COLOURS) - 1)])
        lines.append(line)
    return lines


def _lane(waves: Waveforms, look: Look, left: int, columns: int) -> Text:
    """Return the signs of all marks; single moments are on top."""
    signs = [" "] * columns
    chosen = [Mark(begin, end, EXCLUDED) for begin, end in look.excluded]
    if look.begun is not None:
        chosen.append(Mark(look.begun, look.begun, EXCLUDED))
    for mark in sorted((*chosen, *waves.marks), key=lambda each: each.begin - each.end):
        first = int((mark.begin - waves.begin) / _cell(waves, columns))
        last = int((mark.end - waves.begin) / _cell(waves, columns))
        for column in range(max(0, first), min(last, columns - 1) + 1):
            signs[column] = sign(mark)
    return Text("marks".ljust(left), MUTED).append("".join(signs), BAD)


def _axis(waves: Waveforms, left: int, columns: int) -> Text:
    line = [" "] * columns
    for at, label in time_ticks(waves.begin, waves.end, columns // TICK_ROOM):
        column = int((at - waves.begin) / _cell(waves, columns))
        text = f"╵{label}"
        if column + len(text) <= columns:
            line[column : column + len(text)] = text
    return Text("UTC".ljust(left) + "".join(line), MUTED)


def _read_off(waves: Waveforms, look: Look, width: int) -> Text:
    """Return what is at the cursor: time, extremes of the chosen channel, and the mark."""
    if look.cursor is None or not waves.traces:
        here = waves.marks[0] if waves.marks else None
        text = "" if here is None else f"first mark {words(here)}  (n: next)"
        return Text(text[:width], MUTED)
    trace = waves.traces[look.channel]
    column = min(max(waves.column_of(look.cursor), 0), waves.n_columns - 1)
    low, high = float(trace.least[column]), float(trace.most[column])
    values = "no sample" if np.isnan(low) else f"{low:.4g} to {high:.4g} {trace.unit}"
    at = moment(look.cursor, fine=waves.end - waves.begin < 600)[11:]
    text = f"{at}  {trace.name} {values}".replace("-", "−")
    if look.here is not None:
        text += f"  {sign(Mark(*look.here, EXCLUDED))} excluded (x: take it back)"
    elif look.begun is not None:
        begun = Mark(look.begun, look.begun, EXCLUDED)
        text += f"  {sign(begun)} begun; x at its end excludes, esc does not"
    for mark in most_first(waves.near(look.cursor)):
        text += f"  {sign(mark)} {words(mark)}"
    return Text(text[:width])
