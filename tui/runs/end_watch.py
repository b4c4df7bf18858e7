"""Stops the recorder of a recording once its condition on the live estimate is met.

A process of its own, started by the recorder: an estimate that fails or takes long costs the
recording nothing but its early end. ``python -m tui.runs.end_watch FILE``
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from daq.errors import HuddleError
from daq.estimation.follow import RecordingLeftOpenError, follow
from daq.recording.control import ask
from daq.recording.reader import Recording
from daq.results.result import Result
from estimator.errors import EstimatorError

if TYPE_CHECKING:
    from daq.bench.end_condition import EndCondition
    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus

_LOGGER = logging.getLogger(__name__)
RETRY = 5.0
"""Seconds after which a recording that is not there yet, or cannot be estimated, is tried again."""
ATTEMPTS = 100


class EndObserver:
    """Asks the recorder to stop once the condition is met.

    Parameters
    ----------
    path : Path
        The recording.
    until : EndCondition
    bench : Bench or None
        Its limits.
    """

    def __init__(self, path: Path, until: EndCondition, bench: Bench | None) -> None:
        self._path, self._until, self._bench = path, until, bench
        self.reached = threading.Event()

    def status(self, status: RecordingStatus) -> None:
        """Take no notice."""

    def segments(self, n_segments: int, elapsed: float) -> None:
        """Take no notice."""

    def progress(self, done: int, total: int) -> None:
        """Take no notice."""

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Stop the recorder if the estimate meets the condition."""
        result = Result(snapshot, settings, self._bench)
        if not snapshot.closed and result.is_reached(self._until):
            ask(self._path, "stop")
            self.reached.set()


def watch_end(path: Path) -> None:
    """Follow a recording until its condition is met, or it is closed.

    Raises
    ------
    HuddleError, EstimatorError
        If it cannot be followed or estimated.
    """
    with Recording.open(path) as recording:
        until, bench = recording.until, recording.bench
    observer = EndObserver(path, until, bench)
    follow(path, None, observer, cancelled=observer.reached, states_every=None, whole=True)


def main() -> None:
    """Watch, again after errors, until the recorder ends this process."""
    path = Path(sys.argv[1])
    for _ in range(ATTEMPTS):
        if path.exists():
            try:
                watch_end(path)
            except RecordingLeftOpenError:
                return
            except (HuddleError, EstimatorError) as error:
                _LOGGER.warning("%s: the live estimate failed: %s", path, error)
            else:
                return
        time.sleep(RETRY)


if __name__ == "__main__":
    main()
