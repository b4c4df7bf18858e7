"""Standard error of a child process: its log records, and the reason of a failure."""

from __future__ import annotations

import logging
from collections import deque

from tui.output.logs import lines as logs

_LOGGER = logging.getLogger(__name__)
MAX_LINES = 20
"""Lines that are no log records, of which the last are kept: a traceback of the interpreter's."""


class ChildLog:
    """Takes the standard error of a command that logs JSON, and logs its records here.

    Parameters
    ----------
    name : str
        What the process is, for lines that are no log records.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._pending = b""
        self._errors: list[str] = []
        self._others: deque[str] = deque(maxlen=MAX_LINES)

    def feed(self, content: bytes) -> None:
        """Take output, in pieces of any length."""
        *lines, self._pending = (self._pending + content).split(b"\n")
        for line in lines:
            self._take(line.decode(errors="replace").rstrip())

    @property
    def errors(self) -> list[str]:
        """The errors that the command reported; otherwise its output that is not a log line."""
        return self._errors or [line for line in self._others if line]

    def _take(self, line: str) -> None:
        record = logs.record_of(line)
        if record is None:
            self._others.append(line)
            _LOGGER.error("%s wrote: %s", self._name, line)
            return
        errors = getattr(record, "errors", None)
        if isinstance(errors, list):  # of this failure our own will say
            self._errors += map(str, errors)
        else:
            logs.write(record)
