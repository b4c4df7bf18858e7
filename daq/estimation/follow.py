"""Follows a recording while it grows, up to its result.

Theory of operation
-------------------
One loop looks at the file again and again, at the states of the sensors each time. Once enough for
the next estimate is there, the segments are taken together, and the estimate is made again. The
choice of the dimension of the motion takes seconds: it is made again beside the looks, in a thread.
Looks and estimates are throttled, so that a bench box stays free to record. When the recording is
closed, the whole of it is estimated once more: that is the result. A recorder that ends without
closing its file ends the loop with `RecordingLeftOpenError`.
"""

from __future__ import annotations

import contextlib
import ctypes
import threading
import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from daq.errors import HuddleError, NotConnectedError, RecordingError
from daq.estimation.estimation import Estimation
from daq.estimation.freed_memory import c_function, give_back, limit
from daq.estimation.recording_set import is_continued, is_left
from daq.estimation.settings import Settings
from daq.estimation.snapshot import NoResultError, Snapshot
from daq.estimation.throttle import Throttle
from daq.protocols.block import Uncounted
from daq.recording.control import ask
from daq.recording.monitor import RecordingMonitor, RecordingStatus
from daq.recording.reader import Recording, control_address
from daq.recording.storage import locking

INTERVAL = 20.0
"""Seconds between returns, at least."""
_M_ARENA_MAX, _HEAPS = -8, 2  # of malloc.h


class FreedMemory:
    """Freed memory of this process, of which the C library keeps less from now on."""

    def __init__(self) -> None:
        self._next = 0.0
        limit()
        option = c_function("mallopt", ctypes.c_int, ctypes.c_int)
        if option is not None:
            option(_M_ARENA_MAX, _HEAPS)

    def give_back(self) -> None:
        """Return it to the system, every `INTERVAL`, where the C library can do so (glibc)."""
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + INTERVAL
            give_back()


STATUS_INTERVAL = 1.0
"""Seconds between looks at the sensors, where they are watched."""
SHORTEST_INTERVAL, MAX_INTERVAL = 0.25, 5.0
"""Seconds between looks for a new segment."""
COMMIT_INTERVAL = 1.0
"""Seconds of samples that a commit usually adds to the file: no look can find more."""
LOOK_SHARE, ESTIMATE_SHARE = 0.03, 0.1
"""Share of the time that looks for segments, and at the sensors, may take each; and estimates on a
screen."""
SILENCE = 10.0
"""Seconds without a sample after which a recorder in another process is asked whether it runs."""


class RecordingLeftOpenError(RecordingError):
    """The recorder has ended without closing its recording."""


class Observer(Protocol):
    """Receives what is seen of a recording, in the thread that follows it."""

    def status(self, status: RecordingStatus) -> None:
        """Take the state of the sensors: often, and cheap."""

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Take the estimate after new segments, and the result of a closed recording."""

    def segments(self, n_segments: int, elapsed: float) -> None:
        """Take how many segments count so far, and the seconds they span, after each new one."""

    def progress(self, done: int, total: int) -> None:
        """Take how many segments are done, and of how many.

        Of the result, or of what had been recorded before where the recording still grows.
        """


class WritingProcess(Protocol):
    """The process that writes the recording, as whoever started it knows it."""

    @property
    def ended(self) -> bool:
        """Whether the process has ended."""

    def ends_within(self, timeout: float) -> bool:
        """Wait this long (s), or until the process has ended; return whether it has."""


class _CancelledError(Exception):
    """The result is not wanted any more."""


def follow(
    path: Path,
    settings: Settings | None,
    observer: Observer,
    *,
    recorder: WritingProcess | None = None,
    cancelled: threading.Event | None = None,
    states_every: float | None = STATUS_INTERVAL,
    growth: float = 0.0,
    share: float = ESTIMATE_SHARE,
    of_diagnoses: float = 0.1,
    silence: float = SILENCE,
    whole: bool = False,
    look: Callable[[Recording], None] | None = None,
) -> Snapshot | None:
    """Follow a recording until it is closed, and return its result.

    Parameters
    ----------
    path : Path
    settings : Settings, optional
        Those of the bench in the recording, if not given.
    observer : Observer
    recorder : WritingProcess, optional
        The process that writes the recording. If not given, it runs as long as it holds the lock
        of the file. Without such locks (Windows) it is asked over its control channel, once no
        sample has come for `silence` seconds.
    cancelled : threading.Event, optional
        Ends the following early once it is set.
    states_every : float, optional
        Seconds between looks at the sensors, at least; None where nobody watches their state.
    growth : float
        Share by which the number of segments has grown, at least, before the next estimate.
    share : float
        Of the time, at most, that estimates of the growing recording may cost.
    of_diagnoses : float
        Share of that, at most, for the diagnoses in them, which are not part of it.
    silence : float
        In seconds.
    whole : bool
        Whether estimates of the growing recording have all sensors, however much memory they take:
        the observer decides by them.
    look : callable, optional
        Reads more of the recording, before each state of the sensors: nobody else in this process
        may open it, for HDF5 shares what it knows of a file.

    Returns
    -------
    Snapshot or None
        The result, from the whole recording; None if `cancelled`.

    Raises
    ------
    RecordingLeftOpenError
        If the recorder has ended without closing the recording.
    RecordingError, CannotAlignError
        If the file cannot be read, or its sensors not be aligned.
    NoResultError
        If the whole recording is too little for any of the methods.
    """
    cancelled = threading.Event() if cancelled is None else cancelled
    recording = first = Recording.open(path)
    settings = _with_target(settings, recording)
    with Estimation(
        [recording], settings, diagnosis_share=share * of_diagnoses, live=not whole
    ) as estimation:

        def seen(recording: Recording) -> tuple[WritingProcess, _Sensors | None]:
            watched = None if states_every is None else _Sensors(recording, observer, first, look)
            return recorder or _RemoteRecorder(recording, cancelled, silence), watched

        known, sensors = seen(recording)
        looks = Throttle(LOOK_SHARE, longest=MAX_INTERVAL)
        pause = MAX_INTERVAL if states_every is None else states_every
        states, estimates = Throttle(LOOK_SHARE, longest=2 * pause), Throttle(share)
        wanted, uncounted, memory = 0.0, _Uncounted(), FreedMemory()
        _look(sensors)

        while not recording.closed:
            # Asked before: what it wrote last is seen below.
            left_open = known.ended and not is_continued(recording)
            recording.refresh()
            is_ready = estimates.is_due and estimation.lacking(wanted) <= 0.0
            if (looks.is_due and (is_ready or is_left(recording))) or recording.closed:
                with looks, _usual_cost(estimation, looks):
                    if not _is_updated(estimation, observer, cancelled):
                        return None
                newest = estimation.recordings[-1]
                if newest is not recording and isinstance(newest, Recording):
                    recording = newest  # the disk refused the one before
                    known, sensors = seen(recording)
            if recording.closed:
                break
            _check_left(path, is_open=left_open)
            if estimation.n_seen < wanted or not estimates.is_due:
                with states:
                    _look(sensors)
            else:  # beside the looks, which go on at their own pace
                wanted = max(estimation.n_seen + 1, estimation.n_seen * (1 + growth))
                with estimates, _usual_cost(estimation, estimates):
                    _look(sensors, closely=True)
                    snapshot = estimation.snapshot()
                    observer.snapshot(snapshot, estimation.settings)
                uncounted.take(recording.path, snapshot)
                estimation.choose_again()
            memory.give_back()
            until = max(_until_segment(estimation, wanted), looks.remaining, estimates.remaining)
            known.ends_within(min(until, max(pause, states.remaining)))
            if cancelled.is_set():
                return None
        _look(sensors, closely=True)
        if estimation.is_whole:
            return _result(estimation, observer, cancelled)
    with Estimation([path], estimation.settings) as again:
        return _result(again, observer, cancelled)


def _is_updated(estimation: Estimation, observer: Observer, cancelled: threading.Event) -> bool:
    """Take new segments; return False if the following was cancelled meanwhile."""

    def catch_up(done: int, total: int) -> None:
        if cancelled.is_set():
            raise _CancelledError
        if estimation.n_seen == 0 or done < total:  # not of the one new segment
            observer.progress(done, total)

    try:
        if estimation.update(catch_up):
            observer.segments(estimation.n_segments, estimation.elapsed)
    except _CancelledError:
        return False
    return True


@contextlib.contextmanager
def _usual_cost(estimation: Estimation, throttle: Throttle) -> Generator[None]:
    """Count only what is usual in the cost of work: the rest delays no later work."""
    before = estimation.occasional_cost
    yield
    throttle.deduct(estimation.occasional_cost - before)


def _with_target(settings: Settings | None, recording: Recording) -> Settings | None:
    """Return settings with the target c.o.v. at which the recording ends, if it does."""
    if recording.until.cov is None:
        return settings
    settings = Settings.of(recording.outline) if settings is None else settings
    return replace(settings, target_cov=recording.until.cov)


def _check_left(path: Path, *, is_open: bool) -> None:
    if is_open:
        raise RecordingLeftOpenError(
            f"{path}: the recorder ended without closing it; what it had acknowledged"
            f" is safe: huddle repair {path}, then huddle estimate {path}"
        )


def _until_segment(estimation: Estimation, wanted: float) -> float:
    """Return the seconds until there may be so many segments: before, there is nothing to see."""
    bench = estimation.recordings[0].outline
    speed = 1.0 if bench is None else bench.speed
    return max(SHORTEST_INTERVAL, (estimation.lacking(wanted) - COMMIT_INTERVAL) / speed)


def _result(
    estimation: Estimation, observer: Observer, cancelled: threading.Event
) -> Snapshot | None:
    def progress(done: int, total: int) -> None:
        if cancelled.is_set():
            raise _CancelledError
        observer.progress(done, total)

    try:
        snapshot = estimation.finish(progress)
    except _CancelledError:
        return None
    except NoResultError as error:
        observer.snapshot(error.snapshot, estimation.settings)
        raise
    observer.snapshot(snapshot, estimation.settings)
    return snapshot


class _Uncounted:
    """Has the recorder record the samples that sensors did not count, if two estimates show them.

    Once for each: a later estimate may date it otherwise.
    """

    def __init__(self) -> None:
        self._before: tuple[tuple[str, Uncounted], ...] = ()
        self._recorded: list[tuple[str, Uncounted]] = []

    def take(self, path: Path, snapshot: Snapshot) -> None:
        """Record what this estimate and the one before show."""
        found = tuple((clock.sensor, each) for clock in snapshot.clocks for each in clock.slips)
        for sensor, each in found:
            if _is_among(sensor, each, self._before) and not _is_among(
                sensor, each, self._recorded
            ):
                self._recorded.append((sensor, each))
                said = f"{each.utc_ns} {each.within:.3f} {each.n_samples} {sensor}"
                with contextlib.suppress(HuddleError, OSError):  # the result has it in any case
                    ask(path, "uncounted", said)
        self._before = found


def _is_among(sensor: str, one: Uncounted, others: Iterable[tuple[str, Uncounted]]) -> bool:
    return any(sensor == name and one.is_that(other) for name, other in others)


def _look(sensors: _Sensors | None, *, closely: bool = False) -> None:
    if sensors is not None:
        (sensors.look_closely if closely else sensors.look)()


class _Sensors:
    """States of the sensors: from the file, and from the recorder where the file is silent."""

    def __init__(
        self,
        recording: Recording,
        observer: Observer,
        first: Recording,
        further: Callable[[Recording], None] | None,
    ) -> None:
        self._monitor, self._observer = RecordingMonitor(recording, first=first), observer
        self._recording, self._further = recording, further
        self._path = recording.path
        self._address: tuple[int, str] | None = None

    def look(self) -> None:
        """Pass on the state of the sensors."""
        status = self._monitor.status()
        if self._monitor.is_any_sensor_quiet():
            status = self._monitor.with_late_sensors(status, self._recorder_states())
        self._pass_on(status)

    def look_closely(self) -> None:
        """Pass on the state of the sensors, and which channels are stuck."""
        self._pass_on(self._monitor.status_with_stuck_channels())

    def _pass_on(self, status: RecordingStatus) -> None:
        if self._further is not None:
            self._further(self._recording)
        self._observer.status(status)

    def _recorder_states(self) -> dict[str, str]:
        """Ask the recorder, the first to know that a sensor is late."""
        try:
            self._address = self._address or control_address(self._path)
            if self._address is None:
                return {}
            sensors = ask(self._address, "status", folder=self._path.resolve().parent)["sensors"]
        except (HuddleError, OSError):
            return {}
        return {name: sensor["state"] for name, sensor in sensors.items()}


class _RemoteRecorder:
    """A recorder that another process started.

    It is gone when nobody holds the lock of the file that was opened. Where that cannot be seen, it
    is asked whether it runs when no sample comes.
    """

    def __init__(self, recording: Recording, cancelled: threading.Event, silence: float) -> None:
        self._recording, self._silence = recording, silence
        self._wait: Callable[[float], bool] = cancelled.wait
        self._n_samples, self._grew_at = -1, time.monotonic()

    @property
    def ended(self) -> bool:
        if locking.LOCKS_ARE_VISIBLE:
            return not locking.is_being_written(self._recording.opened)
        n_samples = sum(sensor.n_samples for sensor in self._recording.sensors)
        now = time.monotonic()
        if n_samples != self._n_samples:
            self._n_samples, self._grew_at = n_samples, now
        elif now - self._grew_at >= self._silence:
            self._grew_at = now
            try:
                ask(self._recording.path, "status")
            except NotConnectedError:
                return True
            except HuddleError:
                return False  # it runs, and does not answer in time
        return False

    def ends_within(self, timeout: float) -> bool:
        return self._wait(timeout)
