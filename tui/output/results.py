"""A finished estimate as a table, remarks and CSV."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from daq.results.band_summary import data_interval
from daq.results.vocabulary import FLAG_WORDS, PARTNER_WORDS
from estimator.self_noise.result import Flag
from estimator.wording import clock_time, several
from tui.output.csv_text import csv_text, safe_cell
from tui.output.curves import CURVES
from tui.page.table import Cell, Table
from tui.wording.formatting import is_known, level, level_with_error, utc

if TYPE_CHECKING:
    from daq.estimation.snapshot import Snapshot
    from daq.results.result import Result


def result_title(result: Result) -> Cell:
    """Return the title of the table of results."""
    low, high = result.band
    wanted = high if result.settings.band is None else result.settings.band[1]
    asked = f" ({wanted:.3g} requested)" if wanted > high else ""
    what = "Self-noise" if result.snapshot.results else "PSD of the recorded signals"
    text = f"{what}, mean over {low:.3g} to {high:.3g} Hz"
    more = f"{asked}, dB re 1 ({result.snapshot.unit})²/Hz, with its 95 % interval"
    return Cell(text + more, strong=len(text))


def result_table(result: Result) -> Table:
    """Return the noise of every channel in the band, by each method."""
    snapshot = result.snapshot
    rows = []
    columns = [result.means(method) for method in snapshot.results]
    data, alone = result.data, result.alone
    ends = None if columns else data_interval(result)
    for number, label in enumerate(snapshot.channels):
        power = float(data[number])
        no_signal = FLAG_WORDS[Flag.DEAD_CHANNEL].short
        text = level(power)
        if ends is not None:
            text = level_with_error(power, float(ends[1][number]), float(ends[0][number]))
        row = [label.sensor, label.channel, no_signal if power == 0 else text]
        for means in columns:
            mean = means[number]
            if number in alone:
                row.append(PARTNER_WORDS[alone[number]])
                continue
            row.append(
                level_with_error(float(mean.mean[0]), float(mean.high[0]), float(mean.low[0]))
            )
        rows.append(row)
    names = ("data", *snapshot.results)
    return Table.of(("sensor", "channel", *names), rows, right=names)


def averages_line(snapshot: Snapshot) -> str:
    """Return how many segments an estimate rests on."""
    text = (
        f"{several(snapshot.n_segments, 'segment')} ({snapshot.n_effective:.0f} effective averages)"
        f" from {clock_time(snapshot.elapsed)}"
    )
    if is_known(datetime.fromtimestamp(snapshot.start_utc_ns * 1e-9, tz=UTC)):
        text += f" since {utc(snapshot.start_utc_ns)}"
    if len(snapshot.octaves) > 1:
        text += f" above {snapshot.octaves[-1].low:.3g} Hz"
    return snapshot.caveats.nouns(text)


def curves_csv(snapshot: Snapshot) -> str:
    """Return all curves as CSV: a row per frequency, a group of columns per channel and method."""
    header = ["frequency (Hz)"]
    columns = [snapshot.frequency]
    for number, label in enumerate(snapshot.channels):
        name, unit = label.name, f"(({label.unit})²/Hz)"
        header.append(f"{name} data {unit}")
        columns.append(snapshot.data_psd[:, number])
        for method, noise in snapshot.results.items():
            for each in CURVES:
                header.append(f"{name} {method} {each.word}{f' {unit}' * each.is_density}")
                columns.append(getattr(noise, each.field)[:, number])
    table = np.stack(columns, axis=1).tolist()
    rows = ([None if math.isnan(value) else value for value in row] for row in table)
    return csv_text(map(safe_cell, header), rows)
