"""What a recording of :mod:`tests.torture.recording_program` must hold after a crash."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from daq.recording.reader import Recording
from daq.recording.repair import repair, verify
from daq.recording.sensor_record import SensorRecord
from daq.recording.storage.journal import journal_path
from tests.torture.recording_program import CREATED, POLLED, counts_of, instants_of

Acknowledged = dict[str, Any]
NOTHING: Acknowledged = {"sensors": {}, "events": 0}


def last_acknowledged(content: bytes) -> Acknowledged:
    """Return the last whole line of what the program acknowledged."""
    lines = content.split(b"\n")[:-1]
    return json.loads(lines[-1]) if lines else NOTHING


def fault_after_repair(path: Path, acknowledged: Acknowledged) -> str:
    """Repair a recording; return what is wrong with it then, or nothing.

    Everything acknowledged must be there, every sample must be the one that was recorded, and a
    plain HDF5 reader must open the file.
    """
    if not path.exists():
        return "no recording" if acknowledged["sensors"] else ""
    report = repair(path, now=CREATED)
    with h5py.File(path, "r") as file:
        is_closed = file["committed"][-1, 1] == 1
    if not (is_closed and report.closed and report.intact and verify(path).intact):
        return "damaged after repair"
    if journal_path(path).exists():
        return "journal left"
    with Recording.open(path) as recording:
        if len(recording.events) < acknowledged["events"]:
            return "events lost"
        faults = (_fault(sensor, acknowledged) for sensor in recording.sensors)
        return next(filter(None, faults), "")


def _fault(sensor: SensorRecord, acknowledged: Acknowledged) -> str:
    rows, blocks, gaps = acknowledged["sensors"].get(sensor.name, (0, 0, 0))
    if sensor.n_samples < rows or len(sensor.blocks) < blocks or len(sensor.gaps) < gaps:
        return f"rows of {sensor.name} lost"
    found = sensor.counts()
    for block in sensor.blocks[:]:
        part = slice(block["first_row"], block["first_row"] + block["n_samples"])
        first, n = int(block["first_sample"]), int(block["n_samples"])
        if not np.array_equal(found[part], counts_of(sensor.name, first, n)):
            return f"other samples of {sensor.name}"
        if sensor.name == POLLED:
            instants = sensor.instants_ns(part.start, part.stop)
            if not np.array_equal(instants, instants_of(first, n)):
                return f"other instants of {sensor.name}"
    return ""
