"""The sections about noise: the verdict against the limits, tables and plots."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daq.results.band_summary import band_of, channel_means, decibels
from daq.results.limits import judged
from estimator.self_noise.band_means import band_edges
from estimator.self_noise.result import Flag
from tui.output.formatting import several, span
from tui.output.results import flagged
from tui.output.vocabulary import FLAG_WORDS
from tui.report.parts import Items, Paragraph, Part, Section, Table
from tui.report.plots import noise_plots
from tui.report.wording import decibel, plain_number, scientific

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.results.limits import LimitResult
    from estimator.self_noise.band_means import BandMeans
    from tui.report.parts import Tone

MOST_BANDS = 7
"""Columns of the table of noise by octaves that a page is wide."""


def verdict(bench: Bench | None, found: list[LimitResult]) -> Paragraph:
    """Return what it all comes to, in a sentence or two."""
    known = [each for each in found if each.known]
    if not known:
        why = (
            "there are no limits in the bench file"
            if bench is None or not bench.limits
            else "the estimate says nothing at the frequencies of the limits"
        )
        return Paragraph(f"Measured, not judged: {why}.", "quiet")
    channels = {(each.sensor, each.channel) for each in known}
    failing = {(each.sensor, each.channel) for each in known if not each.met}
    unsure = {(e.sensor, e.channel) for e in known if e.met and not e.certain} - failing
    unknown = {(each.sensor, each.channel) for each in found} - channels
    names = ", ".join(dict.fromkeys(each.limit for each in known))
    if failing:
        those = ", ".join(".".join(name) for name in sorted(failing))
        text = (
            f"FAIL: {len(failing)} of {several(len(channels), 'channel')} above {names}: {those}."
        )
    elif len(channels) == 1:
        text = f"PASS: the channel meets {names}."
    else:
        text = f"PASS: all {len(channels)} channels meet {names}."
    if unsure:
        text += (
            f" {several(len(unsure), 'channel')} within the uncertainty of the limit: "
            "record longer to be certain."
        )
    if unknown:
        text += f" Of {several(len(unknown), 'channel')} nothing can be said."
    tone: Tone = "bad" if failing else "doubtful" if unsure or unknown else "good"
    return Paragraph(text, tone)


def limits_section(
    bench: Bench | None, snapshot: Snapshot, found: list[LimitResult]
) -> Section | None:
    """Return every channel beside its limits; None where the bench file has none."""
    if bench is None or not bench.limits:
        return None
    rows: list[tuple[str, ...]] = []
    tones: dict[tuple[int, int], Tone] = {}
    for number, each in enumerate(found):
        word, tone = _words(each)
        tones[number, 6] = tone
        rows.append(
            (
                f"{each.sensor}.{each.channel}",
                each.limit,
                plain_number(each.frequency, ".3g"),
                decibel(each.noise_psd),
                decibel(each.limit_psd),
                plain_number(each.margin_db, "+.1f"),
                word,
            )
        )
    method = next(iter(snapshot.results), "")
    header = (
        "channel", "limit", "at (Hz)", "noise (dB)", "limit (dB)", "margin (dB)", "verdict",
    )  # fmt: skip
    note = (
        f"By the {method} estimate, in bands a third of an octave wide; shown is the band where "
        f"the channel does worst. dB re 1 ({snapshot.unit})²/Hz. A channel fails where the whole "
        "95 % interval, of all these bands at once, is above the limit."
    )
    table = Table(header, tuple(rows), left=frozenset({0, 1, 6}), tones=tones)
    return Section("Verdict against the limits", (table, Paragraph(note, "quiet")))


def noise_section(snapshot: Snapshot, settings: Settings, bench: Bench | None) -> Section:
    """Return tables and plots of the noise of every channel."""
    if not snapshot.results:
        return Section("Self-noise", (Paragraph("Nothing can be said yet.", "doubtful"),))
    parts: list[Part] = [_band_table(snapshot, settings)]
    notes = [line for method in snapshot.results for line in flagged(snapshot, method)]
    notes += [f"{method}: {why}" for method, why in snapshot.refused.items()]
    parts += [
        Paragraph(
            "The 95 % interval is that of the mean over the band. It is statistical: what is known "
            "of the sensitivities comes on top. SNR: power of the motion over that of the noise.",
            "quiet",
        )
    ]
    if notes:
        parts.append(Items(tuple(Paragraph(line, "doubtful") for line in notes)))
    octaves = _octave_table(snapshot, settings)
    if octaves is not None:
        parts.append(octaves)
    if len(snapshot.results) > 1:
        parts.append(_methods_table(snapshot, settings))
    parts.append(
        Paragraph(
            f"Below: one-sided power spectral density in dB re 1 ({snapshot.unit})²/Hz (left) and "
            f"its root in ({snapshot.unit})/√Hz (right). Each point is a mean over its share of "
            "the axis. Dotted: the band of the table. Where the interval reaches the bottom, the "
            "noise is known only to be below its upper end. Hatched: nothing can be said.",
            "quiet",
        )
    )
    parts += noise_plots(snapshot, settings, bench)
    return Section("Self-noise", tuple(parts))


def judgements(bench: Bench | None, snapshot: Snapshot, settings: Settings) -> list[LimitResult]:
    """Return every channel beside its limits, worst first within each limit."""
    found = judged(bench, snapshot, settings)
    order = list(dict.fromkeys(each.limit for each in found))
    return sorted(found, key=lambda each: (order.index(each.limit), _rank(each)))


def _rank(each: LimitResult) -> int:
    return 3 if not each.known else 0 if not each.met else 1 if not each.certain else 2


def _words(each: LimitResult) -> tuple[str, Tone]:
    if not each.known:
        return "nothing can be said", "doubtful"
    if not each.met:
        return "FAIL", "bad"
    return ("pass", "good") if each.certain else ("pass, not certain", "doubtful")


def _band_table(snapshot: Snapshot, settings: Settings) -> Table:
    band = band_of(settings, snapshot)
    method, noise = next(iter(snapshot.results.items()))
    means = channel_means(noise, snapshot.frequency, settings, band)
    inside = slice(*band_edges(snapshot.frequency, band))
    width = np.gradient(snapshot.frequency)[inside]
    data = np.average(snapshot.data_psd[inside], axis=0, weights=width)
    no_signal = FLAG_WORDS[Flag.DEAD_CHANNEL].short
    rows = []
    for number, label in enumerate(snapshot.channels):
        mean = _only(means[number])
        cov = noise.cov[inside, number]
        cov = cov[np.isfinite(cov)]
        rows.append(
            (
                f"{label.sensor}.{label.channel}",
                decibel(float(data[number])) if data[number] > 0 else no_signal,
                decibel(mean[0], 2),
                _interval(mean[1], mean[2]),
                scientific(math.sqrt(mean[0])) if mean[0] > 0 else decibel(mean[0]),
                plain_number(float(np.median(cov)) if cov.size else math.nan, ".3f"),
                plain_number(mean[3], ".3f"),
                _snr(float(data[number]), mean[0]),
            )
        )
    header = (
        "channel", "recorded (dB)", "self-noise (dB)", "95 % interval (dB)",
        f"({snapshot.unit})/√Hz", "c.o.v. per frequency", "c.o.v. of mean", "SNR (dB)",
    )  # fmt: skip
    title = f"Mean over {span(*band)} by the {method} method, dB re 1 ({snapshot.unit})²/Hz"
    return Table(header, tuple(rows), title=title)


def _only(means: BandMeans) -> tuple[float, float, float, float]:
    """Return mean, ends of the interval and c.o.v. of the one band there is."""
    mean, spread = float(means.mean[0]), float(means.spread[0])
    cov = spread / abs(mean) if mean else math.nan
    return mean, float(means.low[0]), float(means.high[0]), cov


def _interval(low: float, high: float) -> str:
    if not high > 0:
        return "below 0" if high <= 0 else decibel(math.nan)
    return f"{decibel(low, 2)} … {decibel(high, 2)}" if low > 0 else f"below {decibel(high, 2)}"


def _snr(data: float, noise: float) -> str:
    if not noise > 0:
        return decibel(math.nan)
    return plain_number(decibels(data - noise) - decibels(noise), ".1f") if data > noise else "< 0"


def _octave_table(snapshot: Snapshot, settings: Settings) -> Table | None:
    """Return the mean noise in bands of an octave or more, by the first method."""
    bands = list(_octaves(float(snapshot.frequency[1]), float(snapshot.frequency[-2])))
    if len(bands) < 2:
        return None
    noise = next(iter(snapshot.results.values()))
    columns = [channel_means(noise, snapshot.frequency, settings, band) for band in bands]
    rows = []
    for number, label in enumerate(snapshot.channels):
        row = [f"{label.sensor}.{label.channel}"]
        for means in columns:
            mean, low, high, _ = _only(means[number])
            row.append(_level_with_error(mean, low, high))
        rows.append(tuple(row))
    header = ("channel", *(span(*band) for band in bands))
    title = f"Mean in wide bands with 95 % interval, dB re 1 ({snapshot.unit})²/Hz"
    return Table(header, tuple(rows), title=title)


def _octaves(low: float, high: float) -> Iterator[tuple[float, float]]:
    """Yield bands of 1, 2, 3 … octaves, as few octaves as the columns allow; of whole powers."""
    first, last = math.ceil(math.log2(low) - 1e-9), math.floor(math.log2(high) + 1e-9)
    if last <= first:
        return
    step = -(-(last - first) // MOST_BANDS)
    for exponent in range(first, last, step):
        yield 2.0**exponent, 2.0 ** min(exponent + step, last)


def _level_with_error(mean: float, low: float, high: float) -> str:
    if not mean > 0:
        return decibel(mean)
    if low <= 0:
        return f"< {decibel(high, 2)}"
    return f"{decibel(mean, 2)} ±{decibels(high) - decibels(mean):.2f}"


def _methods_table(snapshot: Snapshot, settings: Settings) -> Table:
    band = band_of(settings, snapshot)
    columns = [
        channel_means(noise, snapshot.frequency, settings, band)
        for noise in snapshot.results.values()
    ]
    rows = tuple(
        (
            f"{label.sensor}.{label.channel}",
            *(_level_with_error(*_only(means[number])[:3]) for means in columns),
        )
        for number, label in enumerate(snapshot.channels)
    )
    title = f"Mean over {span(*band)} by every method, dB re 1 ({snapshot.unit})²/Hz"
    return Table(("channel", *snapshot.results), rows, title=title)
