"""Noise parameters of every channel as tables, as sentences, and as JSON values."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daq.results.noise_parameters import (
    QUANTISATION_SHARE,
    ChannelParameters,
    SheetComparison,
    SheetOutcome,
    SheetQuantity,
)
from estimator.noise_parameters.fit import Term
from estimator.wording import percent, span
from tui.output.json_values import label_document
from tui.page.table import Table
from tui.wording.formatting import level, scientific

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.estimation.snapshot import ChannelLabel
    from estimator.noise_parameters.allan import AllanDeviation
    from tui.output.documents import ChannelNoiseDocument

MISFIT = 5.0
"""Standard errors from which on it is said that the terms do not describe the noise."""
SIGNIFICANT = 2.0
"""Standard errors from which on a term counts as seen."""
COLUMNS = {
    Term.RANDOM_WALK: "random walk",
    Term.FLICKER: "flicker",
    Term.WHITE: "white",
    Term.F_SQUARED: "f²",
}
OUTCOMES = {
    SheetOutcome.MEETS: "meets it",
    SheetOutcome.FALLS_SHORT: "falls short",
    SheetOutcome.NOT_DECIDED: "not decided",
    SheetOutcome.UNKNOWN: "no estimate",
}
MAX_TIMES = 5
"""Averaging times in the table of Allan deviations: what a terminal is wide."""


def term_table(found: Sequence[ChannelParameters]) -> Table:
    """Return each term's PSD at 1 Hz in dB, with its standard error."""
    header = ("channel", *COLUMNS.values(), "quantisation")
    rows = []
    for each in found:
        cells = ["–"] * len(COLUMNS)
        if each.parameters is not None:
            pairs = zip(each.parameters.values, each.parameters.errors, strict=True)
            cells = [_term(float(value), float(error)) for value, error in pairs]
        quantisation = "–" if math.isnan(each.quantisation_psd) else level(each.quantisation_psd)
        rows.append((each.label.name, *cells, quantisation))
    return Table.of(header, rows, right=header[1:])


def _term(value: float, error: float) -> str:
    if not math.isfinite(error):
        return "?"
    if value > SIGNIFICANT * error:
        return f"{level(value)} ±{10 / math.log(10) * error / value:.2f}"
    return f"< {level(max(value, 0.0) + SIGNIFICANT * error)}"


def allan_table(found: Sequence[ChannelParameters]) -> Table:
    """Return the Allan deviation and its 95 % interval, by averaging time."""
    known = [each for each in found if each.allan is not None and len(each.allan.tau)]
    if not known or known[0].allan is None:
        return Table((), ())
    tau = known[0].allan.tau
    shown = tau[np.unique(np.linspace(0, len(tau) - 1, min(MAX_TIMES, len(tau))).astype(int))]
    rows = []
    for each in known:
        times = [] if each.allan is None else each.allan.tau.tolist()
        cells = [
            _allan(each.allan, times.index(time)) if each.allan and time in times else "–"
            for time in shown
        ]
        rows.append((each.label.name, *cells))
    times = [f"{time:g} s" for time in shown]
    return Table.of(("channel", *times), rows, right=times)


def _allan(found: AllanDeviation, at: int) -> str:
    value, low, high = (float(each[at]) for each in (found.deviation, found.low, found.high))
    if not low > 0:
        return f"< {scientific(high, 2)}"
    return f"{scientific(value)} ±{percent((high - low) / 2 / value)}"


def sheet_table(found: Sequence[ChannelParameters]) -> Table:
    """Return every value of a data sheet beside the measured one."""
    header = ("channel", "quantity", "at", "data sheet", "measured", "95 % interval", "")
    rows = [
        (
            each.label.name,
            f"{one.quantity.replace('-', ' ')}, {one.unit}",
            _where(one),
            f"{one.stated:.4g}",
            _number(one.measured),
            f"{_number(one.low)} … {_number(one.high)}",
            OUTCOMES[one.outcome],
        )
        for each in found
        for one in each.comparisons
    ]
    return Table.of(header, rows, right=header[2:6])


def _where(one: SheetComparison) -> str:
    if one.quantity is SheetQuantity.NOISE_DENSITY:
        return f"{math.sqrt(one.low_hz * one.high_hz):.3g} Hz"
    return span(one.low_hz, one.high_hz)


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.4g}"


def notes(found: Sequence[ChannelParameters]) -> list[str]:
    """Return what must be said beside the tables."""
    lines = [
        f"{each.label.name}: no noise parameters: {each.refused}"
        for each in found
        if each.parameters is None
    ]
    known = [(each.label.name, each.parameters) for each in found if each.parameters is not None]
    misfits = [
        f"{name} ({percent(abs(fitted.worst_ratio - 1))} "
        f"{'above' if fitted.worst_ratio > 1 else 'below'} them at "
        f"{span(fitted.worst_low, fitted.worst_high)})"
        for name, fitted in known
        if abs(fitted.worst_score) > MISFIT
    ]
    if misfits:
        lines.append(f"These terms do not describe all of the noise of {', '.join(misfits)}.")
    excluded = [f"{name} {fitted.n_lines}" for name, fitted in known if fitted.n_lines]
    if excluded:
        lines.append(f"Frequencies left out as lines: {', '.join(excluded)}.")
    return lines


def quantisation_notes(
    channels: Sequence[ChannelLabel], shares: Sequence[tuple[float, float]]
) -> list[str]:
    """Return which channels' noise is mostly that of rounding to counts or digits."""
    mostly = [
        f"{label.name} ({percent(min(share, 1.0))})"
        for label, (_, share) in zip(channels, shares, strict=True)
        if share > QUANTISATION_SHARE
    ]
    if not mostly:
        return []
    line = (
        f"Quantisation: most of the noise of {', '.join(mostly)} comes from the size of a count or "
        "digit. Use a smaller range, more gain or digits to measure the noise of the sensor."
    )
    return [line]


def noise_parameters_document(
    found: Sequence[ChannelParameters],
) -> list[ChannelNoiseDocument]:
    """Return the noise parameters of every channel as JSON values."""
    return [
        {
            **label_document(each.label),
            "terms": None
            if each.parameters is None
            else {
                term.value: {
                    "value": each.parameters.value(term),
                    "error": each.parameters.error(term),
                }
                for term in Term
            },
            "covariance": None if each.parameters is None else each.parameters.covariance,
            "fit": each.parameters,
            "refused": each.refused or None,
            "allan_deviation": each.allan,
            "quantisation_psd": each.quantisation_psd,
            "quantisation_share": each.quantisation_share,
            "data_sheet": each.comparisons,
        }
        for each in found
    ]
