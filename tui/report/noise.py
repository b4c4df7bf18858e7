"""The sections about noise: the verdict against the limits, tables and plots."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from daq.bench.masks.mask import SOURCES, Mask
from daq.bench.tables.certificate import CertificateTable, Rule
from daq.bench.units import decibels
from daq.estimation.snapshot import Snapshot
from daq.results.band_summary import BandMeans, known_range
from daq.results.decision.conformity import Conformity, Statement
from daq.results.decision.verdict import TestVerdict
from daq.results.result import Result
from daq.results.vocabulary import FLAG_WORDS, PARTNER_WORDS
from estimator.decision.verdict import Verdict
from estimator.self_noise.result import Flag
from estimator.wording import span
from tui.page.blocks import Paragraph, Part, Section
from tui.page.table import Cell, Table
from tui.report.figures.curves import noise_plots
from tui.wording.formatting import (
    NOT_KNOWN,
    NOTHING,
    level,
    level_with_error,
    plain_number,
    scientific,
)
from tui.wording.verdict_text import TONES, WORDS, Decision, margin

STATEMENTS: Mapping[Statement, str] = {
    Statement.PASS: "pass",
    Statement.CONDITIONAL_PASS: "conditional pass",
    Statement.CONDITIONAL_FAIL: "conditional fail",
    Statement.FAIL: "fail",
    Statement.NOT_STATED: "no statement",
}
MAX_BANDS = 7
"""Columns of the table of noise by octaves that a page is wide."""
WORST_FIRST = (Verdict.FAIL, Verdict.NOT_DECIDED, Verdict.PASS)


def verdict(result: Result) -> Paragraph:
    """Return what it all comes to, in a sentence or two."""
    decision = Decision.of(result)
    if decision is None:
        return Paragraph("No verdict: the bench file has no limits.", "quiet")
    return Paragraph(" ".join([str(decision), *decision.remarks]), TONES[decision.state])


def limits_section(
    snapshot: Snapshot,
    found: TestVerdict | None,
    statements: Sequence[Conformity] = (),
    table: CertificateTable | None = None,
) -> Section | None:
    """Return every channel beside its limits, worst first; None where the bench file has none."""
    if found is None:
        return None
    rows: list[tuple[str, ...]] = []
    # without a certificate of any sensitivity nothing is stated, and no rule matters
    is_stated = any(each.is_traceable for each in statements)
    by_rule = {(each.limit, each.sensor, each.channel): each for each in statements}
    order = list(dict.fromkeys(each.limit for each in found.limits))
    for each in sorted(
        found.limits, key=lambda e: (order.index(e.limit), WORST_FIRST.index(e.verdict))
    ):
        words = WORDS[each.verdict] if each.known else "no estimate"
        rows.append(
            (
                each.name,
                each.limit,
                plain_number(each.frequency, ".3g"),
                level(each.noise_psd, 1),
                level(each.limit_psd, 1),
                margin(each),
                Cell(words, TONES[each.verdict]),
            )
        )
        if by_rule:
            stated = by_rule[each.limit, each.sensor, each.channel]
            rows[-1] += (STATEMENTS[stated.statement],) * is_stated + (_risk(stated.risk),)
    method = next((each.method for each in found.limits), "")
    header: tuple[str, ...] = (
        "channel", "limit", "at (Hz)", "noise (dB)", "limit (dB)", "margin (dB)", "verdict",
    )  # fmt: skip
    if by_rule:
        header += ("conformity", "risk") if is_stated else ("risk",)
    note = (
        f"By the {method} estimate, dB re 1 ({snapshot.unit})²/Hz, in the worst band a third of an "
        "octave wide, or less at notches and steps. PASS: the whole interval of the margin is "
        "above zero in every band; FAIL: below zero in one. Intervals: 95 % for all channels and "
        "bands together, with all that widens them."
        + ("" if is_stated else " Risk: probability of noise above the limit in any band.")
    )
    shown = Table(header, tuple(rows), left=frozenset({0, 1, 6, *([7] if is_stated else [])}))
    parts: list[Part] = [shown, Paragraph(note, "quiet")]
    if by_rule and table is not None:
        parts[1:1] = [
            Paragraph(text)
            for text in (
                decision_rule(table, statements[0].k) if is_stated else "",
                _untraceable(statements),
            )
            if text
        ]
    return Section("Verdict against the limits", tuple(parts))


def _untraceable(statements: Sequence[Conformity]) -> str:
    """Return of which channels nothing is stated, because their sensitivity has no certificate."""
    names = dict.fromkeys(f"{e.sensor}.{e.channel}" for e in statements if not e.is_traceable)
    if not names:
        return ""
    n = len(dict.fromkeys(f"{e.sensor}.{e.channel}" for e in statements))
    who = "any channel" if len(names) == n else ", ".join(names)
    return (
        f"No statement of conformity of {who}: their sensitivity has no certificate in"
        " the bench file, so the result is not traceable to the SI."
    )


def decision_rule(table: CertificateTable, k: float) -> str:
    """Return the decision rule of the statements of conformity, with its source.

    `k` is the coverage factor of U.
    """
    r = table.guard_band
    band = f"the guard band is w = {'' if r == 1 else f'{r:g} '}U below the limit"
    rules = {
        Rule.SIMPLE_ACCEPTANCE: "simple acceptance (ILAC-G8:09/2019, 4.2.1): pass at or below the "
        "limit, fail above",
        Rule.GUARD_BAND_BINARY: f"guard band with two statements (ILAC-G8:09/2019, 4.2.2): {band}; "
        "pass where it is kept, else fail",
        Rule.GUARD_BAND: f"guard band with four statements (ILAC-G8:09/2019, 4.2.3): {band}, and as"
        " far above it for a fail; between, the statement is conditional",
    }
    return (
        f"Decision rule: {rules[table.decision_rule]}. U is the distance in dB from the noise to "
        f"the end of its interval, with the coverage factor k = {k:.2f} of a normal distribution: "
        "95 % for all channels, limits and bands together. Risk: probability that the noise of the "
        "channel is above the limit in any band, by the distribution of the levels (specific risk, "
        "JCGM 106:2012, 9.3.2)."
    )


def _risk(risk: float) -> str:
    if not math.isfinite(risk):
        return NOTHING
    if risk < 1e-4:
        return "< 0.01 %"
    return "> 99.99 %" if risk > 0.9999 else f"{100 * risk:.2g} %"


def noise_section(result: Result, models: Sequence[Mask] = ()) -> Section:
    """Return tables and plots of the noise of every channel."""
    snapshot = result.snapshot
    if not snapshot.results:
        return Section("Self-noise", (Paragraph("Nothing can be said yet.", "doubtful"),))
    parts: list[Part] = [
        _band_table(result),
        *noise_plots(result, models),
        Paragraph(
            "The 95 % interval is that of the mean over the band, with all that widens it (see "
            "the facts, from 1 % of the noise on), sensitivities included. SNR: power of the "
            "motion over that of the noise. Curves: one-sided power spectral density in dB re 1 "
            f"({snapshot.unit})²/Hz (left) and its root in ({snapshot.unit})/√Hz (right). Each "
            "point is a mean over its share of the axis. Dotted: the band of the table. Where the "
            "interval reaches the bottom, the noise is known only to be below its upper end. "
            "Shaded: nothing can be said." + _about_models(models),
            "quiet",
        ),
    ]
    if len(snapshot.results) > 1:
        parts.append(_methods_table(result))
    octaves = _octave_table(result)
    if octaves is not None:
        parts.append(octaves)
    return Section("Self-noise", tuple(parts))


def _about_models(models: Sequence[Mask]) -> str:
    """Return what noise models are shown, and from where they are."""
    found = [f"{each.name}: {SOURCES.get(each.name, 'mask from a file')}" for each in models]
    return f" Noise models: {'; '.join(found)}." if found else ""


def _band_table(result: Result) -> Table:
    snapshot, band = result.snapshot, result.band
    method = next(iter(snapshot.results))
    means, data, alone = result.means(method), result.data, result.alone
    covs = result.covs_of(method)
    no_signal = FLAG_WORDS[Flag.DEAD_CHANNEL].short
    rows = []
    for number, label in enumerate(snapshot.channels):
        name, recorded = f"{label.sensor}.{label.channel}", level(float(data[number]), 1)
        if number in alone:
            rows.append((name, recorded, PARTNER_WORDS[alone[number]], *["?"] * 5))
            continue
        mean = _only(means[number])
        rows.append(
            (
                f"{label.sensor}.{label.channel}",
                level(float(data[number]), 1) if data[number] > 0 else no_signal,
                "withdrawn" if mean[0] > mean[2] else level(mean[0]),
                _interval(mean[1], mean[2]),
                scientific(math.sqrt(mean[0])) if 0 < mean[0] <= mean[2] else NOTHING,
                plain_number(covs[number], ".3f"),
                plain_number(mean[3], ".3f"),
                _snr(float(data[number]), mean[0]),
            )
        )
    header = (
        "channel", "recorded (dB)", "self-noise (dB)", "95 % interval (dB)",
        f"({snapshot.unit})/√Hz", "c.o.v., worst ⅓ octave", "c.o.v., mean", "SNR (dB)",
    )  # fmt: skip
    title = f"Mean over {span(*band)} by the {method} method, dB re 1 ({snapshot.unit})²/Hz"
    return Table(header, tuple(rows), title=title)


def _only(means: BandMeans) -> tuple[float, float, float, float]:
    """Return mean, ends of the interval and c.o.v. of the one band there is."""
    mean, spread = float(means.mean[0]), float(means.spread[0])
    cov = spread / abs(mean) if mean else math.nan
    return mean, float(means.low[0]), float(means.high[0]), cov


def _interval(low: float, high: float) -> str:
    if math.isinf(high):
        return NOT_KNOWN
    if not high > 0:
        return "below 0" if high <= 0 else NOTHING
    return f"{level(low)} … {level(high)}" if low > 0 else f"below {level(high)}"


def _snr(data: float, noise: float) -> str:
    if not noise > 0:
        return NOTHING
    return plain_number(decibels(data - noise) - decibels(noise), ".1f") if data > noise else "< 0"


def _octave_table(result: Result) -> Table | None:
    """Return the mean noise in bands of an octave or more, by the first method."""
    snapshot = result.snapshot
    bands = list(_octaves(known_range(snapshot)[0], float(snapshot.frequency[-2])))
    if len(bands) < 2:
        return None
    method = next(iter(snapshot.results))
    columns = [result.means(method, band) for band in bands]
    rows = []
    for number, label in enumerate(snapshot.channels):
        row = [f"{label.sensor}.{label.channel}"]
        for means in columns:
            mean, low, high, _ = _only(means[number])
            row.append(level_with_error(mean, high, low))
        rows.append(tuple(row))
    header = ("channel", *(span(*band) for band in bands))
    title = f"Mean in wide bands with 95 % interval, dB re 1 ({snapshot.unit})²/Hz"
    return Table(header, tuple(rows), title=title)


def _octaves(low: float, high: float) -> Iterator[tuple[float, float]]:
    """Yield bands of 1, 2, 3 … octaves, as few octaves as the columns allow; of whole powers."""
    first, last = math.ceil(math.log2(low) - 1e-9), math.floor(math.log2(high) + 1e-9)
    if last <= first:
        return
    step = -(-(last - first) // MAX_BANDS)
    for exponent in range(first, last, step):
        yield 2.0**exponent, 2.0 ** min(exponent + step, last)


def _in_the_band(means: BandMeans) -> str:
    mean, low, high, _ = _only(means)
    return level_with_error(mean, high, low)


def _methods_table(result: Result) -> Table:
    snapshot, band = result.snapshot, result.band
    columns = [result.means(method) for method in snapshot.results]
    rows = tuple(
        (
            f"{label.sensor}.{label.channel}",
            *(_in_the_band(means[number]) for means in columns),
        )
        for number, label in enumerate(snapshot.channels)
    )
    title = f"Mean over {span(*band)} by every method, dB re 1 ({snapshot.unit})²/Hz"
    return Table(("channel", *snapshot.results), rows, title=title)
