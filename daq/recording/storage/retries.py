"""Repeats writes that the disk refused: one that is full or disturbed for a moment ends no run."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

_LOGGER = logging.getLogger(__name__)
PAUSES = (0.05, 0.2, 0.75)
"""Seconds before each repetition; samples wait in the buffers of the recorder meanwhile."""


def repeated(
    write: Callable[[], object],
    *,
    before: Callable[[], None] = lambda: None,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Do a write that may be done twice; repeat it if the disk refuses, after `before`.

    Not for ``fsync``: after one that failed, a second one succeeds although the data are lost.

    Raises
    ------
    OSError, RuntimeError
        As `write` does, if the last repetition fails, too.
    """
    try:
        write()
    except (OSError, RuntimeError) as error:
        report(error)
    else:
        return
    for pause in PAUSES:
        sleep(pause)
        try:
            before()
            write()
        except (OSError, RuntimeError) as error:
            report(error)
            if pause == PAUSES[-1]:
                raise
        else:
            return


def report(error: BaseException) -> None:
    """Log a write that failed."""
    _LOGGER.warning("a write to the recording failed and is repeated: %s", error)
