"""Repeats writes that the disk refused, so that a transient error does not end a run."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable

_LOGGER = logging.getLogger(__name__)
PAUSES = (0.05, 0.2, 0.75)
"""Seconds before each repetition; meanwhile the recorder buffers samples."""


def repeated(
    write: Callable[[], object],
    *,
    before: Callable[[], None] = lambda: None,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Run `write`, which must be repeatable; if the disk refuses, run `before` and repeat.

    Not for ``fsync``: after a failed one, a second one succeeds although the data are lost.

    Raises
    ------
    OSError, RuntimeError
        As `write`, if the last repetition also fails.
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
    """Log a failed write."""
    _LOGGER.warning("a write to the recording failed and is repeated: %s", reason_of(error))


def reason_of(error: BaseException) -> str:
    """Return the system's message, which HDF5 hides among positions and addresses."""
    found = re.search(r"error message = '([^']+)'", str(error))
    return found[1] if found else str(getattr(error, "strerror", None) or error)
