"""What the application shows of a snapshot, as text and curves; no Textual here."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table
from rich.text import Text

from tui.application.curves import data_curve, noise_curve
from tui.results import band_of, channel_means, correlation_of, reached_cov
from tui.text import clock_time, decibels, time_left

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.estimation import Settings, Snapshot
    from tui.application.curves import Curve
    from tui.bands import BandMeans

DATA_STYLE = "#7d8799"
STYLES = {
    "three-sensor": ("#4cc9f0", "#1d6f8c"),
    "three-channel": ("#f4a261", "#8a5a34"),
    "maximum-likelihood": ("#c297ff", "#5f4890"),
    "two-channel": ("#e9d86b", "#7f7638"),
}
"""Colours of each method: of its curve and of its 95 % band."""
SILENT = 3.0
"""Seconds without a sample after which a sensor is called silent, while others go on."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What the technician has chosen to look at: a channel, and methods by name."""

    channel: int = 0
    methods: tuple[str, ...] = ()


def curves(snapshot: Snapshot, settings: Settings, choice: Choice, *, n_points: int) -> list[Curve]:
    """Return the curves of the chosen channel: its data below, the chosen estimates above."""
    if snapshot.n_segments == 0:
        return []
    column, frequency = choice.channel, snapshot.frequency
    shown = [
        data_curve(frequency, snapshot.data_psd[:, column], n_points=n_points, style=DATA_STYLE)
    ]
    correlation = correlation_of(settings)
    for method in choice.methods:
        if method not in snapshot.results:
            continue
        noise = snapshot.results[method]
        style, band_style = STYLES[method]
        shown.append(
            noise_curve(
                frequency,
                noise.noise_psd[:, column],
                noise.cov[:, column],
                correlation=correlation,
                n_points=n_points,
                label=method,
                style=style,
                band_style=band_style,
            )
        )
    return shown


def plot_title(snapshot: Snapshot, choice: Choice) -> str:
    """Return what the plot shows, with its unit."""
    label = snapshot.channels[choice.channel]
    return f"{label.sensor} {label.channel}   power spectral density re 1 ({snapshot.unit})²/Hz"


def sensor_table(snapshot: Snapshot, settings: Settings, choice: Choice) -> Table:
    """Return a row per sensor: how it is, and the noise of each of its channels in the band."""
    method = next((m for m in choice.methods if m in snapshot.results), None)
    means: tuple[BandMeans, ...] = ()
    band = band_of(settings, snapshot.frequency)
    if method is not None:
        means = channel_means(snapshot.results[method], snapshot.frequency, settings, band)
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold #9aa5b8")
    table.add_column("sensor", no_wrap=True)
    table.add_column("state", no_wrap=True)
    for title in ("Hz", "samples", "gaps"):
        table.add_column(title, justify="right", no_wrap=True)
    titles = ("noise, dB", f"{band[0]:.3g}–{band[1]:.3g} Hz")
    for number in range(max(snapshot.dims)):
        table.add_column(titles[number] if number < len(titles) else "", no_wrap=True)
    latest = max((sensor.last_seen for sensor in snapshot.sensors), default=math.nan)
    of_sensor = _columns_of(snapshot)
    for sensor in snapshot.sensors:
        cells = [
            _channel_noise(snapshot, column, means, chosen=column == choice.channel)
            for column in of_sensor.get(sensor.name, ())
        ]
        gaps = f"{sensor.n_gaps} ({sensor.n_missing})" if sensor.n_gaps else "0"
        table.add_row(
            Text(sensor.name, "bold"),
            _state(sensor.last_seen, latest, closed=snapshot.closed),
            f"{sensor.sampling_rate:g}",
            f"{sensor.n_samples:,}".replace(",", " "),
            Text(gaps, "yellow" if sensor.n_gaps else ""),
            *cells,
        )
    return table


def _columns_of(snapshot: Snapshot) -> dict[str, list[int]]:
    columns: dict[str, list[int]] = {}
    for column, label in enumerate(snapshot.channels):
        columns.setdefault(label.sensor, []).append(column)
    return columns


def _state(last_seen: float, latest: float, *, closed: bool) -> Text:
    if math.isnan(last_seen):
        return Text("○ waiting", "yellow")
    if closed:
        return Text("■ ended", "#9aa5b8")
    silent = latest - last_seen
    if silent > SILENT:
        return Text(f"○ silent {clock_time(silent)}", "bold red")
    return Text("● live", "green")


def _channel_noise(
    snapshot: Snapshot, column: int, means: Sequence[BandMeans], *, chosen: bool
) -> Text:
    name = snapshot.channels[column].channel
    value = "…"
    if means:
        mean, high = float(means[column].mean[0]), float(means[column].high[0])
        if mean > 0:
            value = f"{decibels(mean):.1f}±{decibels(high) - decibels(mean):.1f}"
        elif not math.isnan(mean):
            value = "below 0"
    return Text(f"{name} {value}".replace("-", "−"), "reverse" if chosen else "")


def progress_line(snapshot: Snapshot, settings: Settings, choice: Choice, *, width: int) -> Text:
    """Return how far the test is: a bar where there is a target, segments, c.o.v., time left."""
    method = next((m for m in choice.methods if m in snapshot.results), None)
    cov, target = reached_cov(snapshot, settings, method), settings.target_cov
    if snapshot.n_segments == 0:
        return Text(f"waiting for the first {settings.segment:g} s segment", "#9aa5b8")
    parts = [f"{snapshot.n_segments} segments"]
    if snapshot.n_dropped:
        parts.append(f"{snapshot.n_dropped} dropped")
    if not math.isnan(cov):
        parts.append(f"c.o.v. {cov:.3f}" + (f" → {target:g}" if target else ""))
    if target is not None:
        reached = "target reached" if cov <= target else "target not reached"
        parts.append(reached if snapshot.closed else time_left(snapshot.time_left))
    text = " · ".join(parts)
    line = Text()
    room = width - len(text) - 3
    running = snapshot.time_left is not None and not snapshot.closed
    if target is not None and running and room >= 8:
        left = snapshot.time_left or 0.0
        done = snapshot.elapsed / max(snapshot.elapsed + left, 1e-9)
        filled = round(done * room)
        line.append("━" * filled, "#4cc9f0")
        line.append("━" * (room - filled), "#2b3345")
        line.append("  ")
    line.append(text)
    return line


def advice(snapshot: Snapshot, choice: Choice) -> Text:
    """Return one line on what to know about what is shown."""
    refused = [f"{method}: {why}" for method, why in snapshot.refused.items()]
    if refused:
        return Text(refused[0], "yellow")
    for method in choice.methods:
        noise = snapshot.results.get(method)
        if noise is None:
            continue
        values = noise.noise_psd[1:-1, choice.channel]
        negative = int(np.sum(values <= 0))
        if negative:
            return Text(
                f"{method}: {negative} of {values.size} values at or below zero (▾ marks the "
                "upper bound)",
                "yellow",
            )
    return Text("")
