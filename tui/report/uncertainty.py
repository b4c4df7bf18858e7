"""The uncertainty in the report: level, contributions, total; noise in the units of the trade."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.units import in_acceleration
from daq.results.band_summary import without_sensitivity
from daq.results.uncertainty_budget import STATED, Budget, band_budgets
from daq.results.vocabulary import SOURCE_WORDS
from estimator.levels.contributions import Source
from estimator.wording import span
from tui.page import drawing
from tui.page.blocks import Paragraph, Part, Plot, Section, three_to_a_row
from tui.page.table import Table
from tui.page.ticks import even_ticks
from tui.report.figures.curves import logarithmic
from tui.report.noise import band_tables
from tui.wording.formatting import NOTHING, level, plain_number, scientific

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daq.bench.model import Bench
    from daq.estimation.snapshot import Snapshot
    from daq.results.result import Result
    from estimator.types import FloatArray
    from tui.page.axes import Axes

COLUMNS, MOST_LETTERS = 9, 108
"""Channels that one table is wide, and letters of their names."""
LEAST_SHARE = 1e-3
"""Of the level, from which a contribution has a row."""
_NAMES = {"estimate": "finite averages"}
_DISTRIBUTIONS = {"chi-squared": "chi-squared (skewed)"}
LEAST_BINS = 3
"""Frequencies from which a half octave has a row."""
HALF = 2**0.25
"""From the centre of a half octave to its end."""


def uncertainty_section(result: Result, about: Bench | None) -> Section | None:
    """Return level, contributions, total, and the noise in half octaves; None without a result."""
    found = band_budgets(result)
    if not found:
        return None
    snapshot = result.snapshot
    names = [label.name for label in snapshot.channels]
    in_g, in_si = (_ratio(snapshot.unit, unit) for unit in ("g", "m/s²"))
    if snapshot.unit == "m/s²":
        in_si = None
    budget = tuple(
        (
            name, _NAMES.get(row.source) or SOURCE_WORDS[Source(row.source)],
            _DISTRIBUTIONS.get(row.distribution, row.distribution),
            *(_percent(end) for end in row.reach), _percent(row.relative, ".2f"),
            "∞" if row.dof >= STATED else plain_number(row.dof, ".0f"),
        )
        for name, each in zip(names, found, strict=True)
        for row in each.components
        if row.source in _NAMES or row.relative > LEAST_SHARE
    )  # fmt: skip
    dof = [d for each in found if math.isfinite(d := each.components[0].dof)]
    only = Paragraph(
        "Uncertainty budget (JCGM 100 and 101): finite averages alone, chi-squared (skewed), with"
        f" {min(dof, default=0):.0f} to {max(dof, default=0):.0f} degrees of freedom; no other"
        f" contribution reaches {100 * LEAST_SHARE:g} % of the level.",
    )
    is_only = bool(dof) and len(budget) == len(found)
    header = (
        "channel", "worst c.o.v.", *["statistical (dB)"] * (not is_only), "total (dB)",
        "u", "k", "U", *["µg/√Hz"] * bool(in_g), *["dB re 1 (m/s²)²/Hz"] * bool(in_si),
    )  # fmt: skip
    rows = tuple(
        (
            name,
            plain_number(cov, ".3f"),
            *([] if is_only else [_ends(_statistical(each))]),
            _ends(each.interval),
            _percent(each.combined, ".2f"),
            plain_number(each.k, ".2f"),
            _percent(each.k * each.combined, ".2f"),
            *([_root(each.value, 1e6 * in_g)] if in_g else []),
            *([level(each.value * in_si**2)] if in_si else []),
        )
        for name, each, cov in zip(names, found, result.covs_of(result.method), strict=True)
    )
    statistical = "" if is_only else "Statistical: by the scatter of the averages. "
    parts: list[Part] = [
        *band_tables(result),
        Table(header, rows, title=f"Uncertainty of the mean over {span(*result.band)}"),
        Paragraph(
            f"Intervals at 95 %. {statistical}Total: by all of the budget, sensitivities "
            "included. Worst c.o.v.: of thirds of an octave. u: combined standard uncertainty of "
            "the PSD. U: half the width of the total interval. k = U / u. Report, JSON and "
            "DCC state this U." + _not_stated(snapshot),
            "quiet",
        ),
        only
        if is_only
        else Table(
            (
                "channel", "contribution", "distribution", "−", "+", "standard uncertainty",
                "degrees of freedom",
            ),
            budget,
            left=frozenset({0, 1, 2}),
            title="Uncertainty budget (JCGM 100 and 101): what each contribution alone moves the "
            "ends, and its standard uncertainty, of the level",
        ),
    ]  # fmt: skip
    parts += _half_octaves(result, about, names)
    return Section("Uncertainty, and noise in bands", tuple(parts))


def half_octaves(frequency: FloatArray) -> tuple[FloatArray, list[NDArray[np.int64]]]:
    """Return centres of whole half octaves within a spectrum, and the bins of each."""
    first, last = float(frequency[1]), 0.9 * float(frequency[-1])
    low = math.ceil(2 * math.log2(first * HALF) - 1e-9)
    high = math.floor(2 * math.log2(last / HALF) + 1e-9)
    centres, bins = [], []
    for half in range(low, high + 1):
        centre = 2.0 ** (half / 2)
        edges = np.searchsorted(frequency, [centre / HALF, centre * HALF])
        if edges[1] - edges[0] >= LEAST_BINS:
            centres.append(centre)
            bins.append(edges.astype(np.int64))
    return np.array(centres), bins


def _half_octaves(result: Result, about: Bench | None, names: Sequence[str]) -> list[Part]:
    """Return tables of the rms in half octaves, and of the range up to clipping where known."""
    snapshot = result.snapshot
    spectrum = result.spectrum(result.method)
    centres, bins = half_octaves(snapshot.frequency)
    if not len(centres):
        return []
    means = np.stack([spectrum.levels(edges).mean[0] for edges in bins])
    width = centres * (HALF - 1 / HALF)
    with np.errstate(invalid="ignore"):
        rms = np.sqrt(np.where(means > 0, means, np.nan) * width[:, None])
    full = np.array([_full_scale(snapshot, column, about) for column in range(len(names))])
    parts: list[Part] = []
    if np.isfinite(full).any():
        parts += _diagrams(snapshot, centres, rms, full)
    most = max(1, min(COLUMNS, int(MOST_LETTERS / max(map(len, names)))))
    n_tables = math.ceil(len(names) / most)
    with np.errstate(invalid="ignore", divide="ignore"):
        reach = 20 * np.log10(full / math.sqrt(2) / rms)
    of_noise = f"Self-noise in half octaves, rms in {snapshot.unit}"
    of_range = (
        "Operating range in half octaves: from the noise to a sine of full scale, rms over rms, in"
        " dB"
    )
    for columns in np.array_split(np.arange(len(names)), n_tables):
        some = slice(int(columns[0]), int(columns[-1]) + 1)
        shown = [(rms, lambda value: scientific(value, 3), of_noise)]
        if np.isfinite(full[some]).any():
            shown.append((reach, lambda value: plain_number(value, ".1f"), of_range))
        for values, show, title in shown:
            rows = (
                (f"{centre:.3g}", *map(show, row[some]))
                for centre, row in zip(centres, values, strict=True)
            )
            parts.append(Table(("Hz", *names[some]), tuple(rows), title=title))
    parts.append(
        Paragraph(
            "Half octaves about powers of √2, as strong-motion users state noise and range: rms of "
            "the noise in each, below the rms of a sine of full scale (Evans and others, 2010, "
            "Seismol. Res. Lett. 81(4); erratum 2012, 83(3)). Full scale as of the data sheet in "
            "the bench file; without it no range is given.",
            "quiet",
        )
    )
    return parts


def _draw_range(
    names: Sequence[str],
    centres: FloatArray,
    levels_db: tuple[FloatArray, FloatArray],
    scale: tuple[float, float],
    axes: Axes,
    *,
    sensor: str,
    unit: str,
) -> None:
    """Draw the rms in half octaves of one sensor's channels, up to a sine of full scale."""
    rms_db, full_db = levels_db
    logarithmic(axes, (float(centres[0]) / HALF, float(centres[-1]) * HALF))
    ends = np.append(centres / HALF, centres[-1] * HALF)
    draw, steps = partial(axes.plot, lw=1.0), np.repeat(ends, 2)[1:-1]
    for number, (name, values) in enumerate(zip(names, rms_db.T, strict=True)):
        colour, dashes = drawing.style_of(number)
        draw(steps, np.repeat(values, 2), color=colour, dashes=dashes, label=name)
    clips = full_db[np.isfinite(full_db)]
    if clips.size:
        level, label = np.full(2, clips.min()), "sine of full scale"
        dashes = (6.4, 1.6, 1, 1.6)  # told apart from dashed channels in grey, too
        draw(ends[[0, -1]], level, color=drawing.LIMIT, dashes=dashes, label=label)
    axes.set(title=f"Sensor {sensor}", ylim=scale, ylabel=f"dB re 1 {unit} rms")
    levels = even_ticks(*scale, 6)
    axes.yaxis.set_ticks(levels, [f"{each:.0f}".replace("-", "−") for each in levels])


def _diagrams(
    snapshot: Snapshot, centres: FloatArray, rms: FloatArray, full: FloatArray
) -> list[Plot]:
    """Return the operating range of every sensor, up to three side by side."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rms_db, full_db = 20 * np.log10(rms), 20 * np.log10(full / math.sqrt(2))
    known = np.concatenate([rms_db[np.isfinite(rms_db)], full_db[np.isfinite(full_db)]])
    if not known.size:
        return []
    scale = 20 * math.floor(known.min() / 20), 20 * math.ceil((known.max() + 1) / 20)
    panels = []
    for sensor in snapshot.sensor_names:
        own = [n for n, label in enumerate(snapshot.channels) if label.sensor == sensor]
        names = tuple(snapshot.channels[n].channel for n in own)
        levels = rms_db[:, own], full_db[own]
        draw = partial(_draw_range, names, centres, levels, scale)
        panels.append(partial(draw, sensor=sensor, unit=snapshot.unit))
    alt = "Noise in half octaves against frequency, below a sine of full scale"
    return three_to_a_row(panels, "Operating range in half octaves", height=1.6, alt=alt)


def _full_scale(snapshot: Snapshot, column: int, about: Bench | None) -> float:
    """Return the full scale of a channel in the unit of the spectrum; NaN where not known."""
    label = snapshot.channels[column]
    for sensor in () if about is None else about.sensors:
        sheet = sensor.data_sheet
        if sensor.name != label.sensor or sheet is None or sheet.full_scale is None:
            continue
        if sheet.channels and label.channel not in sheet.channels:
            continue
        own = next((c.unit for c in sensor.channels if c.name == label.channel), "")
        unit = sheet.unit or own
        if unit == snapshot.unit:
            return sheet.full_scale
        wanted, given = in_acceleration(snapshot.unit), in_acceleration(unit)
        if wanted and given:
            return sheet.full_scale * given / wanted
    return math.nan


def _ratio(unit: str, wanted: str) -> float | None:
    """Return one of a unit of acceleration in the wanted one; None of others."""
    size, one = in_acceleration(unit), in_acceleration(wanted)
    return size / one if size and one else None


def _root(psd: float, factor: float) -> str:
    return scientific(factor * math.sqrt(psd)) if psd > 0 else NOTHING


def _statistical(found: Budget) -> tuple[float, float]:
    """Return the interval by the scatter of the averages alone."""
    below, above = found.components[0].reach
    return found.value + below * abs(found.value), found.value + above * abs(found.value)


def _not_stated(snapshot: Snapshot) -> str:
    """Return whose sensitivities are taken as exact, because nothing is stated of them."""
    found = without_sensitivity(snapshot)
    is_all = len(found) == len(snapshot.channels)
    names = "all channels" if is_all else ", ".join(each.name for each in found)
    return (
        f" Without certificate or tolerance, and taken as exact: sensitivities of {names}."
        if found
        else ""
    )


def _ends(ends: tuple[float, float]) -> str:
    low, high = ends
    if not math.isfinite(high):
        return "not known"
    return f"{level(low)} … {level(high)}" if low > 0 else f"below {level(high)}"


def _percent(value: float, form: str = "+.2f") -> str:
    return f"{plain_number(100 * value, form)} %" if math.isfinite(value) else NOTHING
