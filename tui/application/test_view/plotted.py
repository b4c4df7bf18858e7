"""What is plotted of a test: curves of the chosen channel, limits, and an earlier recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daq.results.decision.limits import concerns, mask_psd
from estimator.levels.bands import log_edges
from tui.application.test_view.clocks import COLOURS
from tui.application.test_view.curves import (
    Curve,
    data_curve,
    mask_curve,
    model_curves,
    noise_curve,
)
from tui.application.test_view.units import SpectrumUnit, units_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.estimation.snapshot import Snapshot
    from daq.results.result import Result
    from tui.application.state import State

THIRDS, TWELFTHS = 3, 12
"""Steps to an octave."""
LEAST_WIDTH = 3.0
"""Columns of a step at least where they are twelfths."""
NARROWEST = 0.02  # of a decade
DATA_STYLE = "#7d8799"
LIMITS = (("#ff6b6b", "■"), ("#ff9f43", "□"), ("#ff6bb5", "▣"), ("#e0e04c", "▢"))
"""Colour and marker of each limit of a bench file, in turn."""
MARKERS = "●×◆+■▲"
REFERENCE_STYLE = ("#7bd88f", "#3f6d4b", "≈")
STYLES = {
    "three-sensor": ("#4cc9f0", "#1d6f8c", "●"),
    "three-channel": ("#f4a261", "#8a5a34", "×"),
    "maximum-likelihood": ("#c297ff", "#5f4890", "◆"),
    "two-channel": ("#e9d86b", "#7f7638", "+"),
    "multi-part": ("#ff7b9c", "#8a4454", "★"),
}
"""Colours of each method, of its curve and of its 95 % band, and what marks the curve."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What the technician looks at.

    Attributes
    ----------
    channel : int
    methods : tuple of str
        By name; the first one also fills the table.
    clocks : bool
        Clocks in place of noise.
    channels : bool
        A row per channel in place of one per sensor.
    overlay : bool
        The like channels of all sensors in place of one channel.
    picked : frozenset of int
        Channels that are drawn beside the chosen one.
    unit : int
        Among those of `units_of`.
    span : (float, float) or None
        Shown part of the frequencies, as log10 of Hz; None for all.
    cursor : float or None
        Where values are read off, as log10 of Hz.
    bins : bool
        As fine as the screen shows, in place of steps of a third or a twelfth of an octave.
    """

    channel: int = 0
    methods: tuple[str, ...] = ()
    clocks: bool = False
    channels: bool = False
    overlay: bool = False
    picked: frozenset[int] = frozenset()
    unit: int = 0
    span: tuple[float, float] | None = None
    cursor: float | None = None
    bins: bool = False


def whole_span(snapshot: Snapshot) -> tuple[float, float]:
    """Return all frequencies that are plotted, as log10 of Hz."""
    frequency = snapshot.frequency
    return math.log10(frequency[1]), math.log10(frequency[-2])


def zoomed(choice: Choice, snapshot: Snapshot, factor: float) -> Choice:
    """Return a choice with this factor of the frequencies: closer about the cursor, if placed."""
    low, high = choice.span or whole_span(snapshot)
    middle = (low + high) / 2 if choice.cursor is None or factor > 1 else choice.cursor
    return _spanning(choice, snapshot, *(middle + factor * (end - middle) for end in (low, high)))


def panned(choice: Choice, snapshot: Snapshot, share: float) -> Choice:
    """Return a choice moved by a share of what is shown."""
    low, high = choice.span or whole_span(snapshot)
    first, last = whole_span(snapshot)
    shift = min(max(share * (high - low), first - low), last - high)
    return _spanning(choice, snapshot, low + shift, high + shift)


def _spanning(choice: Choice, snapshot: Snapshot, low: float, high: float) -> Choice:
    first, last = whole_span(snapshot)
    low, high = max(low, first), min(high, last)
    if high - low < NARROWEST:
        return choice
    is_whole = high - low >= last - first - 1e-9
    cursor = None if choice.cursor is None else min(max(choice.cursor, low), high)
    return replace(choice, span=None if is_whole else (low, high), cursor=cursor)


def moved(choice: Choice, snapshot: Snapshot, step: float) -> Choice:
    """Return a choice with the cursor moved by a share of what is shown; placed, if it was not."""
    low, high = choice.span or whole_span(snapshot)
    if choice.cursor is None:
        return replace(choice, cursor=(low + high) / 2)
    return replace(choice, cursor=min(max(choice.cursor + step * (high - low), low), high))


def stepped(choice: Choice, snapshot: Snapshot, *, channel: int = 0, sensor: int = 0) -> Choice:
    """Return a choice of another channel, or of the like channel of another sensor."""
    if channel:
        return replace(choice, channel=(choice.channel + channel) % len(snapshot.channels))
    starts, now, place = _place(choice, snapshot)
    other = (now + sensor) % len(starts)
    return replace(choice, channel=starts[other] + min(place, snapshot.dims[other] - 1))


def compared_channels(choice: Choice, snapshot: Snapshot) -> list[int]:
    """Return the channels that are drawn in one plot; none where it is of the chosen one alone."""
    like = _like_channels(choice, snapshot) if choice.overlay else []
    return sorted({choice.channel, *choice.picked, *like}) if like or choice.picked else []


def picking(choice: Choice) -> Choice:
    """Return a choice with the chosen channel among those drawn beside others, or no longer."""
    return replace(choice, picked=choice.picked ^ {choice.channel})


def _like_channels(choice: Choice, snapshot: Snapshot) -> list[int]:
    """Return the channels at the place that the chosen one has in its sensor, of every sensor."""
    starts, _, place = _place(choice, snapshot)
    return [start + place for start, d in zip(starts, snapshot.dims, strict=True) if place < d]


def _place(choice: Choice, snapshot: Snapshot) -> tuple[list[int], int, int]:
    """Return the first channel of every sensor, and sensor and place in it of the chosen one."""
    starts = [sum(snapshot.dims[:n]) for n in range(len(snapshot.dims))]
    now = max(n for n, start in enumerate(starts) if start <= choice.channel)
    return starts, now, choice.channel - starts[now]


def curves(state: State, choice: Choice, *, n_points: int) -> list[Curve]:
    """Return the curves of the chosen channel, what is less important first.

    Its data, noise models, the same channel of the recording it is compared with, the limits, the
    estimates.
    """
    result = state.result
    if result is None or result.snapshot.n_segments == 0:
        return []
    snapshot = result.snapshot
    if choice.span is not None:  # finer, where less is shown
        first, last = whole_span(snapshot)
        n_points = round(n_points * (last - first) / (choice.span[1] - choice.span[0]))
    column, frequency = choice.channel, snapshot.frequency
    models = model_curves(state.models, frequency, snapshot.unit, n_points=n_points)
    limits = _limits(state, choice, n_points=n_points)
    if compared := compared_channels(choice, snapshot):
        return models + limits + _compared(state, choice, compared, n_points=n_points)
    shown = [
        data_curve(frequency, snapshot.data_psd[:, column], n_points=n_points, style=DATA_STYLE)
    ]
    shown += models + _reference(state, choice, n_points=n_points) + limits
    for method in choice.methods:
        if method in snapshot.results:
            shown.append(
                _noise(result, column, method, choice, n_points, label=method, style=STYLES[method])
            )
    return shown


def _compared(
    state: State, choice: Choice, columns: Sequence[int], *, n_points: int
) -> list[Curve]:
    """Return the noise of some channels, the chosen one on top."""
    result, method = state.result, next(iter(choice.methods), "")
    if result is None or method not in result.snapshot.results:
        return []
    return [
        _noise(
            *(result, column, method, choice, n_points),
            label=result.snapshot.channels[column].name,
            style=(COLOURS[n % len(COLOURS)], "", MARKERS[n % len(MARKERS)]),
        )
        for n, column in sorted(enumerate(columns), key=lambda each: each[1] == choice.channel)
    ]


def _noise(
    result: Result,
    column: int,
    method: str,
    choice: Choice,
    n_points: int,
    *,
    label: str,
    style: tuple[str, str, str],
) -> Curve:
    snapshot = result.snapshot
    n_bands = n_points if choice.bins else steps_of(snapshot, n_points)
    edges = log_edges(snapshot.frequency, n_bands)
    found = result.spectrum(method).levels(edges)
    return noise_curve(
        snapshot.frequency,
        found.of_channel(column),
        edges=edges,
        label=label,
        style=style,
        stepped=not choice.bins,
    )


def steps_of(snapshot: Snapshot, n_points: int) -> int:
    """Return into how many bands so many columns are divided: twelfths of an octave, or thirds."""
    first, last = whole_span(snapshot)
    octaves = (last - first) / math.log10(2)
    width = n_points / (TWELFTHS * octaves)
    return max(1, round((TWELFTHS if width >= LEAST_WIDTH else THIRDS) * octaves))


def _reference(state: State, choice: Choice, *, n_points: int) -> list[Curve]:
    """Return the noise of the same channel in the earlier recording, by the first method shown."""
    reference, snapshot = state.reference, state.snapshot
    if reference is None or snapshot is None or reference.result.snapshot.unit != snapshot.unit:
        return []
    before = reference.result.snapshot
    wanted = snapshot.channels[choice.channel]
    columns = [
        column
        for column, label in enumerate(before.channels)
        if (label.sensor, label.channel) == (wanted.sensor, wanted.channel)
    ]
    methods = [method for method in choice.methods if method in before.results]
    if not columns or not methods:
        return []
    about = reference.result, columns[0], methods[0], choice, n_points
    return [_noise(*about, label=reference.path.stem, style=REFERENCE_STYLE)]


def _limits(state: State, choice: Choice, *, n_points: int) -> list[Curve]:
    """Return the masks that are for the chosen channel."""
    bench = None if state.result is None else state.result.bench
    if state.snapshot is None or bench is None:
        return []
    snapshot = state.snapshot
    label, frequency = snapshot.channels[choice.channel], snapshot.frequency
    return [
        mask_curve(
            frequency,
            limit.mask,
            mask_psd(bench, limit, label, frequency[1:]),
            n_points=n_points,
            label=limit.name,
            style=LIMITS[number % len(LIMITS)][0],
            marker=LIMITS[number % len(LIMITS)][1],
        )
        for number, limit in enumerate(bench.limits)
        if concerns(limit, label)
    ]


def plot_title(snapshot: Snapshot, choice: Choice) -> str:
    """Return what the plot shows, with its unit."""
    label, unit = snapshot.channels[choice.channel], unit_of(snapshot, choice)
    if compared := compared_channels(choice, snapshot):
        names = ", ".join(snapshot.channels[column].name for column in compared)
        return f"{names}   noise in {unit.name}"
    return f"{label.sensor} {label.channel}   power spectral density in {unit.name}"


def unit_of(snapshot: Snapshot, choice: Choice) -> SpectrumUnit:
    """Return the chosen unit."""
    units = units_of(snapshot.unit)
    return units[choice.unit % len(units)]


def read_out(snapshot: Snapshot, choice: Choice, curves: Sequence[Curve]) -> str:
    """Return the values of all curves at the cursor, estimates with their 95 % interval."""
    if choice.cursor is None or not curves:
        return ""
    unit, cursor, parts = unit_of(snapshot, choice), choice.cursor, []
    estimates = [each for each in curves if each.label in choice.methods]
    for curve in (*estimates, *(each for each in curves if each.label not in choice.methods)):
        at = int(np.argmin(np.abs(curve.log_frequency - cursor)))
        if text := reading(curve, at, unit):
            parts.append(f"{curve.label} {text}")
    name = snapshot.channels[choice.channel].name
    what = "" if choice.overlay or choice.picked else f"{name}  "
    return f"{10**cursor:.3g} Hz  {what}{unit.name}:  {' · '.join(parts)}"


def reading(curve: Curve, at: int, unit: SpectrumUnit) -> str:
    """Return the value of a curve at one of its points with its interval; empty if it has none."""
    level, low, high = curve.level_db[at], curve.low_db[at], curve.high_db[at]
    if math.isnan(level) and math.isnan(high):
        return ""
    text = f"below {unit.text(high)}" if math.isnan(level) else unit.text(level)
    if math.isfinite(level) and math.isfinite(high):
        text += f" ({'0' if math.isnan(low) else unit.text(low)} to {unit.text(high)})"
    return text
