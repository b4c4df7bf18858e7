"""What the files of a run that is done must hold."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from daq.errors import HuddleError
from daq.recording.reader import Recording
from daq.recording.repair import verify
from daq.recording.storage.journal import journal_path


def fault_of_recording(path: Path, truth: Path | None = None) -> str:
    """Return what is wrong with a recording: not closed, damaged, or with other samples."""
    try:
        report = verify(path)
    except HuddleError as error:
        return str(error)
    if not (report.intact and report.closed) or journal_path(path).exists():
        return f"{path.name}: not intact and closed"
    if truth is not None:
        with Recording.open(path) as found, Recording.open(truth) as whole:
            for sensor in found.sensors:
                expected = whole.sensor(sensor.name).counts()[: sensor.n_samples]
                if not np.array_equal(sensor.counts(), expected):
                    return f"{path.name}: other samples of {sensor.name}"
    return ""


def faults_of_results(parts: Sequence[Path], *, report: bool = False) -> list[str]:
    """Return which results of a run are not there, or cut in the middle.

    They stand with the last part that holds a segment: a part that a kill or a power cut ended
    after a few seconds is left out of the estimate.
    """
    holding = [part for part in parts if part.with_suffix(".json").exists()]
    recording = (holding or parts)[-1]
    found = []
    with Recording.open(recording) as opened:
        if not opened.result_attributes():
            found.append(f"{recording.name}: no results")
    try:
        json.loads(recording.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        found.append(f"{recording.name}: JSON: {error}")
    page = recording.with_suffix(".html")
    if report and not (page.exists() and page.read_bytes().rstrip().endswith(b"</html>")):
        found.append(f"{recording.name}: no whole report")
    return found
