"""Restores a damaged database of runs: from its newest copy, and from the recordings.

Theory of operation
-------------------
The database is copied once a day. A damaged one is moved away, never repaired: SQLite may find some
of its rows wrong without a sign. Runs that the copy does not have, or not as done, are read from
their recordings. The last recording of a run that is done has the run and its noise as an attribute
of ``/results``. A run that is not done has a mark beside its recording; its entry is the one that
was due when the recording began.
"""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

from daq.errors import HuddleError
from daq.recording.reader import Recording
from daq.recording.storage.locking import is_being_written
from tui.service.planning import GRACE, missed_runs
from tui.service.records.parts import identities, mark_of
from tui.service.records.run_state import RUN, Run, RunState

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daq.bench.model import Bench
    from tui.service.records.store import RunStore

EMPTIED = "it has no runs, and there is no copy"
_LOGGER = logging.getLogger(__name__)


def heal(store: RunStore, bench: Bench, now: datetime) -> bool:
    """Restore the database if it is damaged; return whether it was.

    Raises
    ------
    StoreError
        If the disk refuses it.
    """
    damage = damage_of(store)
    if not damage:
        return False
    is_lost = damage == EMPTIED
    moved, copy = (None, None) if is_lost else store.restore(now)
    begun = RunState.RECORDING, RunState.ESTIMATING
    unfinished = {part for run in store.runs(None, *begun) for part in run.parts}
    n_found = 0
    for run in _runs_of_recordings(bench, store.parts() - unfinished, unfinished):
        store.save(run)
        over = run.parts if run.is_over else ()
        found = identities(bench.recording_directory / part for part in over)
        store.set_identities(run, list(found))
        n_found += 1
    if is_lost and not n_found:  # a new one
        return False
    _LOGGER.error(
        "%s: damaged (%s); %s; restored from %s and %d recordings",
        store.path,
        damage,
        "nothing was moved" if moved is None else f"moved to {moved.name}",
        "no copy" if copy is None else f"the copy {copy.name}",
        n_found,
    )
    return True


def damage_of(store: RunStore) -> str:
    """Return what is wrong with the database, `EMPTIED` if it has no runs, or nothing."""
    return store.damage() or ("" if store.runs(last=1) else EMPTIED)


def _runs_of_recordings(bench: Bench, known: set[str], unfinished: set[str]) -> Iterator[Run]:
    """Yield the runs of recordings that no run has, or that are done, the newest first."""
    for path in sorted(bench.recording_directory.glob("*.h5"), reverse=True):
        if path.name not in known:
            try:
                run = _run_of(bench, path)
            except (HuddleError, OSError, KeyError, TypeError, ValueError) as error:
                _LOGGER.warning("%s: no run can be read from it: %s", path, error)
                continue
            if run is not None and (run.is_over or path.name not in unfinished):
                known.update(run.parts)
                yield run


def _run_of(bench: Bench, path: Path) -> Run | None:
    """Return the run of a recording; None if the service did not make it."""
    with Recording.open(path) as recording:
        created, caveats = recording.created.astimezone(UTC), recording.caveats
        about = recording.about_results()
        own = recording.bench
    if RUN in about:
        run = replace(Run.of_record(json.loads(about[RUN])), caveats=caveats)
        return run if path.name in run.parts else None
    if not mark_of(path).exists() or own is None or own.name != bench.name:
        return None
    due, _ = missed_runs(bench, created - GRACE, created + timedelta(seconds=1), lambda _: False)
    if not due:
        return None
    state = RunState.RECORDING if is_being_written(path) else RunState.ESTIMATING
    run = due[-1].to(RunState.RECORDING, started=created, parts=(path.name,))
    return run if state is RunState.RECORDING else run.to(state)
