"""Which runs are removed, and how: recording, results and reports together.

A run is removed only when it is done: never one that is recorded, or has no result, or is pinned.
Its row and its noise stay in the database. Recordings that the service did not make are not
touched.
"""

from __future__ import annotations

import logging
import shutil
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

from daq.errors import HuddleError, RecordingError
from daq.recorder.retention import remove_run
from daq.recording.storage.locking import is_being_written
from tui.service.records.run_state import Run, RunState

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from daq.bench.model import Bench
    from tui.service.records.store import RunStore

_LOGGER = logging.getLogger(__name__)
MIN_KEPT_RUNS = 3
"""Number of the newest runs that neither age nor a full disk removes."""


def tidy(
    bench: Bench,
    store: RunStore,
    now: datetime,
    *,
    doubt: str = "",
    free: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
) -> list[Run]:
    """Remove the runs that the bench file does not want kept; return them.

    Parameters
    ----------
    bench : Bench
    store : RunStore
    now : datetime
    doubt : str
        Why the clock cannot be believed: then no run is too old.
    free : callable
        Returns the bytes of free space in a folder.

    Raises
    ------
    StoreError
        If the database cannot be used.
    """
    storage, folder = bench.storage, bench.recording_directory
    keep_for = storage.keep_for or bench.recording.retention
    if keep_for is None and storage.keep_runs is None and storage.keep_free is None:
        return []
    done = store.runs(bench.name, RunState.DONE, kept=True)
    removed = []
    for number, run in enumerate(done):
        n_newer = len(done) - 1 - number
        reason = ""
        if storage.keep_runs is not None and n_newer >= storage.keep_runs:
            reason = f"{storage.keep_runs} newer runs are kept"
        elif n_newer >= MIN_KEPT_RUNS and _is_old(run, now, keep_for):
            if doubt:
                _LOGGER.warning("no run is removed for its age: %s", doubt)
                keep_for = None
            else:
                reason = "older than the bench file wants"
        elif n_newer >= MIN_KEPT_RUNS and storage.keep_free is not None:
            found = free(folder)
            if found < storage.keep_free:
                reason = f"{found / 1e6:.0f} MB of free space are too few"
        if not reason or run.pinned:
            continue
        try:
            remove(run, folder)
        except (HuddleError, OSError) as error:
            _LOGGER.error("run %s cannot be removed: %s", run.name, error)  # noqa: TRY400
            continue
        store.set_removed(run, now)
        removed.append(run)
        _LOGGER.info("run %s removed: %s", run.name, reason, extra={"recordings": run.parts})
    return removed


def remove(run: Run, folder: Path) -> None:
    """Remove the files of a run.

    Raises
    ------
    RecordingError, OSError
        If one is being written or cannot be removed.
    """
    paths = [folder / part for part in run.parts]
    written = next((path for path in paths if path.exists() and is_being_written(path)), None)
    if written is not None:
        raise RecordingError(f"{written}: another program is writing it or has it open")
    for path in paths:
        remove_run(path)


def _is_old(run: Run, now: datetime, keep_for: float | None) -> bool:
    return keep_for is not None and run.due < now - timedelta(seconds=keep_for)
