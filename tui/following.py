"""Follows a recording in a thread and hands over snapshots."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from daq.control import ask
from daq.errors import HuddleError, RecordingError
from daq.estimation import Estimation
from daq.recording.reader import Recording
from estimator.errors import EstimatorError

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable
    from pathlib import Path

    from daq.estimation import Settings, Snapshot

LEAST_INTERVAL = 0.5
LONGEST_INTERVAL = 5.0
SHARE = 0.05
"""Of one core, at most, that following may take."""
SILENCE = 10.0
"""Seconds without a sample after which the recorder is asked whether it still lives."""


def follow(
    path: Path,
    settings: Settings | None,
    *,
    on_snapshot: Callable[[Snapshot, Settings], None],
    on_trouble: Callable[[str], None],
    ended: threading.Event,
    silence: float = SILENCE,
) -> None:
    """Hand over the estimate whenever there is news, until the recording is closed or ``ended``.

    The last snapshot of a closed recording is its result. A recorder that was killed is trouble.
    """
    n_samples, heard = -1, time.monotonic()
    try:
        with Estimation([path], settings) as estimation:
            while not ended.is_set():
                began = time.thread_time()
                estimation.update()
                snapshot = estimation.snapshot()
                if snapshot.closed:
                    if snapshot.results:
                        snapshot = estimation.finish()
                    on_snapshot(snapshot, estimation.settings)
                    return
                on_snapshot(snapshot, estimation.settings)
                total = sum(sensor.n_samples for sensor in snapshot.sensors)
                if total != n_samples:
                    n_samples, heard = total, time.monotonic()
                elif time.monotonic() - heard >= silence:
                    _check_recorder(path)
                    heard = time.monotonic()
                pause = (time.thread_time() - began) / SHARE
                ended.wait(min(max(LEAST_INTERVAL, pause), LONGEST_INTERVAL))
    except (HuddleError, EstimatorError, OSError) as error:
        on_trouble(str(error))


def _check_recorder(path: Path) -> None:
    try:
        ask(path, "status")
    except HuddleError as error:
        with Recording.open(path) as recording:
            if recording.closed:  # meanwhile
                return
        raise RecordingError(
            f"{path}: its recorder is gone without having closed it; what it had acknowledged is "
            f"safe: huddle repair {path}, then huddle estimate {path}"
        ) from error
