"""A fault of every kind for each device of the acceptance bench.

What a wire cannot do is left out: TCP delivers bytes whole and in order or not at all, so nothing
changes the LabJack's on the way; and only the LabJack has a buffer to overflow, only the Epson a
16-bit counter (the LabJack's timer wraps every 107 s by itself).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from daq.bench.tables.toml_text import to_toml

FULL_SCALE_E = 83886.0
"""Of the Epson as the bench file says, in counts; the others' lies at the ends of their words."""
KNOCK = 1e8
"""Far beyond any full scale, in counts: what is clipped."""
SPIKE = {"E": 51000.0, "L": 20000.0, "G": 90000.0}
"""0.03 m/s² in counts."""
_SERIAL: dict[str, dict[str, Any]] = {
    "drop": {"count": 3},
    "cut": {"count": 5},
    "corrupt": {"count": 4},
    "checksum": {},
    "garbage": {"count": 40},
    "duplicate": {"count": 2},
    "merge": {},
    "late": {"duration": 0.3},
    "jitter": {"duration": 1.0, "level": 0.05},
    "stall": {"duration": 0.3},
    "spike": {"channel": 0},
    "clip": {"level": FULL_SCALE_E, "channel": 1, "duration": 0.5},
    "dead": {"channel": 2, "duration": 0.5},
    "disconnect": {"duration": 2.0},
    "reset": {},
}
_TCP = {
    kind: keys
    for kind, keys in _SERIAL.items()
    if kind not in {"cut", "corrupt", "checksum", "merge"}
}
SAMPLES_ONLY = ("spike", "clip", "dead")
"""Of these no strike is noted: they are in the samples."""
KINDS: dict[str, dict[str, dict[str, Any]]] = {
    "E": _SERIAL,
    "L": {**_TCP, "overflow": {"duration": 1.5}},
    "G": _SERIAL,
}
"""What strikes each sensor's device, in this order."""


def script(*, begin: float, spacing: float, every: float | None = None) -> list[dict[str, Any]]:
    """Return the fault script.

    Parameters
    ----------
    begin
        World time of the first fault, s.
    spacing
        Between two faults of one device, s; the three devices suffer in turn.
    every
        How often each is repeated, s; not at all if not given.
    """
    faults: list[dict[str, Any]] = [
        {"kind": "wrap", "sensors": ["E"], "at": begin + spacing / 2},
    ]
    for turn, (sensor, kinds) in enumerate(KINDS.items()):
        for place, (kind, keys) in enumerate(kinds.items()):
            at = begin + (place + turn / len(KINDS)) * spacing
            fault = {"kind": kind, "sensors": [sensor], "at": round(at, 3), **keys}
            if kind == "spike":
                fault["level"] = SPIKE[sensor]
            elif kind == "clip":
                faults.append({**fault, "kind": "spike", "level": KNOCK})
                fault["level"] = fault["level"] if sensor == "E" else KNOCK
            faults.append(fault)
    if every is not None:
        faults = [
            fault if fault["kind"] == "wrap" else {**fault, "every": every} for fault in faults
        ]
    return faults


def write(path: Path, faults: list[dict[str, Any]]) -> None:
    """Write it as ``huddle devices --faults`` reads it."""
    path.write_text(to_toml({"faults": faults}), encoding="utf-8")
