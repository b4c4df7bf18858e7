"""The sections about noise: the verdict against the limits, tables and plots."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from daq.bench.masks.mask import SOURCES, Mask
from daq.bench.tables.certificate import CertificateTable, Rule
from daq.bench.units import decibels
from daq.results.band_summary import BandMeans, known_range
from daq.results.decision.conformity import Conformity, Statement
from daq.results.result import Result
from daq.results.vocabulary import FLAG_WORDS, PARTNER_WORDS
from estimator.decision.verdict import Verdict
from estimator.self_noise.result import Flag
from estimator.wording import span
from tui.page.blocks import Paragraph, Part, Section
from tui.page.table import Cell, Table
from tui.report.figures.curves import noise_plots
from tui.wording.formatting import (
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
WIDE = "Mean in wide bands with 95 % interval"
NOISE_COLUMNS = 4
"""Columns of the noise in the table of the result."""
WORST_FIRST = (Verdict.FAIL, Verdict.NOT_DECIDED, Verdict.PASS)


def verdict(result: Result) -> Paragraph:
    """Return what it all comes to, in a sentence or two."""
    decision = Decision.of(result)
    if decision is None:
        return Paragraph("No verdict: the bench file has no limits.", "quiet")
    return Paragraph(" ".join([str(decision), *decision.remarks]), TONES[decision.state])


def result_section(
    result: Result,
    models: Sequence[Mask] = (),
    statements: Sequence[Conformity] = (),
    table: CertificateTable | None = None,
) -> Section:
    """Return the noise of every channel with its limits, worst first, and its curves."""
    snapshot, found = result.snapshot, result.verdict
    if not snapshot.results and found is None:
        return Section("Result", (Paragraph("Nothing can be said yet.", "doubtful"),))
    # without a certificate of any sensitivity nothing is stated, and no rule matters
    is_stated = any(each.is_traceable for each in statements)
    texts = [_untraceable(statements)] if statements and table is not None else []
    if is_stated and table is not None:
        texts.insert(0, decision_rule(table, statements[0].k))
    parts: list[Part] = [
        *_result_tables(result, statements, is_stated=is_stated),
        *(Paragraph(text) for text in texts if text),
        *noise_plots(result, models),
    ]
    notes = []
    if found is not None:
        notes.append(
            "Margin: to the limit in the worst band a third of an octave wide, or less at notches "
            "and steps. PASS: its whole interval is above zero in every band; FAIL: below zero in "
            "one. Intervals of margins: 95 % for all channels and bands together."
        )
        if statements and not is_stated:
            notes.append("Risk: probability of noise above the limit in any band.")
    notes.append(
        "± is the 95 % interval of the mean over the band, with all that widens it, sensitivities "
        "included. SNR: power of the motion over that of the noise. Curves: one-sided power "
        f"spectral density in dB re 1 ({snapshot.unit})²/Hz (left) and its root in "
        f"({snapshot.unit})/√Hz (right). Each point is a mean over its share of the axis. Dotted: "
        "the band of the table. Where the interval reaches the bottom, the noise is known only to "
        "be below its upper end. Shaded: nothing can be said." + _about_models(models)
    )
    return Section("Result", (*parts, Paragraph(" ".join(notes), "quiet")))


def _result_tables(
    result: Result, statements: Sequence[Conformity], *, is_stated: bool
) -> list[Table]:
    """Return noise and limit of each channel, the worst sensor first.

    Two tables where one is too wide: with several limits, or statements of conformity.
    """
    snapshot = result.snapshot
    limits = () if result.verdict is None else result.verdict.limits
    order = list(dict.fromkeys(each.limit for each in limits))
    by_rule = {(each.limit, each.sensor, each.channel): each for each in statements}
    worst = {each.sensor: len(WORST_FIRST) for each in limits}
    for each in limits:  # channels of a sensor stay together
        worst[each.sensor] = min(worst[each.sensor], WORST_FIRST.index(each.verdict))
    by_sensor = list(worst)
    judged: list[tuple[str, ...]] = []
    for each in sorted(
        limits,
        key=lambda e: (
            order.index(e.limit),
            worst[e.sensor],
            by_sensor.index(e.sensor),
            WORST_FIRST.index(e.verdict),
        ),
    ):
        cells = (
            *([each.limit] if len(order) > 1 else []),
            plain_number(each.frequency, ".3g"),
            level(each.noise_psd, 1),
            level(each.limit_psd, 1),
            margin(each).replace(" dB", ""),
            Cell(WORDS[each.verdict] if each.known else "no estimate", TONES[each.verdict]),
        )
        if by_rule:
            stated = by_rule[each.limit, each.sensor, each.channel]
            cells += (STATEMENTS[stated.statement],) * is_stated + (_risk(stated.risk),)
        judged.append((each.name, *cells))
    limit = [
        *["limit"] * (len(order) > 1), "at (Hz)", "noise (dB)", "limit (dB)", "margin (dB)",
        "verdict", *["conformity"] * is_stated, *["risk"] * bool(by_rule),
    ]  # fmt: skip
    noise = dict(zip((each.name for each in snapshot.channels), _noise(result), strict=True))
    columns = ["recorded (dB)", "self-noise (dB)", f"({snapshot.unit})/√Hz", "SNR (dB)"]
    mean = f"Mean over {span(*result.band)}"
    mean += f" by the {result.method} method" if snapshot.results else ""
    unit, of = f"dB re 1 ({snapshot.unit})²/Hz", f": {order[0]}" if len(order) == 1 else "s"
    own = [(name, *cells) for name, cells in noise.items()]
    if not limits:
        return [_table(columns, own, f"{mean}, {unit}")]
    if len(order) > 1 or is_stated:
        return [
            _table(limit, judged, f"Limit{of}, {unit}"), _table(columns, own, f"{mean}, {unit}"),
        ]  # fmt: skip
    nothing = ("",) * len(limit)
    rows = [(name, *noise.pop(name, ("?",) * len(columns)), *cells) for name, *cells in judged]
    rows += [(name, *cells, *nothing) for name, cells in noise.items()]
    return [_table([*columns, *limit], rows, f"{mean}, {unit}; limit{of}")]


def _table(columns: Sequence[str], rows: Sequence[tuple[str, ...]], title: str) -> Table:
    words = {"channel", "limit", "verdict", "conformity"}
    left = frozenset(n for n, name in enumerate(("channel", *columns)) if name in words)
    return Table(("channel", *columns), tuple(rows), left=left, title=title)


def _noise(result: Result) -> list[tuple[str, ...]]:
    """Return what each channel recorded, its noise, and the ratio of motion to noise."""
    snapshot, data, alone = result.snapshot, result.data, result.alone
    if not snapshot.results:
        return [("?",) * NOISE_COLUMNS] * len(snapshot.channels)
    means = result.means(next(iter(snapshot.results)))
    no_signal = FLAG_WORDS[Flag.DEAD_CHANNEL].short
    rows: list[tuple[str, ...]] = []
    for number in range(len(snapshot.channels)):
        recorded = float(data[number])
        if number in alone:
            rows.append((level(recorded, 1), PARTNER_WORDS[alone[number]], "?", "?"))
            continue
        mean, low, high = _only(means[number])
        noise = "withdrawn" if mean > high else _with_error(means[number])
        if 0 < mean <= high and low <= 0:
            noise = f"{level(mean)} (below {level(high)})"
        rows.append(
            (
                level(recorded, 1) if recorded > 0 else no_signal,
                noise,
                scientific(math.sqrt(mean)) if 0 < mean <= high else NOTHING,
                _snr(recorded, mean),
            )
        )
    return rows


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


def _about_models(models: Sequence[Mask]) -> str:
    """Return what noise models are shown, and from where they are."""
    found = [f"{each.name}: {SOURCES.get(each.name, 'mask from a file')}" for each in models]
    return f" Noise models: {'; '.join(found)}." if found else ""


def _only(means: BandMeans) -> tuple[float, float, float]:
    """Return mean and ends of the interval of the one band there is."""
    return float(means.mean[0]), float(means.low[0]), float(means.high[0])


def _snr(data: float, noise: float) -> str:
    if not noise > 0:
        return NOTHING
    return plain_number(decibels(data - noise) - decibels(noise), ".1f") if data > noise else "< 0"


def band_tables(result: Result) -> list[Table]:
    """Return the mean noise by every method, and by the first one in bands of an octave or more."""
    snapshot = result.snapshot
    bands = list(_octaves(known_range(snapshot)[0], float(snapshot.frequency[-2])))
    methods = {method: result.means(method) for method in snapshot.results}
    octaves = {span(*band): result.means(result.method, band) for band in bands}
    tables = ((f"Mean over {span(*result.band)} by every method", methods), (WIDE, octaves))
    unit = f"dB re 1 ({snapshot.unit})²/Hz"
    return [
        Table(
            ("channel", *columns),
            tuple(
                (label.name, *(_with_error(means[number]) for means in columns.values()))
                for number, label in enumerate(snapshot.channels)
            ),
            title=f"{name}, {unit}",
        )
        for name, columns in tables
        if len(columns) > 1
    ]


def _with_error(means: BandMeans) -> str:
    mean, low, high = _only(means)
    return level_with_error(mean, high, low)


def _octaves(low: float, high: float) -> Iterator[tuple[float, float]]:
    """Yield bands of 1, 2, 3 … octaves, as few octaves as the columns allow; of whole powers."""
    first, last = math.ceil(math.log2(low) - 1e-9), math.floor(math.log2(high) + 1e-9)
    if last <= first:
        return
    step = -(-(last - first) // MAX_BANDS)
    for exponent in range(first, last, step):
        yield 2.0**exponent, 2.0 ** min(exponent + step, last)
