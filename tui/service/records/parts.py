"""Which files a recording of a run has: the recorder goes on in another if the disk refuses one."""

from __future__ import annotations

from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from daq.errors import HuddleError
from daq.recording.reader import Recording
from daq.recording.storage.journal import journal_path
from daq.recording.storage.names import continuation_names

if TYPE_CHECKING:
    from collections.abc import Iterable


def with_continuations(parts: Iterable[Path]) -> list[Path]:
    """Return these files, each followed by those in which its recorder went on."""
    found: list[Path] = []
    for part in parts:
        names = takewhile(Path.exists, continuation_names(part))
        found += [part, *(path for path in names if _is_continuation(path))]
    return list(dict.fromkeys(found))


def _is_continuation(path: Path) -> bool:
    """Return whether a file of such a name continues another; a torn one is taken for it."""
    try:
        with Recording.open(path) as recording:
            return bool(recording.continues)
    except (HuddleError, OSError):
        return journal_path(path).exists()
