"""How our own modules are started as processes: the one place that builds their command line."""

from __future__ import annotations

import sys


def python_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module in a new Python interpreter.

    ``-P`` keeps the working directory off ``sys.path``. Bench files and recordings lie in folders
    that also hold scripts; without it, a ``random.py`` beside the bench file would be imported by
    the recorder in place of the standard library's.
    """
    return [sys.executable, "-P", "-m", module, *arguments]
