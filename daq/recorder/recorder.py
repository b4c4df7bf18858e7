"""The recorder: writes all devices of a bench into one recording, until it is stopped.

Theory of operation
-------------------
One task per port (:class:`daq.recorder.connection.Connection`) puts items into one bounded
queue. The recorder takes them from the queue in batches and writes them in a separate thread
(:class:`daq.recorder.block_writer.BlockWriter`), so that neither compression nor ``fsync``
delays a port. It commits about once a second, sooner if a complete chunk of samples is waiting,
and acknowledges only committed samples. If writing lags, the queue fills, the ports' tasks wait,
and the operating system's buffers hold the data.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import shutil
import signal
from collections.abc import Callable, Coroutine, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self, TypeVar

from daq.bench.durations import format_duration
from daq.bench.model import Bench, Sensor
from daq.devices.bench_file import caveats_of
from daq.devices.interface import AnyDriver
from daq.devices.registry import driver_type
from daq.errors import DeviceError, DiskError, RecordingError, RemovedError
from daq.host_clock import HostClock, SystemClock
from daq.protocols.block import Event, EventKind, Quantity, Reading, ReadingTimes, Uncounted
from daq.protocols.errors import RemoteProtocolError
from daq.recorder.block_writer import BlockWriter, SensorProgress, ShareOfRepeats
from daq.recorder.clock_trust import ClockWatch
from daq.recorder.connection import CLOSE_TIMEOUT, Connection, Item
from daq.recorder.device_identity import with_owner
from daq.recording import control
from daq.recording.control import Command
from daq.recording.file_format import SensorLayout
from daq.recording.storage.names import CONTINUES, continuation_names
from daq.recording.writer import Committed, RecordingWriter


class WritingThread:
    """The only thread that accesses the file."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="recording")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()

    async def run(self, function: Callable[[], _Result]) -> _Result:
        """Run a function in the thread; wait for its end even if this task is cancelled."""
        future = asyncio.get_running_loop().run_in_executor(self._executor, function)
        try:
            return await asyncio.shield(future)
        except asyncio.CancelledError:
            await asyncio.wait([future])
            raise


_LOGGER = logging.getLogger(__name__)
QUEUE_LENGTH = 4096
COMMIT_INTERVAL, MIN_COMMIT_INTERVAL = 1.0, 0.25
"""Seconds between commits: usually, and if a complete chunk of samples is waiting."""
CANCEL_TIMEOUT = CLOSE_TIMEOUT + 2.0
"""Seconds that all connections may take to end."""
_BATCH_INTERVAL = 0.25
SPACE_FOR = 3600.0
"""Seconds of a recording without a duration for which the disk must have room without a warning."""
MIN_CONTINUATION = 60.0
"""Seconds that a continuation file must last; a disk that fails sooner ends the run."""
_LAST_BLOCKS = 1.0
"""Seconds after the end of a run in which its last blocks may arrive."""
CELSIUS = "°C"
"""Unit of an auxiliary channel that is recorded as the temperature of its sensor."""
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """An acknowledgment: all counted samples are safe on disk."""

    path: str
    elapsed: float
    """Host time since the start, in seconds."""
    sensors: dict[str, SensorProgress]
    closed: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return the status as a JSON object."""
        return asdict(self)


def run(
    recording: Callable[..., Coroutine[Any, Any, RecorderStatus]],
    loop_factory: Callable[[], asyncio.AbstractEventLoop] | None = None,
) -> RecorderStatus:
    """Record until done, SIGINT or SIGTERM, in the main thread.

    Parameters
    ----------
    recording : callable
        :func:`record` with all arguments but ``stop``.
    loop_factory : callable, optional
        Makes the event loop.
    """

    async def main() -> RecorderStatus:
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                loop.add_signal_handler(number, stop.set)
            except NotImplementedError:  # Windows
                signal.signal(number, lambda *_: loop.call_soon_threadsafe(stop.set))
        return await recording(stop=stop)

    runner = asyncio.Runner(loop_factory=loop_factory)
    try:
        return runner.run(main())
    finally:
        # Closing would wait for a driver that does not end, and no signal would interrupt it.
        if not asyncio.all_tasks(runner.get_loop()):
            runner.close()


async def record(
    bench: Bench,
    path: str | Path,
    *,
    duration: float | None = None,
    attributes: Mapping[str, str] = MappingProxyType({}),
    anyway: bool = False,
    share_of_repeats: ShareOfRepeats | None = None,
    clock: HostClock | None = None,
    stop: asyncio.Event | None = None,
    acknowledged: Callable[[RecorderStatus], None] | None = None,
    drivers: Callable[[str], AnyDriver] = driver_type,
) -> RecorderStatus:
    """Record a bench.

    Parameters
    ----------
    bench : Bench
        Sensors to record.
    path : path
        The new file.
    duration : float, optional
        Seconds to record of every sensor, counted by its samples; the run ends after this host time
        even if a sensor is lost. Without a duration, ``stop`` ends the run.
    attributes : mapping of str to str
        Further attributes of the recording, such as what of the live estimate ends the run
        (``until``): the recorder only writes them.
    anyway : bool
        Whether to record though some sensors of a port that others answer on do not.
    share_of_repeats : callable, optional
        See :class:`daq.recorder.block_writer.BlockWriter`.
    clock : HostClock, optional
        Source of host times; default: the system's clock, at the bench's speed.
    stop : asyncio.Event, optional
        Ends the run properly when set.
    acknowledged : callable, optional
        Called after every commit, and when the state of a sensor has changed.
    drivers : callable
        Returns the driver with a given name.

    Returns
    -------
    RecorderStatus
        Status of the closed recording; not ``closed``, and without a file, if ``stop`` was set
        before all devices were connected.

    Raises
    ------
    ExceptionGroup of DeviceError
        If devices cannot be used at the start: one error per device, naming its sensor.
    RecordingError
        If no file can be written; all acknowledged samples are safe.
    """
    clock = SystemClock(bench.speed) if clock is None else clock
    recorder = _Recorder(
        *(bench, Path(path), clock, stop or asyncio.Event(), acknowledged),
        attributes=attributes,
        share_of_repeats=share_of_repeats,
    )
    return await recorder.run(duration, drivers, anyway=anyway)


@dataclass(eq=False)
class _Recorder:
    bench: Bench
    path: Path
    clock: HostClock
    stop: asyncio.Event
    acknowledged: Callable[[RecorderStatus], None] | None
    attributes: Mapping[str, str | float]
    share_of_repeats: ShareOfRepeats | None

    def __post_init__(self) -> None:
        self._path = self._file = self.path
        self._queue: asyncio.Queue[Item] = asyncio.Queue(QUEUE_LENGTH)
        self._uncounted: dict[str, list[Uncounted]] = {}  # by sensor; recorded already
        self._started = self._file_started = self.clock.now()
        self._end_reason = "stopped"
        self._status = RecorderStatus(str(self.path), 0.0, {})
        self._thread: WritingThread
        self._writer: BlockWriter

    async def run(
        self, duration: float | None, drivers: Callable[[str], AnyDriver], *, anyway: bool
    ) -> RecorderStatus:
        connections = [
            Connection(drivers(sensors[0].driver), sensors, self.clock, anyway=anyway)
            for sensors in self.bench.ports().values()
        ]
        start = asyncio.Event()
        async with control.serve(self._answer, self._path.parent) as address:
            tasks = [
                asyncio.create_task(c.run(self._queue, start), name=c.port) for c in connections
            ]
            try:
                if not await self._all_connected(connections):
                    return self._status
                with WritingThread() as self._thread:
                    create = partial(self._create, connections, address, duration)
                    self._writer = await self._thread.run(create)
                    try:
                        start.set()
                        await self._write_until_end(duration, tasks)
                        await self._cancel(tasks)
                        await self._finish()
                    except BaseException:
                        await asyncio.shield(self._thread.run(self._writer.abandon))
                        raise
            finally:
                await self._cancel(tasks)
        return self._status

    async def _cancel(self, tasks: list[asyncio.Task[None]]) -> None:
        """Cancel the remaining tasks and wait until they have closed their sessions.

        A task that does not end in time is reported and abandoned.
        """
        remaining = [task for task in tasks if not task.done()]
        for task in remaining:
            task.cancel()
        if not remaining:
            return
        _, stuck = await asyncio.wait(remaining, timeout=CANCEL_TIMEOUT)
        for task in stuck:
            tasks.remove(task)
            text = f"the driver on {task.get_name()} does not end; it was abandoned"
            with contextlib.suppress(asyncio.QueueFull):
                self._queue.put_nowait(Event("", EventKind.STATUS, text, self.clock.now()))

    async def _all_connected(self, connections: list[Connection]) -> bool:
        """Wait for all first sessions; return False if the run was stopped before."""
        stopped = asyncio.ensure_future(self.stop.wait())
        waiting = asyncio.gather(*(c.connected for c in connections), return_exceptions=True)
        try:
            await asyncio.wait((waiting, stopped), return_when=asyncio.FIRST_COMPLETED)
            if self.stop.is_set():
                return False
            failures = [
                DeviceError(f"port {connection.port}: {result}")
                if isinstance(result, RemoteProtocolError)
                else with_owner(result, self.bench.sensors)
                for connection, result in zip(connections, waiting.result(), strict=True)
                if isinstance(result, Exception)
            ]
        finally:
            waiting.cancel()
            stopped.cancel()
            await asyncio.wait([stopped])
        for failure in failures:
            if not isinstance(failure, DeviceError):
                raise failure  # an error in the bench file or in the program, not of a device
        if failures:
            raise ExceptionGroup(f"{len(failures)} ports cannot be used", failures)
        return True

    def _create(
        self, connections: list[Connection], address: tuple[int, str], duration: float | None
    ) -> BlockWriter:
        layouts: dict[str, SensorLayout] = {}
        thermometers: dict[str, tuple[int, float]] = {}
        for connection in connections:
            information = {i.sensor: i for i in connection.information}
            driver = connection.driver
            for sensor in connection.sensors:
                clock = sensor.clock_name(shares_clock=driver.shares_clock)
                layout = SensorLayout.of(sensor, driver.counts_dtype(sensor), clock)
                found = information.get(sensor.name)
                if found is not None:
                    layout = replace(
                        layout,
                        sampling_rate=found.sampling_rate or layout.sampling_rate,
                        model=found.model or layout.model,
                        serial_number=found.serial_number or layout.serial_number,
                        firmware=found.firmware,
                        temperature=found.temperature,
                    )
                layouts[sensor.name] = layout
                if layout.temperature is None and not driver.states_temperature:
                    thermometers |= _thermometer(sensor)
        ordered = [layouts[sensor.name] for sensor in self.bench.sensors]
        self._started = self._file_started = self.clock.now()
        self._new_file = partial(
            RecordingWriter.create, bench=self.bench, sensors=ordered, control=address
        )
        self.attributes = {**self.attributes, **dict.fromkeys(caveats_of(self.bench), 1)}
        until = {} if duration is None else {"duration": duration}
        attributes = {**self.attributes, **until}
        writer = self._new_file(self._path, created=self._started, attributes=attributes)
        writer.event(Event("", EventKind.STARTED, f"{len(ordered)} sensors", self._started))
        _LOGGER.info("recording to %s", self._path, extra={"recording": str(self._path)})
        self._report_space(ordered, duration)
        rates = {layout.name: layout.sampling_rate for layout in ordered}
        rows = BlockWriter(
            *(writer, rates, thermometers),
            speed=self.clock.speed,
            share_of_repeats=self.share_of_repeats,
        )
        rows.write(
            Reading(layout.name, Quantity.TEMPERATURE, layout.temperature, self._started)
            for layout in ordered
            if layout.temperature is not None
        )
        return rows

    async def _write_until_end(
        self, duration: float | None, tasks: Sequence[asyncio.Task[None]]
    ) -> None:
        """Write and commit the items of the connections until the run ends."""
        loop, writer = asyncio.get_running_loop(), self._writer
        last_commit, n_committed = -math.inf, 0
        watch, host_times = ClockWatch(self.clock), ReadingTimes()
        while not self.stop.is_set():
            batch = await self._batch()
            if (report := watch.look()) is not None:
                batch.append(report)
            now = self.clock.now()
            if host_times.is_due(now) and (celsius := host_temperature()) is not None:
                batch.append(Reading("", Quantity.TEMPERATURE, celsius, now))
            await self._done(partial(writer.write, batch), partial(writer.write, ()))
            for task in tasks:
                if task.done():  # only an error in the program ends a connection
                    task.result()
            chunk_waits = writer.n_written > n_committed
            interval = MIN_COMMIT_INTERVAL if chunk_waits else COMMIT_INTERVAL
            if loop.time() >= last_commit + interval:
                n_committed = writer.n_written
                self._acknowledge(await self._done(writer.commit))
                last_commit = loop.time()
            elif (sensors := self._with_current_states()) != self._status.sensors:
                self._publish(replace(self._status, sensors=sensors))
            if duration is not None and self._is_complete(duration):
                self._end_reason = "duration reached"
                return

    async def _batch(self) -> list[Item]:
        """Return the items of a short interval, so that one call of the thread writes many."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_BATCH_INTERVAL):
                await self.stop.wait()
        return self._queued()

    def _queued(self) -> list[Item]:
        batch: list[Item] = []
        while not self._queue.empty():
            batch.append(self._queue.get_nowait())
        return batch

    async def _finish(self) -> None:
        write = self._writer.write
        await self._done(partial(write, self._queued()), partial(write, ()))
        close = partial(self._writer.close, self.clock.now(), self._end_reason)
        self._acknowledge(await self._done(close))

    async def _done(
        self, action: Callable[[], _Result], again: Callable[[], _Result] | None = None
    ) -> _Result:
        """Run `action` on the file; if the disk refuses, run `again` on another file."""
        try:
            return await self._thread.run(action)
        except DiskError as error:
            await self._thread.run(partial(self._continue, error))
        return await self._thread.run(again or action)

    def _continue(self, error: DiskError) -> None:
        """Continue the recording in another file.

        Raises
        ------
        DiskError
            The given error, if no other file can be created, or if this one did not last.
        """
        now, before = self.clock.now(), self._file
        lasted = (now.monotonic_ns - self._file_started.monotonic_ns) / 1e9
        if before != self._path and lasted < MIN_CONTINUATION:
            raise DiskError(f"{error}; {self._safe(error)}") from error
        path = next(each for each in continuation_names(self._path) if not each.exists())
        attributes = {**self.attributes, CONTINUES: self._writer.run_id}
        following = None
        try:
            following = self._new_file(path, created=now, attributes=attributes)
            self._writer.continue_in(following, lost=isinstance(error, RemovedError))
        except RecordingError:
            if following is not None:
                following.discard()
            raise DiskError(f"{error}; {self._safe(error)}") from error
        self._file, self._file_started = path, now
        _LOGGER.error("%s; the recording continues in %s", error, path)
        text = f"continues {error}"
        self._writer.write([Event("", EventKind.STATUS, text, now)])

    def _safe(self, error: DiskError) -> str:
        """Return how much of each sensor is safe on the disk."""
        if isinstance(error, RemovedError):
            return "what was in it is lost"
        rates = {sensor.name: sensor.sampling_rate for sensor in self.bench.sensors}
        seconds = [one.samples / rates[name] for name, one in self._status.sensors.items()]
        return f"{min(seconds, default=0.0):.0f} s of every sensor are safe"

    def _report_space(self, layouts: Sequence[SensorLayout], duration: float | None) -> None:
        """Log how long the free space lasts, as a warning if that is too short."""
        wanted = sum(
            layout.sampling_rate * len(layout.channels) * layout.dtype.itemsize
            for layout in layouts
        )
        with contextlib.suppress(OSError):
            free = shutil.disk_usage(self._path.absolute().parent).free
            is_enough = free / wanted >= (SPACE_FOR if duration is None else duration)
            level = logging.INFO if is_enough else logging.WARNING
            step = next((each for each in (86400, 60) if free / wanted > 7 * each), 1)
            lasts = format_duration(free / wanted // step * step)
            _LOGGER.log(level, "%.0f MB of free space last for %s or longer", free / 1e6, lasts)

    def _acknowledge(self, committed: Committed) -> None:
        sensors = self._writer.progress(committed)
        self._publish(RecorderStatus(str(self._file), self._elapsed(), sensors, committed.closed))

    def _publish(self, status: RecorderStatus) -> None:
        self._status = status
        if self.acknowledged is not None:
            self.acknowledged(status)

    def _with_current_states(self) -> dict[str, SensorProgress]:
        """Return the last acknowledged counts with the current states."""
        states = self._writer.states()
        return {n: replace(one, state=states[n]) for n, one in self._status.sensors.items()}

    def _elapsed(self) -> float:
        return (self.clock.now().monotonic_ns - self._started.monotonic_ns) / 1e9

    def _is_complete(self, duration: float) -> bool:
        recorded = self._writer.recorded_seconds()
        return recorded >= duration or self._elapsed() >= duration + _LAST_BLOCKS

    async def _answer(self, command: Command, text: str) -> dict[str, Any]:
        """Execute a command of the control channel."""
        if command is Command.STOP:
            self._end_reason = "stopped by command"
            self.stop.set()
        elif command is Command.MARK:
            await self._queue.put(Event("", EventKind.MARK, text, self.clock.now()))
        elif command is Command.UNCOUNTED:
            try:
                utc_ns, within, n_samples, sensor = text.split(" ", 3)
                found = Uncounted(int(utc_ns), float(within), int(n_samples))
                event = Event(sensor, EventKind.UNCOUNTED, found.in_words, self.clock.now())
            except (ValueError, OverflowError, OSError):
                return {"error": f"uncounted: expected a time, two numbers and a sensor: {text!r}"}
            if sensor not in self._status.sensors:
                return {"error": f"uncounted: no sensor {sensor!r}"}
            known = self._uncounted.setdefault(sensor, [])
            if not any(found.is_that(one) for one in known):  # several may follow the recording
                known.append(found)
                await self._queue.put(event)
        return self._status.to_dict()


def _thermometer(sensor: Sensor) -> dict[str, tuple[int, float]]:
    """Return column and sensitivity of the first auxiliary channel in °C, by the sensor's name."""
    for column, channel in enumerate(sensor.channels):
        if channel.auxiliary and channel.unit == CELSIUS:
            return {sensor.name: (column, channel.sensitivity)}
    return {}


def host_temperature(zones: Path = Path("/sys/class/thermal")) -> float | None:
    """Return the highest temperature of the computer in °C; None if the system states none."""
    found = []
    for zone in zones.glob("thermal_zone*/temp"):
        with contextlib.suppress(OSError, ValueError):
            found.append(int(zone.read_text()) / 1000)
    return max(found, default=None)
