"""Exit codes of the ``huddle`` command."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """How a command ended."""

    DONE = 0
    LIMIT_NOT_MET = 1
    """Also: a reproduced figure does not agree with the theory."""
    USAGE = 2
    """The command line, a bench file or another file that a person wrote is wrong."""
    TROUBLE = 3
    """A device or a recording is in trouble."""
    NOT_DECIDED = 4
    """The limits are not decided: the uncertainty spans one, or data are missing."""
    INTERRUPTED = 130
    CLOSED_PIPE = 141
    """Nobody reads the output any more, as in ``| head``: as a shell says of SIGPIPE."""
