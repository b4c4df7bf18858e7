"""The sections about the test itself: can its numbers be trusted, and what happened."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby

import numpy as np

from daq.bench.units import decibels
from daq.errors import HuddleError
from daq.estimation.snapshot import Snapshot
from daq.protocols.block import EventKind
from daq.recording.reader import Recording
from daq.results.clock_effect import grade, reference, residuals
from daq.results.facts.fact import MARKS, Fact
from daq.results.result import Result
from daq.results.signal import Signal
from daq.results.sources import LoggedEvent, uncounted_events, with_uncounted
from daq.results.vocabulary import clock_source
from estimator.checks.advice import Rank
from estimator.checks.advice_on_sensors import ANY_AXES
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.checks.band import BandDiagnosis
from estimator.checks.relative_response import RelativeResponse
from estimator.likelihood.goodness_of_fit import rejected_below
from estimator.wording import several, span
from tui.page.blocks import Paragraph, Part, Section
from tui.page.table import Cell, Table, Tone
from tui.report.figures.drift import drift_plot
from tui.report.figures.model_test import model_test_plot
from tui.report.figures.signal import signal_plots
from tui.report.figures.standing import standing_plots
from tui.wording.facts import RANK_TONES, RANKS, fact_items
from tui.wording.formatting import (
    NOTHING,
    plain_number,
    probability,
    response_cells,
    scientific,
    share,
    utc,
)

MOST_SPECTROGRAMS = 1
"""Channels that have spectrograms: each takes a tenth of the time of a report."""
LISTED = 40
"""Most lines of the list of what happened; with more, those of one kind go together."""
_USUAL = {EventKind.STARTED, EventKind.CONNECTED, EventKind.STOPPED, EventKind.MARK}


def model_test_section(result: Result) -> Section:
    """Return where one common motion explains the sensors, and where not."""
    title = "Model test: do the sensors share one motion?"
    found = result.snapshot.diagnostics.diagnosis
    if found is None or result.snapshot.diagnostics.untested is not None:
        return Section(title, (Paragraph("Not tested: see the facts.", "doubtful"),))
    tested = [band for band in found.bands if math.isfinite(band.test.p_value)]
    rejected = rejected_below(band.test for band in tested)

    def fails(band: BandDiagnosis) -> bool:
        return band.test.p_value < rejected

    grouped = [(failing, list(run)) for failing, run in groupby(tested, key=fails)]
    runs = [run for failing, run in grouped if failing]
    tone: Tone = "doubtful"
    if runs:
        text = (
            f"The test fails at {'; '.join(map(_run_in_words, runs))}. There the sensors do not"
            " sense, or do not report, the same motion. What they do not share counts as noise."
        )
        tone = "bad" if any(_ratio(band) > 2 for run in runs for band in run) else tone
    elif any(isinstance(advice, NoSharedMotion) for advice in found.advice):
        text = "The test passes: it cannot show that a sensor records another motion."
        text += " See the advice."
    else:
        text = "One common motion explains what the sensors have in common, in all bands."
        tone = "good"
    parts: list[Part] = [Paragraph(text, tone)]
    if runs and len(runs[0]) < len(tested):
        text = "Elsewhere one common motion explains what they have in common."
        parts.append(Paragraph(text))
    plot = model_test_plot(result)
    if plot is not None:
        parts += [
            Paragraph(
                "Likelihood ratio statistic over its expectation. By chance one point in a hundred "
                "is above the dashed line.",
                "quiet",
            ),
            plot,
        ]
    rows: list[tuple[str, ...]] = []
    for failing, run in grouped:  # bands that hold go together
        rows += [_test_row([band], failing=True) for band in run] if failing else [_test_row(run)]
    header = (
        "bands (Hz)", "least coherence", "condition", "dimension", "SNR (dB)",
        "statistic / expected", "test", "p",
    )  # fmt: skip
    parts += [
        Table(header, tuple(rows), left=frozenset({6})),
        Paragraph(
            f"A band fails where p is below {rejected:.2g}. One sound test in a hundred has a band "
            "that fails. Bands that hold go together, with their number and the range of values.",
            "quiet",
        ),
    ]
    return Section(title, tuple(parts))


def alignment_section(result: Result) -> Section:
    """Return orientation, gain and delay of the sensors against the first one, and coherence."""
    title, snapshot = "Alignment of the sensors", result.snapshot
    diagnosis = snapshot.diagnostics.diagnosis
    found = () if diagnosis is None else diagnosis.responses
    if not found:
        text = "Not known: this takes two sensors and motion that they share."
        return Section(title, (Paragraph(text, "quiet"),))
    names = snapshot.sensor_names
    reference = min(response.first for response in found)
    shown = [response for response in found if response.first == reference]
    rows = []
    for response in shown:
        rotation, horizontal, gains, delay, skew = response_cells(response)
        polarity = "?" if response.is_ambiguous else _reversed(snapshot, response) or "none"
        sensor = names[response.second]
        rows.append((sensor, rotation, horizontal, " / ".join(gains), skew, delay, polarity))
    header = (
        "sensor", "rotation (°)", "in the horizontal (°)", "gains",
        "not orthogonal (°)", "delay (µs)", "reversed",
    )  # fmt: skip
    missing = [
        name
        for number, name in enumerate(names)
        if number != reference and all(response.second != number for response in shown)
    ]
    parts: list[Part] = [
        Paragraph(
            f"Against sensor {names[reference]}, from the common motion at "
            f"{span(min(r.low for r in shown), max(r.high for r in shown))}. Gains are of like "
            "channels; ± is half of a 95 % interval. Rotation alone does not bias a "
            f"{ANY_AXES} estimate.",
            "quiet",
        ),
        Table(header, tuple(rows), left=frozenset({0, 6})),
    ]
    parts += standing_plots(result)
    if missing:
        parts.append(Paragraph(f"Could not be compared: {', '.join(missing)}.", "doubtful"))
    return Section(title, tuple(parts))


def clocks_section(result: Result) -> Section:
    """Return what is known of each clock, and what it does to the noise."""
    snapshot = result.snapshot
    effects = result.clock_effects
    worst = max((effect for effect in effects.values() if math.isfinite(effect)), default=math.nan)
    parts: list[Part] = []
    if math.isfinite(worst):
        band = span(*result.band)
        tone = grade(worst)
        text = f"Errors of the clocks make up {share(worst)} of the noise within {band}"
        text += " at most: they do not matter here." if tone == "good" else " in the worst channel."
        if tone == "bad":
            text += " Give the sensors one clock, or record longer for their rates to be known."
        parts.append(Paragraph(text, tone))
    left, against = residuals(snapshot), reference(snapshot)
    rows = []
    for clock in snapshot.clocks:
        n_restarts, error = clock.n_epochs - 1, left.get(clock.sensor, math.nan)
        restarts = f", {several(n_restarts, 'restart')}" if n_restarts > 0 else ""
        refined = "yes" if clock.refined else "no"
        rows.append(
            (
                clock.sensor,
                clock_source(clock) + restarts,
                plain_number(clock.offset * 1e3, ".3f"),
                plain_number(clock.ppm, "+.3f"),
                f"{clock.ppm_std:.2g}",
                scientific(clock.wander_ppm, 2),
                "–" if error == 0 else plain_number(error * 1e6, ".2f"),
                "the others against it" if clock.sensor == against else refined,
                share(effects.get(clock.sensor, math.nan)),
            )
        )
    header = (
        "sensor", "time from", "offset (ms)", "rate (ppm)", "±", "wander (ppm)",
        "error (µs rms)", "refined by motion", "of the noise",
    )  # fmt: skip
    if rows:
        parts.append(Table(header, tuple(rows), left=frozenset({0, 1, 7})))
    plot = drift_plot(snapshot)
    if plot is not None:
        behind = "the computer's" if against is None else f"that of {against}"
        parts += [
            Paragraph(
                f"Drift: by how much each sensor's clock lags behind {behind}, "
                "without its straight line (a constant rate) and without the steps of restarts.",
                "quiet",
            ),
            plot,
        ]
    elif rows:
        parts.append(Paragraph("No clock drifts against the others.", "quiet"))
    return Section("Clocks", tuple(parts))


def _against_time(result: Result) -> list[Part]:
    """Return the recording against time; nothing where it cannot be read any more.

    Of several recordings the first one; spectrograms are of the first channel.
    """
    source = result.sources[0]
    try:
        with Recording.open(source.path) as recording:
            plots = signal_plots(
                Signal(recording),
                result.snapshot,
                exclude=result.settings.exclude,
                most_spectra=MOST_SPECTROGRAMS,
            )
    except (HuddleError, OSError):
        return []
    text = "Extremes of each channel. Red: gaps; grey: excluded; dashed: remarks."
    if len(result.sources) > 1:
        text = f"The first of {len(result.sources)} recordings. {text}"
    return [Paragraph(text, "quiet"), *plots]


def events_section(result: Result) -> Section:
    """Return the recording against time, and what happened."""
    parts = _against_time(result)
    recorded = (each for source in result.sources for each in source.logged_events)
    logged_events = with_uncounted(recorded, uncounted_events(result.snapshot.clocks))
    if not logged_events:
        parts.append(Paragraph("The recordings hold no events.", "quiet"))
        return Section("The recording against time", tuple(parts))
    rows = []
    for each, count, last in _together(logged_events):
        until = f" ({count} of this kind, until {_when(last, after=each.utc_ns)})" * (count > 1)
        kind = each.kind if each.kind in _USUAL else Cell(each.kind, "doubtful")
        rows.append((_when(each.utc_ns), each.sensor or "all", kind, each.text + until))
    left = len(rows) - LISTED
    header = ("when (UTC)", "sensor", "what", "in words")
    parts.append(Table(header, tuple(rows[:LISTED]), left=frozenset(range(4))))
    if left > 0:
        parts.append(Paragraph(f"… and {several(left, 'further line')}: see the file.", "quiet"))
    return Section("The recording against time", tuple(parts))


def facts_section(facts: Sequence[Fact]) -> Section:
    """Return what is known of the test beyond its numbers, the worst first."""
    ranks = {each.rank for each in facts} - {Rank.TO_KNOW}
    legend = ", ".join(f"{MARKS[rank]} {words}" for rank, words in RANKS.items() if rank in ranks)
    return Section(
        "Facts", (fact_items(facts), *([Paragraph(f"{legend}.", "quiet")] if legend else []))
    )


def invalidating(facts: Sequence[Fact]) -> tuple[Paragraph, ...]:
    """Return the lines of facts that invalidate the result, for the first page."""
    return tuple(
        Paragraph(each.line, RANK_TONES[each.rank] if each.needs_action else "doubtful")
        for each in facts
        if each.rank is Rank.INVALIDATES
    )


def _ratio(band: BandDiagnosis) -> float:
    return band.test.statistic / band.test.degrees if band.test.degrees else math.nan


def _run_in_words(run: Sequence[BandDiagnosis]) -> str:
    worst = max(run, key=_ratio)
    where = span(run[0].low, run[-1].high)
    at = f" at {span(worst.low, worst.high)}" if len(run) > 1 else ""
    return f"{where} (statistic {_ratio(worst):.3g} times its expectation{at})"


def _test_row(bands: Sequence[BandDiagnosis], *, failing: bool = False) -> tuple[str, ...]:
    """Return what the model test found in one band, or in several that follow each other."""

    def ends(values: Iterable[float], show: Callable[[float], str]) -> str:
        known = [value for value in values if not math.isnan(value)]
        shown = dict.fromkeys(show(value) for value in (min(known), max(known))) if known else ()
        return " … ".join(shown) or NOTHING

    tone: Tone = "bad" if any(_ratio(band) > 2 for band in bands) else "doubtful"
    return (
        f"{bands[0].low:.3g}–{bands[-1].high:.3g}" + f" ({len(bands)})" * (len(bands) > 1),
        ends((band.coherence for band in bands), lambda value: plain_number(value, ".4f")),
        ends((band.condition for band in bands), lambda value: scientific(value, 2)),
        ends((band.dimension for band in bands), lambda value: plain_number(value, ".0f")),
        ends((float(snr) for band in bands for snr in band.snr if np.isfinite(snr)), _snr),
        ends(map(_ratio, bands), lambda value: plain_number(value, ".3f")),
        Cell("fails", tone) if failing else "holds",
        ends((band.test.p_value for band in bands), probability),
    )


def _snr(ratio: float) -> str:
    return plain_number(decibels(ratio), ".0f") if ratio > 0 else "< 0"


def _reversed(snapshot: Snapshot, response: RelativeResponse) -> str:
    first = sum(snapshot.dims[: response.second])
    channels = (snapshot.channels[first + number] for number in response.reversed_channels)
    return ", ".join(label.channel for label in channels)


def _together(logged_events: Iterable[LoggedEvent]) -> list[tuple[LoggedEvent, int, int]]:
    """Return what happened in time order: how often, until when; alike ones together if many."""
    ordered = sorted(logged_events, key=lambda each: each.utc_ns)
    if len(ordered) <= LISTED:
        return [(each, 1, each.utc_ns) for each in ordered]
    alike: dict[tuple[str, str], tuple[LoggedEvent, int, int]] = {}
    for each in ordered:
        first, count, _ = alike.get((each.sensor, each.kind), (each, 0, 0))
        alike[each.sensor, each.kind] = (first, count + 1, each.utc_ns)
    return list(alike.values())


def _when(utc_ns: int, *, after: int | None = None) -> str:
    """Return an instant to the second, without its day where that is the day of one before."""
    text = utc(utc_ns)[:19].replace("T", " ")
    return text[11:] if after is not None and utc(after)[:10] == text[:10] else text
