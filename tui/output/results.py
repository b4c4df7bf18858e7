"""A finished estimate as a table with remarks, as arrays and as CSV."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table
from rich.text import Text

from daq.results.band_summary import band_of, channel_means, highest_known
from daq.timing.clock_model import ClockSource
from estimator.diagnostics.advice import Copies, NoSignal
from estimator.self_noise.band_means import band_edges
from estimator.self_noise.result import Flag
from estimator.spectra.segment_rejection import Reason
from tui.output.formatting import clock_time, level, level_with_error, several, signed, utc
from tui.output.vocabulary import FLAG_WORDS, REASONS, WITHOUT_ESTIMATE

if TYPE_CHECKING:
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.results.limits import LimitResult


def limit_line(result: LimitResult) -> str:
    """Return whether a channel meets a mask, in one line."""
    meets = "meets" if result.met else "does not meet"
    return (
        f"{result.sensor}.{result.channel} {meets} {result.limit!r}: {result.method} "
        f"{level(result.noise_psd)} dB at {result.frequency:.3g} Hz, limit "
        f"{level(result.limit_psd)} dB"
    )


def result_title(snapshot: Snapshot, settings: Settings) -> Text:
    """Return what the table of results holds."""
    low, high = band_of(settings, snapshot)
    wanted = high if settings.band is None else settings.band[1]
    asked = f" ({wanted:.3g} was asked for)" if wanted > high else ""
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
        columns.append(channel_means(noise, snapshot.frequency, settings, band))
    inside = slice(*band_edges(snapshot.frequency, band))
    width = np.gradient(snapshot.frequency)[inside]
    data = np.average(snapshot.data_psd[inside], axis=0, weights=width)
    for number, label in enumerate(snapshot.channels):
        power = float(data[number])
        no_signal = FLAG_WORDS[Flag.DEAD_CHANNEL].short
        row = [label.sensor, label.channel, no_signal if power == 0 else level(power)]
        for means in columns:
            mean = means[number]
            row.append(level_with_error(float(mean.mean[0]), float(mean.high[0])))
        table.add_row(*map(Text, row))
    return table


def remarks(snapshot: Snapshot) -> list[str]:
    """Return what must be said beside the numbers."""
    taken = (
        f"{several(snapshot.n_segments, 'segment')} ({snapshot.n_effective:.0f} effective averages)"
    )
    lines = [f"{taken} from {clock_time(snapshot.elapsed)} since {utc(snapshot.start_utc_ns)}"]
    if snapshot.octaves:
        lowest, highest = snapshot.octaves[0], snapshot.octaves[-1]
        if lowest is highest:
            lines.append("octaves: still too few segments for longer ones at lower frequencies")
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
            lines.append(f"disturbed segments left out: {', '.join(disturbed)}")
    if snapshot.n_dropped:
        lines.append(f"{several(snapshot.n_dropped, 'segment')} left out{left_out(snapshot)}")
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
        within = f"{worst:.0f}" if worst > 10 else f"{worst:.1f}"
        lines.append(f"clocks {rates}, aligned to about {within} µs")
    if (limit := highest_known(snapshot)) < snapshot.frequency[-1]:
        lines.append(f"above {limit:.4g} Hz there is no estimate: samples have been resampled")
    lines += faulty_channels(snapshot)
    if "two-channel" in snapshot.results:
        lines.append(
            "two-channel: assumes that like channels point the same way, and that their gains are "
            "as given (--gain) or equal"
        )
    named = any(isinstance(each, NoSignal | Copies) for each in snapshot.diagnostics.advice)
    for method, noise in snapshot.results.items():
        lines += flagged(snapshot, method, besides=_NAMED if named else _NONE)
        lines += unresolved(snapshot, method)
        negative = int(np.sum(noise.noise_psd[1:-1] <= 0))
        if negative:
            lines.append(
                f"{method}: {negative} of {noise.noise_psd[1:-1].size} values are at or below "
                "zero, and are kept"
            )
    lines += [f"{method}: {reason}" for method, reason in snapshot.refused.items()]
    return lines


def faulty_channels(snapshot: Snapshot) -> list[str]:
    """Return which channels are clipped, or were dead for a while, and what to do."""
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
            f"Dead for a while: {names} had a constant count, and a signal otherwise: the motion "
            "missing there counts as noise. Exclude that time (--reject; --start and --end for "
            "minutes), and check the cable and the power supply."
        )
    return lines


def left_out(snapshot: Snapshot) -> str:
    """Return why segments were left out, to follow their number."""
    counts = {reason: count for reason, count in snapshot.left_out.items() if count}
    if len(counts) == 1:
        return " " + REASONS[next(iter(counts))]
    return ": " + ", ".join(f"{count} {REASONS[reason]}" for reason, count in counts.items())


_NONE = Flag(0)
_NAMED = Flag.DEAD_CHANNEL | Flag.DUPLICATE  # with its advice, once for all methods


def flagged(snapshot: Snapshot, method: str, *, besides: Flag = _NONE) -> list[str]:
    """Return which channels have frequencies without a sound estimate, and why.

    ``besides`` are flags that have been named already.
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
    """Return where averages are too few for the motion's strength, and what that does."""
    noise = snapshot.results[method]
    here = (noise.flags[1:-1] & Flag.UNRESOLVED) != 0
    left_in = noise.cov[1:-1][here & np.isfinite(noise.cov[1:-1])]
    if not left_in.size:
        return []
    where = here.any(axis=1)
    frequency = snapshot.frequency[1:-1][where]
    line = (
        f"{method}: at {where.sum()} of {len(where)} frequencies ({frequency[0]:.3g} to "
        f"{frequency[-1]:.3g} Hz) there are too few averages for the weak motion: some of it may "
        f"be left in the noise, up to about {100 * float(np.median(left_in)):.2g} % of it. Record "
        "longer to remove it"
    )
    return [line]


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
    writer.writerow(header)
    for row in np.stack(columns, axis=1):
        writer.writerow(["" if np.isnan(value) else repr(float(value)) for value in row])
    return text.getvalue()
