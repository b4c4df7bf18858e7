"""Packages that read a format, each installed by an extra."""

from __future__ import annotations

import importlib
import sys
import warnings
from typing import Any

from daq.errors import ImportFormatError
from daq.python_process import install_command


def load(package: str, *, reads: str, extra: str) -> Any:  # noqa: ANN401 - they have no types
    """Import the package that reads a format.

    Raises
    ------
    ImportFormatError
        It is not installed.
    """
    if (loaded := sys.modules.get(package.lower())) is not None:
        return loaded
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ObsPy's own, about importlib.metadata
            return importlib.import_module(package.lower())
    except ImportError as error:
        raise ImportFormatError(
            f"{reads} read by {package}, which is not installed; run: {install_command(extra)}"
        ) from error
