"""Follows a recording in a thread and hands over snapshots."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from daq.errors import HuddleError
from daq.estimation import Estimation
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


def follow(
    path: Path,
    settings: Settings | None,
    *,
    on_snapshot: Callable[[Snapshot, Settings], None],
    on_trouble: Callable[[str], None],
    ended: threading.Event,
) -> None:
    """Hand over the estimate whenever there is news, until the recording is closed or ``ended``.

    The last snapshot of a closed recording is its result.
    """
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
                pause = (time.thread_time() - began) / SHARE
                ended.wait(min(max(LEAST_INTERVAL, pause), LONGEST_INTERVAL))
    except (HuddleError, EstimatorError, OSError) as error:
        on_trouble(str(error))
