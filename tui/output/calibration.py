"""Calibration results as tables and remarks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from daq.bench.units import decibels
from daq.clocks.clock_model import RelativeTime
from daq.results.clock_effect import relative_time
from daq.results.uncertainty_budget import Budget, student_quantile
from estimator.wording import listed, signed, span
from tui.page.table import Table
from tui.wording.formatting import plain_number

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from daq.estimation.snapshot import Snapshot
    from daq.results.calibration import Calibration
    from estimator.responses.derived_quantities import Value

_LEAST_SHOWN = 1e-5
_ALIGNED = 3.0
"""Standard errors from 0 and 180° from which on an angle is shown with its error."""
_ROUNDING = 1e-6
_SOURCES = {
    "estimate": ("est.", "finite averages"),
    "variation": (
        "var.",
        "scatter over the frequencies beyond that, by incoherence or by responses that vary",
    ),
    "clocks": ("clocks", "error of the alignment of the clocks"),
    "leakage": ("leak.", "leakage by the width and the edges of segments"),
    "quantisation": ("quant.", "quantisation"),
    "certificate": ("cert.", "certificate of the reference"),
    "tolerance": ("tol.", "tolerance of the reference, without a certificate"),
    "temperature": ("temp.", "temperature"),
    "sensitivity": ("sens.", "twice the uncertainty of the sensitivity"),
    "edges": ("edges", "leakage at the edges of segments"),
    "gaps": ("gaps", "leakage by gaps"),
    "misfit": ("misfit", "power that the model does not explain"),
    "shared-noise": ("shared", "noise that channels share"),
    "dimensions": ("dim.", "doubtful number of dimensions of the motion"),
    "axes": ("axes", "motion outside the sensors' axes"),
    "faulty": ("faulty", "a faulty channel"),
    "drift": ("drift", "change of the response, or standstill, during the recording"),
    "changes": ("changes", "motion that a change of the response leaves in the noise"),
    "linearity": ("lin.", "what is not linear, found or not, and noise that follows the motion"),
}
"""Short and in words."""


def legend(budgets: Iterable[Budget]) -> str:
    """Return what the short words of tables of calibration mean, of budgets those there are."""
    there = {part.source for budget in budgets for part in budget.components}
    words = [f"{short}: {text}." for source, (short, text) in _SOURCES.items() if source in there]
    return (
        "Budgets are relative standard uncertainties. A: from the scatter of these data; B: from "
        f"other sources. {' '.join(words)} u: combined standard uncertainty. U: expanded "
        "uncertainty, k u. 1–2: angle between the first and the second channel, less 90°."
    )


def with_error(value: float, expanded: float) -> str:
    """Return a number with its expanded uncertainty, both to the same place."""
    if not math.isfinite(value):
        return "?"
    if not math.isfinite(expanded):
        return f"{signed(value, '.6g')} ± ?"
    if expanded <= 0:
        return signed(value, ".6g")
    place = 1 - math.floor(math.log10(expanded))  # of the second digit
    if place <= 0:  # integers, rounded to the digits that mean something
        step, place = 10.0**place, 0
        value, expanded = round(value * step) / step, math.ceil(expanded * step) / step
    return f"{signed(value, f'.{place}f')} ± {expanded:.{place}f}"


def angle(degrees: float, error: float, k: float) -> str:
    """Return an angle with its expanded uncertainty, or its limit where it may be 0 or 180°.

    An angle is a length: near its ends errors of first order do not hold.
    """
    if math.isnan(degrees):
        return "–"
    off = min(degrees, 180.0 - degrees)
    if off >= _ALIGNED * error or not math.isfinite(error):
        return with_error(degrees, k * error)
    limit = off + k * error
    if limit >= 180.0:
        return "?"
    place = max(0, 1 - math.floor(math.log10(limit))) if limit > 0 else 0
    limit = math.ceil(limit * 10**place - _ROUNDING) / 10**place
    return f"< {limit:.{place}f}" if degrees < 90.0 else f"> {180.0 - limit:.{place}f}"


def share(relative: float) -> str:
    """Return a relative uncertainty in per cent, to two digits; ∞ where there is no limit."""
    if not math.isfinite(relative):
        return "∞" if relative > 0 else "?"
    if relative < _LEAST_SHOWN:
        return "< 0.001 %" if relative > 0 else "0"
    rounded = float(f"{100 * relative:.2g}")
    return f"{rounded:.0f} %" if rounded >= 10 else f"{rounded:g} %"


def title(found: Calibration, snapshot: Snapshot) -> str:
    """Return what was calibrated against what."""
    name = snapshot.sensor_names[found.reference]
    first = found.sensors[0]
    basis = "absolute, by its certificate" if found.certificates else "relative to it"
    return f"Calibration against {name} ({basis}), {span(first.low, first.high)}"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    return Table.of(header, rows, right={*header} - {"sensor", "channel"})


def sensitivity_table(found: Calibration, snapshot: Snapshot) -> Table:
    """Return sensitivities, delays and skews of all channels."""
    k = _k(found)
    header = ("sensor", "channel", "sensitivity", "k", "delay (µs)", "skew (µs)", "angle (°)")
    rows = []
    budgets = {(each.sensor, each.channel): each for each in found.whole_band("sensitivity")}
    for each in found.sensors:
        name, turn = snapshot.sensor_names[each.sensor], each.angle_deg
        for number, channel in enumerate(channels_of(snapshot, each.sensor)):
            budget = budgets[name, channel]
            value = with_error(budget.value, budget.expanded)
            delay = _element(each.delay, number, k, 1e6)
            skew = _element(each.skew, number, k, 1e6) if number else "0"
            turned = angle(float(turn.value[number]), float(turn.error[number]), k)
            value += " counts/unit" * budget.is_absolute
            rows.append((name, channel, value, f"{budget.k:.2f}", delay, skew, turned))
    return _table(header, rows)


def angle_table(found: Calibration, snapshot: Snapshot) -> Table:
    """Return rotations and deviations from right angles."""
    k = _k(found)
    reference = channels_of(snapshot, found.reference)
    most = max(each.rotation_deg.value.size for each in found.sensors)
    if most == 3:
        about = tuple(f"about {channel} (°)" for channel in reference)
    else:
        about = (f"{' to '.join(reference)} (°)",) * bool(most)
    pairs = max((each.orthogonality_deg.value.size for each in found.sensors), default=0)
    which = ("12", "13", "23")[:pairs]
    header = ("sensor", *about, *(f"{pair[0]}–{pair[1]} (°)" for pair in which))
    rows = [
        (
            snapshot.sensor_names[each.sensor],
            *(_element(each.rotation_deg, n, k) for n in range(most)),
            *(_element(each.orthogonality_deg, n, k) for n in range(pairs)),
        )
        for each in found.sensors
    ]
    return _table(header, rows if most or pairs else ())


def matrix_table(found: Calibration, snapshot: Snapshot) -> Table:
    """Return the relative response of every channel, cross-axis included."""
    k = _k(found)
    reference = channels_of(snapshot, found.reference)
    name = snapshot.sensor_names[found.reference]
    rows = [
        (
            snapshot.sensor_names[each.sensor],
            channel,
            *(
                with_error(float(value), k * float(error))
                for value, error in zip(each.matrix.value[row], each.matrix.error[row], strict=True)
            ),
        )
        for each in found.sensors
        for row, channel in enumerate(channels_of(snapshot, each.sensor))
    ]
    return _table(("sensor", "channel", *(f"to {name}.{each}" for each in reference)), rows)


def budget_table(budgets: Sequence[Budget]) -> Table:
    """Return budgets as a table: a row for each channel, a column for each source."""
    sources = list(dict.fromkeys(each.source for budget in budgets for each in budget.components))
    types = {each.source: each.kind for budget in budgets for each in budget.components}
    names = (f"{_SOURCES.get(source, (source,))[0]} ({types[source]})" for source in sources)
    header = ("sensor", "channel", *names, "u", "k", "U")
    rows = []
    for budget in budgets:
        shares = {each.source: share(each.relative) for each in budget.components}
        totals = (
            share(budget.combined),
            plain_number(budget.k, ".2f"),
            share(math.inf if math.isinf(budget.combined) else budget.k * budget.combined),
        )
        parts = (shares.get(source, "") for source in sources)
        rows.append((budget.sensor, budget.channel, *parts, *totals))
    return _table(header, rows)


def noise_table(found: Calibration, unit: str) -> Table:
    """Return the noise of every channel with its expanded uncertainty."""
    rows = []
    for each in found.whole_band("noise"):
        low, high = each.interval
        level = decibels(each.value)
        down = f"−{level - decibels(low):.2f}" if low > 0 else "−∞"
        interval = f"+{decibels(high) - level:.2f} {down}"
        rows.append((each.sensor, each.channel, signed(level, ".2f"), interval))
    header = ("sensor", "channel", f"noise (dB re 1 ({unit})²/Hz)", "expanded (dB)")
    return _table(header, rows)


def remarks(found: Calibration, snapshot: Snapshot) -> list[str]:
    """Return what there is to know about a calibration."""
    name = snapshot.sensor_names[found.reference]
    level = (
        f"Expanded uncertainties at a level of {100 * found.confidence:g} %, coverage factor k by "
        "the effective degrees of freedom. Angles, delays and cross-axis values have k = "
        f"{_k(found):.2f}; an angle within {_ALIGNED:g} standard errors of 0 or "
        "180° has a limit."
    )
    lines = [level]
    if found.certificates:
        dates = {each.date.isoformat() for each in found.certificates if each.date is not None}
        lines.append(
            f"Sensitivities rest on the certificate of {name}"
            + (f" of {', '.join(sorted(dates))}." if dates else ", whose date is not given.")
        )
    else:
        lines.append(
            f"No certificate of {name} in the bench file: sensitivities are those of the bench file"
            f" times the values shown, if those of {name} are right."
        )
    if found.whole_band("noise"):
        lines.append(
            "Noise is in terms of the sensitivities calibrated here, not of those of the bench "
            "file: other tables and curves of noise differ by the squares of their ratios."
        )
    if found.without_noise:
        channels = ", ".join(label.name for label in found.without_noise)
        lines.append(
            f"Mean noise of {channels}: not positive, and not shown. It is too small against the "
            "motion or the noise of the other sensors."
        )
    if any(each.gain.value.size == 1 for each in found.sensors):
        lines.append(
            "Sensors of one channel: where the motion has more than one direction, sensitivities "
            "include the cosines of their tilts. Angles cannot be measured."
        )
    lines.append(
        "Noise that a sensor or the reference shares with a third one biases the sensitivity by "
        "its share of the motion; with three sensors it cannot be seen."
    )
    if found.untested:
        lines.append(
            f"{listed(found.untested)}: too few segments tell whether they are linear, and "
            "uncertainties do not include that they may not be. Record longer, or choose shorter "
            "segments."
        )
    lines += _times(found, snapshot)
    lines += [
        f"{snapshot.sensor_names[each.sensor]}: the cycle of its delay is ambiguous in so "
        "narrow a band of motion. The delay is not shown; the relative response may have the "
        "opposite sign, and angles may be off by 180°."
        for each in found.sensors
        if each.is_ambiguous
    ]
    lines += [
        f"{snapshot.sensor_names[each.sensor]}: its response varies over the band by "
        f"{each.excess:.2g} times the errors, or not all motion is common. Values are means over "
        "the band weighted by SNR, and uncertainties those at each frequency."
        for each in found.sensors
        if each.varies
    ]
    return lines + [
        f"{snapshot.sensor_names[sensor]} is not calibrated: {why}"
        for sensor, why in found.refused.items()
    ]


def _times(found: Calibration, snapshot: Snapshot) -> list[str]:
    """Return which delays are not known, or not wholly."""
    names = snapshot.sensor_names
    by_time: dict[RelativeTime, list[str]] = {}
    for each in found.sensors:
        time = relative_time(snapshot, names[each.sensor], names[found.reference])
        by_time.setdefault(time, []).append(names[each.sensor])
    which = {time: ", ".join(sensors) for time, sensors in by_time.items()}
    lines = []
    if RelativeTime.ALIGNED in which:
        lines.append(
            f"Delay of {which[RelativeTime.ALIGNED]}: not known. The clocks are aligned by arrival "
            "times or by the motion, so a delay of the sensor looks like a late clock. Give the "
            "sensors one clock, or UTC, to measure it. Skews are between channels of a sensor, and "
            "do not depend on this."
        )
    if RelativeTime.WHOLE_SAMPLES in which:
        lines.append(
            f"Delay of {which[RelativeTime.WHOLE_SAMPLES]}: known up to whole samples. How many "
            "samples the sensors are apart follows from arrival times or from the motion."
        )
    return lines


def _k(found: Calibration) -> float:
    dof = min(each.dof for each in found.sensors)
    return student_quantile(0.5 + found.confidence / 2, dof)


def _element(value: Value, number: int, k: float, scale: float = 1.0) -> str:
    if number >= value.value.size:
        return ""
    return with_error(
        scale * float(value.value.ravel()[number]),
        scale * k * float(value.error.ravel()[number]),
    )


def channels_of(snapshot: Snapshot, sensor: int) -> list[str]:
    """Return the names of a sensor's channels."""
    name = snapshot.sensor_names[sensor]
    return [label.channel for label in snapshot.channels if label.sensor == name]
