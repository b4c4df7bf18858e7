"""The section about noise terms, the Allan deviation and the data sheet."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from daq.results.noise_parameters import ChannelParameters, noise_parameters, quantisation_shares
from tui.output.noise_parameters import (
    allan_table,
    notes,
    quantisation_notes,
    sheet_table,
    term_table,
)
from tui.page import drawing
from tui.page.blocks import Items, Paragraph, Part, Plot, Section, three_to_a_row
from tui.page.ticks import set_log_ticks
from tui.wording.formatting import power_of_ten

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.estimation.snapshot import Snapshot
    from daq.results.result import Result
    from tui.page.axes import Axes

HEIGHT = 0.8


def _draw_allan(
    channels: Sequence[ChannelParameters],
    name: str,
    unit: str,
    scale: tuple[float, float],
    axes: Axes,
) -> None:
    """Draw the Allan deviation of one sensor's channels, of which each number has its colour."""
    times = []
    for number, each in enumerate(channels):
        found = each.allan
        if found is None:
            continue
        colour, dashes = drawing.style_of(number)
        known = found.deviation > 0
        tau, label = found.tau[known], each.label.channel
        axes.fill_between(tau, found.low[known], found.high[known], color=colour, alpha=0.2, lw=0)
        axes.plot(tau, found.deviation[known], color=colour, dashes=dashes, lw=0.9, label=label)
        times += [found.tau.min(), found.tau.max()]
    room = max(1.1, (max(times) / min(times)) ** 0.05)
    span = float(min(times) / room), float(max(times) * room)
    axes.set(title=name, xlabel="averaging time (s)", ylabel=f"σ ({unit})")
    axes.set(xscale="log", yscale="log", xlim=span, ylim=scale)
    set_log_ticks(axes.xaxis, *span, "{:g}".format, digits=(1, 2, 5))
    set_log_ticks(axes.yaxis, *scale, lambda at: power_of_ten(math.log10(at)), has_minor=False)


def parameters_section(result: Result) -> Section | None:
    """Return noise terms, Allan deviation and data sheet; None where nothing can be fitted."""
    snapshot, unit = result.snapshot, result.snapshot.unit
    found = noise_parameters(result, result.bench)
    if not any(each.parameters is not None for each in found):
        return None
    parts: list[Part] = []
    tables = (
        (f"Noise terms at 1 Hz, dB re 1 ({unit})²/Hz, with standard errors", term_table(found)),
        (f"Allan deviation in {unit}, with 95 % intervals", allan_table(found)),
        ("Data sheet", sheet_table(found)),
    )
    for title, table in tables:
        if table.rows:
            parts.append(replace(table, title=title))
    lines = [
        *notes(found),
        *quantisation_notes(snapshot.channels, quantisation_shares(result)),
    ]
    if lines:
        parts.append(Items(tuple(Paragraph(line, "doubtful") for line in lines)))
    parts.append(
        Paragraph(
            "Random walk (f⁻²), flicker (f⁻¹), white and f² noise are fitted to the PSD of the "
            "noise by weighted least squares. Quantisation: white noise of counting in whole "
            "numbers, part of the white term. Allan deviation (σ): of the sensor's own noise, "
            "without the motion, up to the highest frequency of the estimate.",
            "quiet",
        )
    )
    parts += _plots(found, snapshot)
    return Section("Noise parameters", tuple(parts))


def _plots(found: tuple[ChannelParameters, ...], snapshot: Snapshot) -> list[Plot]:
    """Return the Allan deviation of every sensor, up to three side by side."""
    known = [each.allan for each in found if each.allan is not None]
    values = np.concatenate([each.deviation for each in known] or [np.empty(0)])
    values = values[values > 0]
    if not values.size:
        return []
    low, high = np.log10(values.min() / 1.2), np.log10(values.max() * 1.2)
    scale = (10.0 ** math.floor(low), 10.0 ** math.ceil(high))
    panels = []
    for sensor in snapshot.sensor_names:
        channels = tuple(each for each in found if each.label.sensor == sensor)
        if any(each.allan is not None and (each.allan.deviation > 0).any() for each in channels):
            draw = partial(_draw_allan, channels, f"Sensor {sensor}", snapshot.unit, scale)
            panels.append(draw)
    alt = "Allan deviation of the noise against averaging time"
    return three_to_a_row(panels, "", height=HEIGHT, alt=alt)
