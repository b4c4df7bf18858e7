"""A finished estimate as a table, remarks and CSV."""

from __future__ import annotations

import csv
import io
import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table
from rich.text import Text

from daq.results.band_summary import band_of, channel_means, data_means, highest_known
from daq.results.clock_effect import reference
from daq.results.partners import without_partners
from daq.timing.clock_model import ClockSource
from estimator.diagnostics.advice import Copies, NoSharedMotion, NoSignal
from estimator.diagnostics.shared_noise import MAX_CHANNELS
from estimator.self_noise.result import Flag
from estimator.spectra.segment_rejection import Reason
from tui.output.formatting import (
    clock_time,
    level,
    level_with_error,
    listed,
    percent,
    several,
    signed,
    utc,
)
from tui.output.vocabulary import (
    FLAG_WORDS,
    PARTNER_WORDS,
    REASONS,
    SOURCE_WORDS,
    WITHOUT_ESTIMATE,
)

if TYPE_CHECKING:
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.timing.clock_model import ClockState
    from estimator.levels.contributions import Source

LEAST_SAID = 0.01
"""Share of the noise from which it is said what widens an interval."""


def result_title(snapshot: Snapshot, settings: Settings) -> Text:
    """Return the title of the table of results."""
    low, high = band_of(settings, snapshot)
    wanted = high if settings.band is None else settings.band[1]
    asked = f" ({wanted:.3g} requested)" if wanted > high else ""
    return Text.assemble(
        (f"Self-noise, mean over {low:.3g} to {high:.3g} Hz", "bold"),
        f"{asked}, dB re 1 ({snapshot.unit})²/Hz, with its 95 % interval",
    )


def result_table(snapshot: Snapshot, settings: Settings) -> Table:
    """Return the noise of every channel in the band, by each method."""
    band = band_of(settings, snapshot)
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("sensor")
    table.add_column("channel")
    table.add_column("data", justify="right")
    columns = []
    for method, noise in snapshot.results.items():
        table.add_column(method, justify="right")
        columns.append(channel_means(noise, snapshot, settings, band))
    data, alone = data_means(snapshot, band), without_partners(snapshot, band)
    for number, label in enumerate(snapshot.channels):
        power = float(data[number])
        no_signal = FLAG_WORDS[Flag.DEAD_CHANNEL].short
        row = [label.sensor, label.channel, no_signal if power == 0 else level(power)]
        for means in columns:
            mean = means[number]
            if number in alone:
                row.append(PARTNER_WORDS[alone[number]])
                continue
            row.append(
                level_with_error(float(mean.mean[0]), float(mean.high[0]), float(mean.low[0]))
            )
        table.add_row(*map(Text, row))
    return table


def remarks(snapshot: Snapshot) -> list[str]:
    """Return the remarks below the table."""
    taken = (
        f"{several(snapshot.n_segments, 'segment')} ({snapshot.n_effective:.0f} effective averages)"
    )
    lines = [f"{taken} from {clock_time(snapshot.elapsed)} since {utc(snapshot.start_utc_ns)}"]
    if snapshot.octaves:
        lowest, highest = snapshot.octaves[0], snapshot.octaves[-1]
        if lowest is highest:
            lines.append("octaves: too few samples for longer segments at lower frequencies")
        else:
            lines[0] += f" above {highest.low:.3g} Hz"
            lines.append(
                f"octaves below have longer segments, up to {lowest.segment:.4g} s"
                f" ({lowest.n_effective:.0f} effective averages) below {lowest.high:.3g} Hz"
            )
        disturbed = [
            f"{octave.left_out[Reason.TRANSIENT]} at {octave.low:.3g}–{octave.high:.3g} Hz"
            for octave in snapshot.octaves
            if octave.left_out.get(Reason.TRANSIENT)
        ]
        if disturbed:
            lines.append(f"segments with transients excluded: {', '.join(disturbed)}")
    lines += [
        f"{sensor.name}: {several(sensor.n_damaged, 'block')} of the file damaged (wrong"
        " checksum) and excluded; huddle repair --check counts all of them"
        for sensor in snapshot.sensors
        if sensor.n_damaged
    ]
    if snapshot.bridged is not None:
        usual = float(np.nanmean(np.abs(snapshot.bridged.leakage[1:-1])))
        lines.append(
            f"{several(snapshot.bridged.n_segments, 'segment')} with gaps used by windows that are"
            f" zero in them ({percent(snapshot.bridged.lost)} of the signal); noise of other"
            f" frequencies in them: {percent(usual)} of the noise on average, in the intervals"
        )
    if snapshot.n_dropped:
        lines.append(f"{several(snapshot.n_dropped, 'segment')} excluded{left_out(snapshot)}")
    lines += [
        f"{sensor.name}: {several(sensor.n_gaps, 'gap')}, "
        f"{several(sensor.n_missing, 'sample')} missing"
        for sensor in snapshot.sensors
        if sensor.n_gaps
    ]
    fitted = [clock for clock in snapshot.clocks if clock.source is ClockSource.ARRIVAL_TIMES]
    if fitted:
        rates = ", ".join(f"{clock.sensor} {signed(clock.ppm, '+.1f')} ppm" for clock in fitted)
        left = snapshot.diagnostics.synchronisation.residual  # between them
        worst = max(left[clock.sensor] for clock in fitted) * 1e6
        lines.append(f"clocks {rates}, aligned to about {_short(worst)} µs")
    lines += wrong_times(snapshot)
    if (limit := highest_known(snapshot)) < snapshot.frequency[-1]:
        lines.append(f"no estimate above {limit:.4g} Hz, where resampling attenuates")
    lines += [*faulty_channels(snapshot), *not_searched(snapshot)]
    if "two-channel" in snapshot.results:
        lines.append(
            "two-channel: assumes that like channels are parallel and have equal gains, or those "
            "given by --gain"
        )
    named = any(isinstance(each, NoSignal | Copies) for each in snapshot.diagnostics.advice)
    for method, noise in snapshot.results.items():
        lines += flagged(snapshot, method, besides=_NAMED if named else _NONE)
        if not any(isinstance(each, NoSharedMotion) for each in snapshot.diagnostics.advice):
            lines += unresolved(snapshot, method)  # else a longer recording would not help
        negative = int(np.sum(noise.noise_psd[1:-1] <= 0))
        if negative:
            of = f"{negative} of {noise.noise_psd[1:-1].size} values"
            lines.append(f"{method}: {of} {'is' if negative == 1 else 'are'} at or below zero")
    lines += [f"{method}: {reason}" for method, reason in snapshot.refused.items()]
    return lines


def widened_by(snapshot: Snapshot, settings: Settings) -> list[str]:
    """Return what the intervals of the table include beyond scatter, and how much of the noise."""
    lines = []
    for method, noise in snapshot.results.items():
        most: dict[Source, float] = {}
        for mean in channel_means(noise, snapshot, settings, band_of(settings, snapshot)):
            level = abs(float(mean.mean[0]))
            for source, (below, above) in mean.parts.items():
                share = max(float(below[0]), float(above[0])) / level if level else math.nan
                if share >= LEAST_SAID:
                    most[source] = max(most.get(source, 0.0), share)
        if most:
            said = [
                SOURCE_WORDS[source]
                + (f" (up to {percent(share)})" if math.isfinite(share) else " (without limit)")
                for source, share in most.items()
            ]
            lines.append(f"{method}: beside scatter, the intervals include {listed(said)}")
    return lines


def _short(value: float) -> str:
    return f"{value:.0f}" if value > 10 else f"{value:.1f}"


def wrong_times(snapshot: Snapshot) -> list[str]:
    """Return remarks on times that are wrong, or may be: drifting, miscounted, or nominal."""
    wrong = [clock for clock in snapshot.clocks if clock.corrected and not clock.drifts]
    lost = [clock for clock in snapshot.clocks if clock.drifts]
    unchecked = [clock.sensor for clock in snapshot.clocks if clock.unchecked]
    lines = []
    if wrong or lost:
        against = reference(snapshot)
        text = f"Stated times drift{'' if against is None else f' against those of {against}'}, as"
        by = ", ".join(
            f"{each.sensor} by {_short(size * 1e6)} µs rms"
            for each, size in [(c, c.corrected) for c in wrong] + [(c, c.residual) for c in lost]
        )
        text += f" the motion shows: {by}."
    if wrong:
        left = snapshot.diagnostics.synchronisation.residual
        worst = max(each.residual if lost else left[each.sensor] for each in wrong) * 1e6
        those = f"Those of {listed([each.sensor for each in wrong])}" if lost else "They"
        text += f" {those} were corrected to within about {_short(worst)} µs."
    if lost:
        text += f" Those of {listed([each.sensor for each in lost])} could not be corrected: the"
        text += " motion is too weak for so short segments. Choose longer ones."
    if wrong or lost:
        text += " Check whether the clocks were synchronised, or whether waves changed direction."
        lines.append(text)
    if unchecked:
        lines.append(
            f"The times that {listed(unchecked)} {'states' if len(unchecked) == 1 else 'state'}"
            " could not be compared with the motion: it is too weak, or the recording too short. If"
            " they drift, the noise is wrong by a share of the motion."
        )
    lines += [_lost(clock) for clock in snapshot.clocks if clock.slips]
    lines += [
        f"The clock of {clock.sensor} ({signed(clock.ppm, '+.0f')} ppm) is not understood: its"
        f" samples are off by about {_short(clock.residual * 1e6)} µs rms. The intervals include"
        " this error, and limits are not decided. Check whether samples are lost or repeated"
        " without being counted (buffers, cable, the logger's software), and the sampling rate."
        for clock in snapshot.clocks
        if not clock.is_understood
    ]
    nominal = [clock.sensor for clock in snapshot.clocks if math.isnan(clock.residual)]
    if nominal:
        lines.append(
            f"The samples of {listed(nominal)} are taken to be at their nominal rate. If it is not "
            "exact, the noise is too high or too low; intervals and budgets do not include this "
            "error."
        )
    return lines


def _lost(clock: ClockState) -> str:
    """Return which samples a sensor lost without counting them, and what to check."""
    total = sum(abs(slip.n_samples) for slip in clock.slips)
    verbs = {slip.n_samples > 0 for slip in clock.slips}
    verb = "lost or repeated" if len(verbs) > 1 else "lost" if verbs == {True} else "repeated"
    first, last = (_time_of_day(clock.slips[at].utc_ns) for at in (0, -1))
    when = f"at about {first} UTC"
    if len(clock.slips) > 1:
        when = f"between {first} and {last} UTC, {len(clock.slips)} times,"
    return (
        f"{clock.sensor} {verb} {several(total, 'sample')} {when} without counting"
        f" {'it' if total == 1 else 'them'}. Its count was corrected, and the segments around are"
        " excluded. Check the buffers and the cable of the logger, and the load of its computer."
    )


def _time_of_day(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns // 10**9, UTC):%H:%M:%S}"


def not_searched(snapshot: Snapshot) -> list[str]:
    """Return remarks on what the diagnosis left out."""
    lines = []
    if (n := len(snapshot.channels)) > MAX_CHANNELS:
        text = f"noise that two channels share is not searched for among more than {MAX_CHANNELS}"
        lines.append(f"{text} channels, to limit the memory; these are {n}")
    causes = (
        ("--octaves", bool(snapshot.octaves)),
        ("--reject", bool(snapshot.left_out.get(Reason.TRANSIENT))),
        ("segments with gaps", snapshot.bridged is not None),
    )
    found = snapshot.diagnostics.diagnosis
    if found is not None and found.stability is None and any(holds for _, holds in causes):
        cause = listed([name for name, holds in causes if holds])
        lines.append(
            f"whether the noise changes during the recording is not tested with {cause}: the "
            "intervals hold for steady noise"
        )
    return lines


def faulty_channels(snapshot: Snapshot) -> list[str]:
    """Return remarks on channels that are clipped or were temporarily dead, with remedies."""
    lines = []
    clipped, stood_still = snapshot.diagnostics.clipped, snapshot.diagnostics.stood_still
    if clipped:
        names = ", ".join(
            f"{snapshot.channels[column].name} ({100 * share:.2g} %)"
            for column, share in clipped.items()
        )
        lines.append(
            f"Clipped: {names} of the samples are at the largest or smallest count of the range: "
            "the noise of these channels is too high. Use a larger range, or less motion."
        )
    if stood_still:
        names = ", ".join(
            f"{snapshot.channels[column].name} (for {seconds:.2g} s)"
            for column, seconds in stood_still.items()
        )
        lines.append(
            f"Temporarily dead: {names} had a constant count. The motion missing there counts as "
            "noise. Exclude that time (--reject; --start and --end for "
            "minutes), and check the cable and the power supply."
        )
    return lines


def live_remarks(snapshot: Snapshot) -> tuple[str, ...]:
    """Return what a live estimate lacks, and what to do; empty where nothing."""
    return *_not_estimated(snapshot), *_why_no_segment(snapshot)


def _not_estimated(snapshot: Snapshot) -> tuple[str, ...]:
    if not snapshot.not_estimated:
        return ()
    n, n_left = len(snapshot.sensor_names), len(snapshot.not_estimated)
    return (
        f"Live estimate of the first {n} of {n + n_left} sensors, to limit its memory.",
        "The result has all; so has huddle estimate.",
    )


def _why_no_segment(snapshot: Snapshot) -> tuple[str, ...]:
    found = snapshot.no_segment
    if found is None:
        return ()
    head = f"No segment of {found.segment:g} s can be used:"
    if found.reason is Reason.GAP:
        return (
            f"{head} {found.sensor} has at most {found.longest:.2g} s without a gap.",
            "Check its cable, lower its sampling rate, or choose a shorter --segment.",
        )
    if found.reason is Reason.CLIPPED:
        return (
            f"{head} samples are clipped.",
            "Choose a larger range, reduce the motion, or keep them (--no-reject).",
        )
    return f"{head} there are transients.", "Wait for a quieter time, or leave out --reject."


def left_out(snapshot: Snapshot) -> str:
    """Return why segments were excluded; the text follows their number."""
    counts = {reason: count for reason, count in snapshot.left_out.items() if count}
    if len(counts) == 1:
        return " " + REASONS[next(iter(counts))]
    return ": " + ", ".join(f"{count} {REASONS[reason]}" for reason, count in counts.items())


_NONE = Flag(0)
_NAMED = Flag.DEAD_CHANNEL | Flag.DUPLICATE  # advice names these once for all methods


def flagged(snapshot: Snapshot, method: str, *, besides: Flag = _NONE) -> list[str]:
    """Return channels with frequencies without a valid estimate, and the reason.

    Flags in ``besides`` are omitted.
    """
    flags = snapshot.results[method].flags[snapshot.frequency <= highest_known(snapshot)]
    lines = []
    for flag, words in FLAG_WORDS.items():
        if not flag & (WITHOUT_ESTIMATE | Flag.NOT_CONVERGED) & ~besides:
            continue
        counts = ((flags[1:-1] & flag) != 0).sum(axis=0)
        if counts.any():
            names = ", ".join(
                label.name for label, count in zip(snapshot.channels, counts, strict=True) if count
            )
            most, n_freqs = counts.max(), len(flags[1:-1])
            at = "all frequencies" if most == n_freqs else f"{most} of {n_freqs} frequencies"
            lines.append(f"{method}: {names}: {words.long}, at {at}")
    return lines


def unresolved(snapshot: Snapshot, method: str) -> list[str]:
    """Return where the directions of the motion are those of neighbouring frequencies."""
    where = ((snapshot.results[method].flags[1:-1] & Flag.POOLED) != 0).any(axis=1)
    if not where.any():
        return []
    frequency = snapshot.frequency[1:-1][where]
    return [
        (
            f"{method}: single frequencies do not resolve the motion at {where.sum()} of"
            f" {len(where)} ({frequency[0]:.3g} to {frequency[-1]:.3g} Hz); its directions are"
            " taken from neighbouring frequencies there"
        )
    ]


def _not_a_formula(text: str) -> str:
    """Return a cell that a spreadsheet does not calculate, whatever a sensor is called."""
    return f"'{text}" if text[:1] in set("=+-@\t\r") else text


def curves_csv(snapshot: Snapshot) -> str:
    """Return all curves as CSV: a row per frequency, a group of columns per channel and method."""
    header = ["frequency (Hz)"]
    columns = [snapshot.frequency]
    for number, label in enumerate(snapshot.channels):
        name, unit = label.name, f"(({label.unit})²/Hz)"
        header.append(f"{name} data {unit}")
        columns.append(snapshot.data_psd[:, number])
        for method, noise in snapshot.results.items():
            header += [f"{name} {method} {what} {unit}" for what in ("noise", "low", "high")]
            header.append(f"{name} {method} cov")
            columns += [
                values[:, number] for values in (noise.noise_psd, noise.low, noise.high, noise.cov)
            ]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(map(_not_a_formula, header))
    for row in np.stack(columns, axis=1):
        writer.writerow(["" if np.isnan(value) else repr(float(value)) for value in row])
    return text.getvalue()
