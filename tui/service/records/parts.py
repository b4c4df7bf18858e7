"""Which files a recording of a run has: the recorder goes on in another if the disk refuses one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import takewhile
from pathlib import Path

from daq.errors import HuddleError
from daq.recording.reader import Recording
from daq.recording.signing import identity
from daq.recording.storage.journal import journal_path
from daq.recording.storage.names import continuation_names


def with_continuations(parts: Iterable[Path]) -> list[Path]:
    """Return these files, each followed by those in which its recorder went on."""
    found: list[Path] = []
    for part in parts:
        found.append(part)
        before, _ = _run_ids(part) or (None, "")
        for path in takewhile(Path.exists, continuation_names(part)):
            ids = _run_ids(path)
            if ids is None:  # a torn file is taken for a continuation
                is_next = journal_path(path).exists()
            else:
                is_next = bool(ids[1]) and before in {None, ids[1]}
            if is_next:
                found.append(path)
                before = None if ids is None else ids[0]
    return list(dict.fromkeys(found))


def mark_of(recording: Path) -> Path:
    """Return the mark beside a recording of the service whose run is not over; also its lock."""
    return recording.with_name(f".{recording.name}.run")


def identities(recordings: Iterable[Path]) -> Iterator[tuple[str, str, str]]:
    """Yield file name, run id and root SHA-256 of those that are closed."""
    for path in recordings:
        with suppress(HuddleError, OSError):
            run_id, root = identity(path)
            if root:
                yield path.name, run_id, root


def _run_ids(path: Path) -> tuple[str, str] | None:
    """Return the run_id of a file, and the one that it continues; None if it is torn."""
    try:
        with Recording.open(path) as recording:
            return recording.run_id, recording.continues
    except (HuddleError, OSError):
        return None
