"""A process that takes recordings into an archive: a task a line in, an outcome a line out.

The process ends with its standard input, so none is left behind by a command that was killed.
"""

from __future__ import annotations

import os
import signal
import sys

from daq.archive.task import run


def main() -> None:
    """Carry out tasks until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the command, which ends us
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # nothing else is taken for an outcome
    with answers:
        for line in sys.stdin:
            answers.write(run(line) + "\n")
            answers.flush()


if __name__ == "__main__":
    main()
