"""A finished estimate as a table, as JSON and as CSV."""

from __future__ import annotations

import csv
import io
from dataclasses import asdict, is_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from daq.results.band_summary import band_of, channel_means, highest_known
from daq.timing.clock_model import ClockSource
from estimator.self_noise.band_means import band_edges
from estimator.self_noise.result import Flag
from tui.output.formatting import clock_time, level, level_with_error, several, utc

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


def result_title(snapshot: Snapshot, settings: Settings) -> str:
    """Return what the table of results holds."""
    low, high = band_of(settings, snapshot)
    wanted = high if settings.band is None else settings.band[1]
    asked = f" ({wanted:.3g} was asked for)" if wanted > high else ""
    return (
        f"[b]Self-noise, mean over {low:.3g} to {high:.3g} Hz[/b]{asked}, "
        f"dB re 1 ({snapshot.unit})²/Hz, with its 95 % interval"
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
        row = [label.sensor, label.channel, "no signal" if power == 0 else level(power)]
        for means in columns:
            mean = means[number]
            row.append(level_with_error(float(mean.mean[0]), float(mean.high[0])))
        table.add_row(*row)
    return table


def remarks(snapshot: Snapshot) -> list[str]:
    """Return what must be said beside the numbers, in plain words."""
    taken = (
        f"{several(snapshot.n_segments, 'segment')} ({snapshot.n_effective:.0f} effective averages)"
    )
    lines = [f"{taken} from {clock_time(snapshot.elapsed)} since {utc(snapshot.start_utc_ns)}"]
    if snapshot.octaves:
        lowest, highest = snapshot.octaves[0], snapshot.octaves[-1]
        if lowest is highest:
            lines.append("octaves: too few segments as yet for longer ones at lower frequencies")
        else:
            lines[0] += f" above {highest.low:.3g} Hz"
            lines.append(
                f"octaves below have longer segments, up to {lowest.segment:.4g} s"
                f" ({lowest.n_effective:.0f} effective averages) below {lowest.high:.3g} Hz"
            )
        disturbed = [
            f"{octave.left_out['transient']} at {octave.low:.3g}–{octave.high:.3g} Hz"
            for octave in snapshot.octaves
            if octave.left_out.get("transient")
        ]
        if disturbed:
            lines.append(f"segments left out that something disturbed: {', '.join(disturbed)}")
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
        rates = ", ".join(f"{clock.sensor} {clock.ppm:+.1f} ppm" for clock in fitted)
        left = snapshot.diagnostics["synchronisation"]["residual"]  # between them
        worst = max(left[clock.sensor] for clock in fitted) * 1e6
        within = f"{worst:.0f}" if worst > 10 else f"{worst:.1f}"
        lines.append(f"clocks {rates}, aligned to about {within} µs".replace("-", "−"))
    if (limit := highest_known(snapshot)) < snapshot.frequency[-1]:
        lines.append(f"above {limit:.4g} Hz nothing can be said: samples have been resampled")
    lines += faulty_channels(snapshot)
    if "two-channel" in snapshot.results:
        lines.append(
            "two-channel: takes like channels to point the same way, and their gains as given "
            "(--gain) or alike"
        )
    named = any("share of frequencies" in a.numbers for a in snapshot.diagnostics.get("advice", ()))
    for method, noise in snapshot.results.items():
        lines += flagged(snapshot, method, besides=_NAMED if named else 0)
        lines += unresolved(snapshot, method)
        negative = int(np.sum(noise.noise_psd[1:-1] <= 0))
        if negative:
            lines.append(
                f"{method}: {negative} of {noise.noise_psd[1:-1].size} values came out at or below "
                "zero, and are kept so"
            )
    lines += [f"{method}: {reason}" for method, reason in snapshot.refused.items()]
    return lines


def faulty_channels(snapshot: Snapshot) -> list[str]:
    """Return which channels are cut off, or were dead for a while, and what to do."""
    lines = []
    clipped = snapshot.diagnostics.get("clipped")
    if clipped:
        names = ", ".join(f"{name} ({100 * share:.2g} %)" for name, share in clipped.items())
        lines.append(
            f"clipped: {names} of the samples stand at the largest or smallest count there is: the "
            "noise of these channels comes out too high. Use a larger range, or less motion"
        )
    still = snapshot.diagnostics.get("stood_still")
    if still:
        names = ", ".join(f"{name} (for {seconds:.2g} s)" for name, seconds in still.items())
        lines.append(
            f"dead for a while: {names} stood at one count and moved otherwise: the motion missing "
            "there counts as noise. Leave that time out (--reject; --start and --end for minutes), "
            "and look at cable and supply"
        )
    return lines


def left_out(snapshot: Snapshot) -> str:
    """Return why segments were left out, to follow their number."""
    words = {
        "gap": "where a sensor has a gap",
        "clipped": "where a sensor is at the end of its range",
        "transient": "that something disturbed",
    }
    counts = {reason: count for reason, count in snapshot.left_out.items() if count}
    if len(counts) == 1:
        return " " + words[next(iter(counts))]
    return ": " + ", ".join(f"{count} {words[reason]}" for reason, count in counts.items())


_NAMED = Flag.DEAD_CHANNEL | Flag.DUPLICATE  # with its advice, once for all methods


def flagged(snapshot: Snapshot, method: str, *, besides: int = 0) -> list[str]:
    """Return which channels have frequencies at which nothing can be said, and why.

    ``besides`` are flags that have been named already.
    """
    words = {
        Flag.DEAD_CHANNEL: "no signal",
        Flag.DUPLICATE: "a copy of another channel",
        Flag.NOT_FINITE: "not finite",
        Flag.INVALID: "no cross-spectral matrix (not Hermitian, negative or too coherent)",
        Flag.SINGULAR: "nothing can be said, as other channels are missing or do not move enough "
        "to compare with (the matrix is singular)",
        Flag.NO_COUNTERPART: "the other sensors have too few channels to compare with",
        Flag.NOT_CONVERGED: "the iteration did not reach the maximum",
    }
    flags = snapshot.results[method].flags[snapshot.frequency <= highest_known(snapshot)]
    flags = flags[1:-1] & ~besides
    lines = []
    for flag, why in words.items():
        counts = ((flags & flag) != 0).sum(axis=0)
        if counts.any():
            names = ", ".join(
                f"{label.sensor}.{label.channel}"
                for label, count in zip(snapshot.channels, counts, strict=True)
                if count
            )
            most = counts.max()
            at = "all frequencies" if most == len(flags) else f"{most} of {len(flags)} frequencies"
            lines.append(f"{method}: {names}: {why}, at {at}")
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
        f"{frequency[-1]:.3g} Hz) fewer averages than the weak motion there needs: some of it may "
        f"be left in the noise, by up to about {100 * float(np.median(left_in)):.2g} % of it. "
        "Record longer to take it out"
    )
    return [line]


def result_document(snapshot: Snapshot, method: str) -> dict[str, Any]:
    """Return one method's result as the JSON that ``--json`` writes (design.md)."""
    noise = snapshot.results[method]
    data = snapshot.data_psd
    return {
        "method": method,
        "segments": snapshot.n_segments,
        "effective_averages": snapshot.n_effective,
        "frequency_hz": snapshot.frequency.tolist(),
        "channels": [
            {
                "sensor": label.sensor,
                "channel": label.channel,
                "unit": label.unit,
                "data_psd": data[:, column].tolist(),
                "noise_psd": noise.noise_psd[:, column].tolist(),
                "noise_psd_low": noise.low[:, column].tolist(),
                "noise_psd_high": noise.high[:, column].tolist(),
                "cov": noise.cov[:, column].tolist(),
                "flags": noise.flags[:, column].tolist(),
            }
            for column, label in enumerate(snapshot.channels)
        ],
        "diagnostics": _diagnostics(snapshot),
    }


def document(snapshot: Snapshot) -> dict[str, Any]:
    """Return the JSON of a result: of its one method, or of all of them under ``results``."""
    documents = [result_document(snapshot, method) for method in snapshot.results]
    return documents[0] if len(documents) == 1 else {"results": documents}


def _diagnostics(snapshot: Snapshot) -> dict[str, Any]:
    return {
        "elapsed": snapshot.elapsed,
        "dropped_segments": snapshot.n_dropped,
        "left_out": snapshot.left_out,
        "octaves": [asdict(octave) for octave in snapshot.octaves],
        "flags": {flag.name: flag.value for flag in Flag},
        "start_utc_ns": snapshot.start_utc_ns,
        "closed": snapshot.closed,
        "refused": snapshot.refused,
        "sensors": [asdict(sensor) for sensor in snapshot.sensors],
        "clocks": [asdict(clock) for clock in snapshot.clocks],
        "drift": snapshot.drift.tolist(),
    } | {key: plain(value) for key, value in snapshot.diagnostics.items()}


def plain(value: Any) -> Any:  # noqa: ANN401 - any result of a diagnostic
    """Return dataclasses and arrays as what JSON knows."""
    if is_dataclass(value) and not isinstance(value, type):
        value = {name: getattr(value, name) for name in value.__dataclass_fields__}
    if isinstance(value, np.ndarray | np.generic):
        if np.iscomplexobj(value):
            value = {"real": value.real, "imag": value.imag}
        else:
            return value.tolist()
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return value


def curves_csv(snapshot: Snapshot) -> str:
    """Return all curves as CSV: a row per frequency, a group of columns per channel and method."""
    header = ["frequency (Hz)"]
    columns = [snapshot.frequency]
    for number, label in enumerate(snapshot.channels):
        name, unit = f"{label.sensor}.{label.channel}", f"(({label.unit})²/Hz)"
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
