"""An earlier recording to compare with, and whether a browser can open a report."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from daq.bench.model import Bench
from daq.errors import HuddleError
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from daq.results.result import Result
from tui.application.state import Reference


def reference_of(
    path: Path,
    settings: Settings | None,
    about: Callable[[Path, Mapping[str, object]], tuple[Settings | None, Bench | None]],
    *,
    ended: threading.Event,
) -> Reference | None:
    """Return the estimate of a recording, with the settings of the one it is compared with.

    Parameters
    ----------
    path : Path
    settings : Settings or None
        Of what is shown; None where nothing is.
    about : callable
        Returns the settings of a recording's own bench.
    ended : threading.Event
        Set when the estimate is not wanted any more: the result is None then.

    Raises
    ------
    HuddleError, EstimatorError
        If it cannot be read, or gives no result.
    """
    if settings is None:
        settings, _ = about(path, {})
    if settings is None:
        raise HuddleError(f"{path}: has no settings of an estimate")
    settings = replace(settings, start=None, end=None)

    def progress(done: int, total: int) -> None:
        del done, total
        if ended.is_set():
            raise _CancelledError

    try:
        with Recording.open(path) as recording:
            numbers = {each.name: each.serial_number for each in recording.sensors}
        result = Result(estimate([path], settings, progress=progress), settings)
        return Reference(path, result, numbers)
    except _CancelledError:
        return None


class _CancelledError(Exception):
    """The estimate is not wanted any more."""


def can_open() -> bool:
    """Return whether a browser opens in a window, and not in the terminal of the application."""
    if sys.platform in {"win32", "darwin"}:
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
