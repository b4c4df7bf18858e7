"""The check list before a test in sentences, as lines and as JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.text import Text

from daq.preflight.findings import Check, CheckFinding, CheckOutcome, CheckRow, Problem
from estimator.checks.sensitivities import CAUSES
from estimator.wording import listed

MARKS: Mapping[CheckOutcome, str] = {
    CheckOutcome.PASSED: "✓",
    CheckOutcome.FAILED: "✗",
    CheckOutcome.NOT_CHECKED: "?",
}
STYLES: Mapping[CheckOutcome, str] = {
    CheckOutcome.PASSED: "green",
    CheckOutcome.FAILED: "bold #ff6b6b",
    CheckOutcome.NOT_CHECKED: "yellow",
}
PASSED: Mapping[Check, str] = {
    Check.PORTS: "every sensor answers and sends samples",
    Check.IDENTITY: "the serial numbers are those of the bench file",
    Check.RATES: "the sampling rates are those of the bench file, and no samples are missing",
    Check.CHANNELS: "every channel changes",
    Check.LEVELS: "no channel is near its full scale",
    Check.HUM: "no channel hums",
    Check.MOTION: "all sensors share one motion",
    Check.SENSITIVITIES: "within 5 % of the common motion",
    Check.POLARITY: "no channel is reversed or swapped",
    Check.CLOCKS: "no clock is off by more than 1000 ppm",
    Check.DISK: "there is room for the recording",
}
SENTENCES: Mapping[Problem, str] = {
    Problem.TROUBLE: "{text}",
    Problem.NO_SAMPLES: "{sensor} answers and sends no samples: check its settings",
    Problem.WRONG_DEVICE: "{text}",
    Problem.RATE: "{sensor} sends {value:.5g} samples a second, expected {wanted:g}: correct"
    " sampling_rate",
    Problem.MISSING: "{sensor} misses {value:.0f} samples: check cable and port",
    Problem.CLIPPING: "{sensor} is clipping: reduce the motion, or check its mounting and range",
    Problem.WRAPPING: "the counts of {sensor}.{channel} wrap at {value:.0f} bits: reduce the"
    " motion, choose a larger range, or correct the data type",
    Problem.REPEATS: "{sensor} repeats its values: it refreshes at {value:.3g} Hz, polled at"
    " {wanted:g} Hz; let it refresh faster",
    Problem.STUCK_BIT: "{sensor}.{channel} lacks codes: {value:.1f} bits of its range are used;"
    " check the digitizer",
    Problem.NEAR_FULL_SCALE: "{sensor}.{channel} reaches {value:.0%} of its full scale: reduce the"
    " motion, or choose a larger range",
    Problem.DEAD: "{sensor}.{channel} does not change: nothing is connected, or it is dead",
    Problem.HUM: "{sensor}.{channel} hums: most of its power is at {value:.0f} Hz, and the other"
    " sensors have less; check grounding and shielding",
    Problem.CLOCK: "{sensor}: its clock is off by {value:+.0f} ppm: correct sampling_rate if that"
    " stays",
    Problem.SWAPPED: "{sensor}: {channel} have traded places: check wiring, or the order of"
    " channels",
    Problem.REVERSED: "{sensor}.{channel} is reversed against the other sensors: check its wiring",
    Problem.REFLECTED: "{sensor}: channels are swapped or reversed, no way to turn it explains its"
    " motion: check wiring, or the order of channels",
    Problem.ALONE: "{sensor} shares no motion with the other sensors: is it on the same floor?",
    Problem.DISK_FULL: "{free} are free, the recording takes {needed}: make room",
    Problem.OFFSET: "not certain, because {sensor} measures {value:.3g} m/s² at rest, expected 9.8"
    " (gravity) or 0: check sensitivity and unit",
    Problem.COMMON_HUM: "not certain, because all sensors have most of {channel} at {value:.0f} Hz:"
    " hum, or motion of machines ({sensor})",
    Problem.NO_SERIAL_NUMBER: "not checked, because there is no serial number of {sensor}",
    Problem.NOT_IN_FILE: "not checked, because the bench file has no serial number of {sensor}:"
    " huddle check --write adds it",
    Problem.NO_FULL_SCALE: "not checked, because the full scale of {sensor} is not known: give"
    " full_scale in the data_sheet of the bench file",
    Problem.UNCOUNTED: "rates as in the bench file; not checked whether samples are missing,"
    " because there is no counter and no time of {sensor}",
    Problem.UNEVEN: "not checked, because the samples of {sensor} arrive unevenly",
    Problem.LEFT_OUT: "the other checks leave out {sensor}{moot}",
    Problem.TOO_FEW_SAMPLES: "not checked, because there are too few samples of {sensor}",
    Problem.TOO_SLOW: "not checked, because of the low sampling rate of {sensor}",
    Problem.TOO_FEW_SENSORS: "not checked, because fewer than three sensors can be compared",
    Problem.NOT_COMPARABLE: "not checked, because the motion of {sensor} cannot be compared: it is"
    " too weak, or its channels are others",
    Problem.DISK_UNKNOWN: "not checked, because the free space is not known",
}
MERGED = frozenset(
    {
        Problem.NO_SERIAL_NUMBER, Problem.NOT_IN_FILE, Problem.NO_FULL_SCALE, Problem.UNEVEN,
        Problem.UNCOUNTED, Problem.LEFT_OUT, Problem.TOO_FEW_SAMPLES, Problem.TOO_SLOW,
        Problem.NOT_COMPARABLE,
    }
)  # fmt: skip
"""Problems of several sensors that are one line."""


def sentence(finding: CheckFinding, sensors: Sequence[str] = ()) -> str:
    """Return a finding with what to do; `sensors` are all of which it is true."""
    name = f"{finding.sensor}.{finding.channel}" if finding.channel else finding.sensor
    if finding.problem is Problem.SENSITIVITY:
        cause = "" if finding.cause is None else f" ({CAUSES[finding.cause]})"
        others = listed(finding.against) if finding.against else "the others, which do not agree"
        return f"{name} reads {finding.value:.3g} of {others}{cause}: correct its sensitivity"
    text = SENTENCES[finding.problem].replace("{sensor}.{channel}", "{name}")
    return text.format(
        name=name,
        sensor=listed(sensors or [finding.sensor]),
        channel=finding.channel,
        value=finding.value,
        wanted=finding.wanted,
        text=finding.text,
        moot=f"; not made: {finding.text}" if finding.text else "",
        free=_size(finding.value),
        needed=_size(finding.wanted),
    )


def lines(rows: Iterable[CheckRow], *, failures_only: bool = False) -> list[Text]:
    """Return the list, a line a row; what cannot be checked of several sensors is one line."""
    groups: dict[object, list[CheckRow]] = {}
    for number, row in enumerate(rows):
        key: object = number
        if row.finding is not None and row.finding.problem in MERGED:
            key = row.check, row.finding.problem
        if not failures_only or row.outcome is CheckOutcome.FAILED:
            groups.setdefault(key, []).append(row)
    found = []
    for group in groups.values():
        mark = f"{MARKS[group[0].outcome]} ", STYLES[group[0].outcome]
        found.append(Text.assemble(mark, f"{group[0].check:<13} ", _text(*group)))
    return found


def document(rows: Iterable[CheckRow]) -> list[dict[str, Any]]:
    """Return the rows for JSON, each with its sentence."""
    return [
        {
            "check": row.check,
            "outcome": row.outcome,
            "text": _text(row),
            "finding": row.finding,
        }
        for row in rows
    ]


def _text(*rows: CheckRow) -> str:
    """Return a row, or several that are one line, in a sentence."""
    findings = [row.finding for row in rows if row.finding is not None]
    if not findings:
        return PASSED[rows[0].check]
    return sentence(findings[0], [each.sensor for each in findings])


def _size(n_bytes: float) -> str:
    return f"{n_bytes / 1e9:.3g} GB"
