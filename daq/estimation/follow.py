"""Follows a recording in a thread: how it is at each look, the estimate when there is news."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol

from daq.errors import HuddleError, RecordingError
from daq.estimation.estimation import Estimation
from daq.estimation.throttle import Throttle
from daq.recording.control import ask
from daq.recording.monitor import RecordingMonitor
from daq.recording.reader import Recording, control_address
from estimator.errors import EstimatorError, InsufficientDataError

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable
    from pathlib import Path

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus

LEAST_INTERVAL = 1.0
LONGEST_INTERVAL = 5.0
MAX_CPU_SHARE = 0.05
"""Of one core, at most, that following may take."""
SILENCE = 10.0
"""Seconds without a sample after which the recorder is asked whether it still lives."""


class _EndedError(Exception):
    """Nobody wants the result any more."""


class Observer(Protocol):
    """Whoever wants to know; called from the thread that follows."""

    def look(self, now: RecordingStatus) -> None:
        """Take how the sensors are doing: often, and cheap."""
        ...

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Take the estimate: when a segment has come, and once more when the recording is closed.

        That last one is the result, from the whole recording.
        """
        ...

    def progress(self, done: int, total: int) -> None:
        """Take how far the result is, in segments."""
        ...

    def trouble(self, text: str) -> None:
        """Take what went wrong, in words."""
        ...


def follow(
    path: Path,
    settings: Settings | None,
    *,
    onlooker: Observer,
    ended: threading.Event,
    growth: float = 0.0,
    silence: float = SILENCE,
) -> None:
    """Follow a recording until it is closed or ``ended``; a recorder that was killed is trouble.

    The estimate is made anew when the number of segments has grown, and by this share at least;
    less often where it takes long (:mod:`daq.estimation.throttle`).
    """
    try:
        with Estimation([path], settings) as estimation:
            (recording,) = estimation.recordings
            lookout = RecordingMonitor(recording)
            states = _RecorderStates(path)
            onlooker.look(lookout.look())
            wanted, n_samples, heard = 0.0, -1, time.monotonic()
            spacing = Throttle()
            closed = recording.closed
            while not closed:
                began = time.thread_time()
                estimation.update()
                closed = recording.closed
                if closed:  # what is said of it from now on is its result
                    break
                if estimation.n_seen >= wanted and spacing.due:
                    wanted = max(estimation.n_seen + 1, estimation.n_seen * (1 + growth))
                    onlooker.look(lookout.look_closely())
                    with spacing:
                        snapshot = estimation.snapshot()
                    onlooker.snapshot(snapshot, estimation.settings)
                else:
                    now = lookout.look()
                    if lookout.quiet():
                        now = lookout.with_states(now, states.ask())
                    onlooker.look(now)
                total = sum(sensor.n_samples for sensor in recording.sensors)
                if total != n_samples:
                    n_samples, heard = total, time.monotonic()
                elif time.monotonic() - heard >= silence:
                    _check_recorder(path)
                    heard = time.monotonic()
                pause = (time.thread_time() - began) / MAX_CPU_SHARE
                if ended.wait(min(max(LEAST_INTERVAL, pause), LONGEST_INTERVAL)):
                    return
            onlooker.look(lookout.look_closely())
            try:
                snapshot = estimation.finish(_progress(onlooker, ended))
            except InsufficientDataError as error:
                onlooker.snapshot(estimation.snapshot(), estimation.settings)
                onlooker.trouble(str(error))
            else:
                onlooker.snapshot(snapshot, estimation.settings)
    except _EndedError:
        return
    except (HuddleError, EstimatorError, OSError) as error:
        onlooker.trouble(str(error))


class _RecorderStates:
    """What the recorder says of its sensors: only it knows at once that one is late."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._address: tuple[int, str] | None = None

    def ask(self) -> dict[str, str]:
        """Return the state of each sensor; nothing if no recorder answers."""
        try:
            self._address = self._address or control_address(self._path)
            if self._address is None:
                return {}
            sensors = ask(self._address, "status")["sensors"]
        except (HuddleError, OSError):
            return {}
        return {name: sensor["state"] for name, sensor in sensors.items()}


def _progress(onlooker: Observer, ended: threading.Event) -> Callable[[int, int], None]:
    """Return who tells the progress, and ends the work when nobody wants its result."""

    def tell(done: int, total: int) -> None:
        if ended.is_set():
            raise _EndedError
        onlooker.progress(done, total)

    return tell


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
