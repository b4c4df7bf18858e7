"""The child that reads files which may hold it up: ``python -m daq.recording.trial_child``.

Its arguments are a task, ``open`` or ``verify``, and files. For each file it prints a line of JSON;
before it, a line with a point for each part that was read. It may hang or be killed at any file.
"""

from __future__ import annotations

import json
import logging
import sys
from itertools import chain
from pathlib import Path
from typing import Any

from daq.errors import HuddleError
from daq.recording.manifest import RESULTS_MANIFEST, items
from daq.recording.reader import Recording
from daq.recording.repair import verify
from daq.recording.storage.opening import open_file


def main() -> None:
    """Carry out the task on each file."""
    logging.disable()
    task, *paths = sys.argv[1:]
    _progress()
    for path in map(Path, paths):
        try:
            found = _opened(path) if task == "open" else _verified(path)
        except (HuddleError, OSError) as error:
            found = {"error": str(error)}
        print(json.dumps(found), flush=True)


def _opened(path: Path) -> dict[str, Any]:
    """Read all that a reader reads before the samples."""
    with Recording.open(path, tried=True) as recording:
        recording.results()
    with open_file(path) as file:
        for _ in chain(items(file), items(file, RESULTS_MANIFEST)):
            _progress()
    return {"opened": True}


def _verified(path: Path) -> dict[str, Any]:
    report = verify(path, progress=_progress, tried=True)
    damaged = [sensor.name for sensor in report.sensors if sensor.bad_blocks]
    return {
        "intact": report.intact,
        "closed": report.closed,
        "damaged": [*damaged, *report.damaged_tables, *report.changed],
        "root_sha256": report.root_sha256,
    }


def _progress() -> None:
    print(".", flush=True)


if __name__ == "__main__":
    main()
