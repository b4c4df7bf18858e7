"""Stops the recorder of a recording when its noise has the wanted precision.

A process of its own: an estimate that fails or takes long costs the recording nothing but its early
end. ``python -m tui.service.processes.until_cov '["FILE", COV]'``
"""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from daq.errors import HuddleError
from daq.estimation.follow import RecordingLeftOpenError, follow
from daq.estimation.settings import Settings
from daq.recording.control import ask
from daq.recording.reader import Recording
from daq.results.precision import precision
from estimator.errors import EstimatorError

if TYPE_CHECKING:
    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus

_LOGGER = logging.getLogger(__name__)
RETRY = 5.0
"""Seconds after which a recording that is not there yet is looked for again."""
ATTEMPTS = 100


class PrecisionObserver:
    """Asks the recorder to stop once the precision is reached."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.reached = threading.Event()

    def status(self, status: RecordingStatus) -> None:
        """Take no notice."""

    def segments(self, n_segments: int, elapsed: float) -> None:
        """Take no notice."""

    def progress(self, done: int, total: int) -> None:
        """Take no notice."""

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Stop the recorder if the estimate is precise enough."""
        if not snapshot.closed and precision(snapshot, settings).is_reached:
            ask(self._path, "stop")
            self.reached.set()


def stop_when_precise(path: Path, target_cov: float) -> None:
    """Follow a recording until it is precise enough, or closed.

    Raises
    ------
    HuddleError, EstimatorError
        If it cannot be followed or estimated.
    """
    with Recording.open(path) as recording:
        settings = replace(Settings.of(recording.bench), target_cov=target_cov)
    observer = PrecisionObserver(path)
    follow(path, settings, observer, cancelled=observer.reached, watch_sensors=False, whole=True)


def main() -> None:
    """Do it, again after errors, until the service ends this process."""
    path, target_cov = json.loads(sys.argv[1])
    for _ in range(ATTEMPTS):
        if Path(path).exists():
            try:
                stop_when_precise(Path(path), float(target_cov))
            except RecordingLeftOpenError:
                return
            except (HuddleError, EstimatorError) as error:
                _LOGGER.warning("%s: the precision is not known: %s", path, error)
            else:
                return
        time.sleep(RETRY)


if __name__ == "__main__":
    main()
