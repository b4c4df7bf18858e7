"""What stands in a report, in which order."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby
from typing import TYPE_CHECKING

from daq.bench.durations import format_duration
from daq.bench.estimate_settings import OPTIONS, Option, table_keys
from daq.estimation.settings import Settings
from daq.results.calibration import Calibration, calibrate
from daq.results.decision.conformity import conformity, with_rule
from estimator.errors import InsufficientDataError
from estimator.wording import span
from tui.output import calibration as shown
from tui.page.blocks import KeyValues, Paragraph, Part, Report, Section, Signatures
from tui.page.table import Table
from tui.report import certificate, evidence
from tui.report.noise import result_section, verdict
from tui.report.parameters import parameters_section
from tui.report.uncertainty import uncertainty_section
from tui.wording.formatting import is_known, local_time, utc_time

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daq.bench.channel import Channel
    from daq.bench.masks.mask import Mask
    from daq.bench.model import Bench
    from daq.clocks.clock_model import ClockState
    from daq.estimation.snapshot import Snapshot
    from daq.recording.sensor_record import SensorRecord
    from daq.results.result import Result
    from daq.results.sources import Source


def calibration_section(result: Result) -> Section | None:
    """Return the calibration against the reference; None where no sensors can be compared."""
    snapshot = result.snapshot
    try:
        found = calibrate(result, result.bench)
    except InsufficientDataError:
        return None
    sensitivities = tuple(each for each in found.budgets if each.quantity != "noise")
    found = replace(found, budgets=sensitivities, without_noise=())  # Uncertainty has the noise
    budgets = found.whole_band("sensitivity")
    tables = [
        ("Sensitivity, delay and misalignment", shown.sensitivity_table(found, snapshot)),
        ("Relative response, cross-axis included", shown.matrix_table(found, snapshot)),
        ("Rotation about the axes of the reference", shown.angle_table(found, snapshot)),
        ("Uncertainty budget of the sensitivities", shown.budget_table(budgets)),
    ]
    first, *remarks = shown.remarks(found, snapshot)
    parts: list[Part] = [Paragraph(f"{shown.title(found, snapshot)}. {first}")]
    if found.certificates:
        parts.append(_certificates(found, snapshot))
    parts += [replace(table, title=name) for name, table in tables if table.rows]
    parts += [Paragraph(line, "quiet") for line in (shown.legend(budgets), *remarks)]
    return Section("Calibration", tuple(parts))


def _certificates(found: Calibration, snapshot: Snapshot) -> KeyValues:
    """Return the certificates of the reference, a line each."""
    name = snapshot.sensor_names[found.reference]
    labels = [label for label in snapshot.channels if label.sensor == name]
    rows = []
    for label, each in zip(labels, found.certificates, strict=True):
        said = f"{each.value:.8g} counts per unit, U = {each.expanded_uncertainty:.3g}"
        said += f" (k = {each.k:g}), {'date not given' if each.date is None else each.date}"
        said += f", {each.number}" if each.number else ""
        rows.append((f"Certificate of {label.name}", said))
    return KeyValues(tuple(rows))


LONG_NAME = 8
"""Letters of a channel with its sensor, up to which a table has both in a cell."""
_STATES = {
    "closed": "closed",
    "growing": "still being written",
    "continued": "refused by the disk and continued in another file",
    "left-open": "not closed: its recorder was killed",
}


def report_of(
    result: Result,
    models: Sequence[Mask] = (),
    *,
    issue: certificate.Issue | None = None,
    about: Bench | None = None,
) -> Report:
    """Return the whole report.

    Parameters
    ----------
    result : Result
        A finished estimate of recordings.
    models : sequence of Mask
        Noise models to show beside the noise.
    issue : Issue, optional
        Of a certificate; without it the report is a draft.
    about : Bench, optional
        Where laboratory, customer and sensors are described; default: the recorded bench.
    """
    snapshot, found = result.snapshot, result.sources
    bench = found[0].bench
    sentence = verdict(result)
    states = {source.state for source in found}
    if "growing" in states or (not snapshot.closed and states == {"closed"}):
        sentence = Paragraph(f"Still running, preliminary. {sentence.text}", "doubtful")
    elif "left-open" in states:
        text = (
            f"Of a recording whose recorder was killed (huddle repair closes it). {sentence.text}"
        )
        sentence = Paragraph(text, "bad" if sentence.tone == "bad" else "doubtful")
    about = bench if about is None else about
    by_rule = with_rule(bench, about)
    facts = result.facts
    rule = None if by_rule is None else by_rule.certificate
    sections = [  # the result comes first; what it rests on follows
        result_section(result, models, conformity(by_rule, result), rule),
        evidence.facts_section(facts),
        uncertainty_section(result, about),
        parameters_section(result),
        calibration_section(result),
        evidence.model_test_section(result),
        evidence.alignment_section(result),
        evidence.clocks_section(result),
        evidence.events_section(result),
        Section(
            "Laboratory, customer and test",
            (
                *certificate.parties(found, about, issue),
                *_recordings(found),
                Paragraph(f"{certificate.NOT_VERIFIED} {certificate.SCOPE}", "quiet"),
            ),
        ),
        Section(
            "Sensors and conditions",
            (
                *_sensors(snapshot, found, about),
                *certificate.conditions_stated(found, about, result.settings),
            ),
        ),
        _settings_section(result),
        Section(
            "Signed off",
            (Signatures(("Name", "Date", "Signature", "Remarks")),),
        ),
    ]
    start = found[0].started
    name = found[0].path.stem if bench is None else bench.name
    return Report(
        title="Calibration certificate: self-noise" if issue else "Calibration report: self-noise",
        subtitle=f"Huddle test {name}" + (f", {utc_time(start)}" if is_known(start) else ""),
        verdict=sentence,
        sections=tuple(
            replace(by_sensor(each, snapshot), is_annex=number > 0)
            for number, each in enumerate(sections)
            if each is not None
        ),
        notices=(*certificate.notices(found, result, about, issue), *evidence.invalidating(facts)),
        watermark=certificate.watermark(found, issue),
        number="" if issue is None else issue.name,
    )


def by_sensor(section: Section, snapshot: Snapshot) -> Section:
    """Return a section in whose tables long names of sensors have rows of their own."""
    sensors = {label.name: (label.sensor, label.channel) for label in snapshot.channels}
    if max(map(len, sensors)) <= LONG_NAME:
        return section
    parts = (
        _grouped(part, sensors) if isinstance(part, Table) and part.header[0] == "channel" else part
        for part in section.parts
    )
    return replace(section, parts=tuple(parts))


def _grouped(table: Table, sensors: Mapping[str, tuple[str, str]]) -> Table:
    """Return a table of channels, those of one sensor that follow each other under its name."""
    order = [
        sensor for sensor, _ in groupby(sensors.get(row[0], ("", ""))[0] for row in table.rows)
    ]
    if 2 * len(order) > len(table.rows):  # sorted by something else, or a channel each
        return table
    rows: list[tuple[str, ...]] = []
    before = ""
    for name, *cells in table.rows:
        sensor, channel = sensors.get(name, ("", name))
        if sensor != before:
            rows.append((sensor, *[""] * len(cells)))
        before = sensor
        rows.append((channel, *cells))
    return replace(table, rows=tuple(rows))


def _recordings(found: Sequence[Source]) -> list[Part]:
    """Return what is known of each file."""
    parts: list[Part] = []
    for source in found:
        length = (source.last - source.started).total_seconds()
        size = f"{source.n_bytes / 1e6:.1f} MB, {_STATES[source.state]}"
        parts.append(
            KeyValues(
                (
                    ("Recording", f"{source.path.name} ({size})"),
                    *([("Started", utc_time(source.started))] if len(found) > 1 else []),
                    ("Local time", local_time(source.started, source.bench)),
                    *([("Last sample", utc_time(source.last))] if len(found) > 1 else []),
                    ("Duration", format_duration(round(length))),
                    ("Recorded by", source.recording.software),
                    ("Run", source.recording.run_id),
                    ("Signed with key", source.signed_by or "not signed"),
                    ("SHA-256", source.sha256 or "none: the file is still being written"),
                )
            )
        )
    return parts


def _sensors(
    snapshot: Snapshot, found: Sequence[Source], about: Bench | None
) -> tuple[Table, Table]:
    makers = certificate.manufacturers(about)
    sensors = found[-1].recording.sensors
    clocks = {clock.sensor: clock for clock in snapshot.clocks}
    rows = tuple(
        (
            sensor.name,
            makers.get(sensor.name, "not given"),
            sensor.model or "not given",
            sensor.serial_number or "not given",
            sensor.driver,
            f"{sensor.sampling_rate:.10g}",
            _actual_rate(sensor, clocks.get(sensor.name)),
        )
        for sensor in sensors
    )
    header = (
        "sensor", "manufacturer", "model", "serial number", "driver", "nominal rate (Hz)",
        "actual rate (Hz)",
    )  # fmt: skip
    channels = Table(
        ("sensor", "channels", "sensitivity (counts per unit)", "unit", "response"),
        tuple(row for sensor in sensors for row in _channel_rows(sensor)),
        left=frozenset({0, 1, 3, 4}),
    )
    return Table(header, rows, left=frozenset({0, 1, 2, 3, 4})), channels


def _actual_rate(sensor: SensorRecord, clock: ClockState | None) -> str:
    if clock is None:
        return "?"
    rate = sensor.sampling_rate * (1 + clock.ppm * 1e-6)
    error = sensor.sampling_rate * clock.ppm_std * 1e-6
    # rounded up: nothing is certain to the last digit
    return f"{rate:.6f} ±{max(error, 1e-6):.6f}" if clock.ppm_std > 0 else f"{rate:.6f}"


def _channel_rows(sensor: SensorRecord) -> list[tuple[str, ...]]:
    """Return a row for each kind of channel of a sensor: those alike go together."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for channel in sensor.channels:
        key = (f"{channel.sensitivity:.10g}", channel.unit, _response(channel))
        name = channel.name + (f" ({channel.direction})" if channel.direction else "")
        alike.setdefault(key, []).append(name)
    return [(sensor.name, ", ".join(names), *key) for key, names in alike.items()]


def _response(channel: Channel) -> str:
    if channel.auxiliary:
        return "auxiliary: recorded, not estimated"
    if channel.response is None:
        return "flat"
    response = channel.response
    return f"{response.described}; sensitivity at {response.frequency:g} Hz"


def _settings_section(result: Result) -> Section:
    """Return every option of the estimate, and what follows from them."""
    snapshot, settings = result.snapshot, result.settings
    rate = 2 * float(snapshot.frequency[-1])
    rows = [
        ("Methods", ", ".join(snapshot.results) or ", ".join(settings.methods)),
        ("Time used", _time_used(result)),
        ("Common grid", f"{rate:.10g} Hz"),
        ("Frequency resolution", f"{1 / settings.segment:.4g} Hz between frequencies"),
        ("Segments used", f"{snapshot.n_segments}, n = {snapshot.n_effective:.1f} effective"),
        *([] if settings.band else [("Band of the tables", span(*result.band))]),
        ("Unit", f"{snapshot.unit}; PSD one-sided, in ({snapshot.unit})²/Hz"),
    ]
    usual = Settings()
    same: dict[bool, list[str]] = {True: [], False: []}
    for key, name in table_keys().items():
        value = getattr(settings, name)
        if value != getattr(usual, name):
            rows.append((f"[estimate] {key}", _option(OPTIONS[name], value)))
        elif value is None or value in ({}, ()):
            same[False].append(key)
        else:
            same[True].append(f"{key} {_option(OPTIONS[name], value)}")
    text = "[estimate], as by default: {}. Not given: {}."
    parts: list[Part] = [
        KeyValues(tuple(rows)),
        Paragraph(text.format(*(", ".join(each) for each in same.values()))),
    ]
    if snapshot.octaves:
        parts.append(
            Table(
                ("octave", "segment (s)", "segments", "effective averages"),
                tuple(
                    (
                        span(octave.low, octave.high),
                        f"{octave.segment:g}",
                        str(octave.n_segments),
                        f"{octave.n_effective:.1f}",
                    )
                    for octave in snapshot.octaves
                ),
                title="Segments of each octave",
            )
        )
    return Section("Settings of the estimate", tuple(parts))


def _time_used(result: Result) -> str:
    settings = result.settings
    text = format_duration(round(result.snapshot.elapsed))
    if settings.start is not None:
        text += f", from {utc_time(settings.start)}"
    if settings.end is not None:
        text += f", to {utc_time(settings.end)}"
    return text


def _option(option: Option, value: object) -> str:
    """Return the value of an option as in the bench file."""
    if value is None or value in ({}, ()):
        return "not given"
    if option.is_switch:
        return "yes" if value else "no"
    if option.metavar == "TIME" and isinstance(value, float):
        return format_duration(value)
    text = option.text(value)
    return text if isinstance(text, str) else ", ".join(text)
