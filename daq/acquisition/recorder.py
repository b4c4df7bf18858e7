"""The recorder: all devices of a bench into one recording, until told to stop.

Theory of operation ------------------- One task a port
(:class:`daq.acquisition.connection.Connection`) puts what comes into one bounded queue; one writer
takes it from there in batches, places it (:mod:`daq.acquisition.sample_index`) and hands it to the
file in a thread of its own, so that neither compression nor ``fsync`` delays a port. About twice a
second, and when a whole chunk of samples is written, it commits, and only then acknowledges. When
writing lags, the queue fills, ports wait, and the system's buffers hold what comes.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import re
import signal
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

from daq.acquisition.block_writer import BlockWriter, SensorStatus
from daq.acquisition.connection import LEAVE_TIMEOUT, Connection
from daq.drivers.registry import driver_type
from daq.errors import DeviceError
from daq.host_clock import SystemClock
from daq.protocols.block import Event, EventKind
from daq.protocols.errors import RemoteProtocolError
from daq.recording import control
from daq.recording.file_format import SensorLayout
from daq.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from daq.acquisition.connection import Item
    from daq.bench.model import Bench
    from daq.drivers.interface import DriverType
    from daq.host_clock import HostClock
    from daq.protocols.block import HostTime
    from daq.recording.writer import Committed

_LOGGER = logging.getLogger(__name__)
QUEUE_LENGTH = 4096
COMMIT_INTERVAL, LEAST_COMMIT_INTERVAL = 0.5, 0.25
"""Between commits, s: the usual one, and the one where a whole chunk of samples waits for it."""
CANCEL_TIMEOUT = LEAVE_TIMEOUT + 2.0
"""For all connections to end, s."""
_BATCH_INTERVAL = 0.1
_LAST_BLOCKS = 1.0
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class Status:
    """An acknowledgment: all this is safe on disk."""

    path: str
    elapsed: float
    """Host time since the start, in s."""
    sensors: dict[str, SensorStatus]
    closed: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self)


def recording_path(bench: Bench, at: HostTime) -> Path:
    """Return the usual path of a recording that starts now."""
    name = re.sub(r"[^\w.-]+", "-", bench.name).strip("-.") or "recording"
    utc = datetime.fromtimestamp(at.utc_ns / 1e9, tz=UTC)
    return bench.recording_directory / f"{name}-{utc:%Y%m%dT%H%M%SZ}.h5"


def run(
    bench: Bench,
    path: str | Path,
    *,
    duration: float | None = None,
    acknowledged: Callable[[Status], None] | None = None,
) -> Status:
    """Record until done, SIGINT or SIGTERM, in the main thread; see :func:`record`."""

    async def main() -> Status:
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                loop.add_signal_handler(number, stop.set)
            except NotImplementedError:  # Windows
                signal.signal(number, lambda *_: loop.call_soon_threadsafe(stop.set))
        return await record(bench, path, duration=duration, stop=stop, acknowledged=acknowledged)

    runner = asyncio.Runner()
    try:
        return runner.run(main())
    finally:
        # Closing waits for ever for a driver that does not end, and no signal would help.
        if not asyncio.all_tasks(runner.get_loop()):
            runner.close()


async def record(
    bench: Bench,
    path: str | Path,
    *,
    duration: float | None = None,
    clock: HostClock | None = None,
    stop: asyncio.Event | None = None,
    acknowledged: Callable[[Status], None] | None = None,
    drivers: Callable[[str], DriverType] = driver_type,
) -> Status:
    """Record a bench.

    Parameters
    ----------
    bench : Bench
        What to record.
    path : path
        The new file.
    duration : float, optional
        How much of every sensor to record, in s of its own samples; a sensor that is lost is waited
        for no longer than that in host time. Without it: until ``stop``.
    clock : HostClock, optional
        Where host times come from; the system's, at the bench's speed, if not given.
    stop : asyncio.Event, optional
        Ends the recording properly when set.
    acknowledged : callable, optional
        Called after every commit, and when the state of a sensor has changed.
    drivers : callable
        Finds drivers by name.

    Returns
    -------
    Status
        Of the closed recording; not ``closed``, and without a file, if ``stop`` came before all
        devices were connected.

    Raises
    ------
    ExceptionGroup of DeviceError
        If devices cannot be used at the start: all of them, each naming its sensor.
    RecordingError
        If the file cannot be written; what was acknowledged stays.
    """
    clock = SystemClock(bench.speed) if clock is None else clock
    recorder = _Recorder(bench, Path(path), clock, stop or asyncio.Event(), acknowledged)
    return await recorder.run(duration, drivers)


class _Recorder:
    def __init__(
        self,
        bench: Bench,
        path: Path,
        clock: HostClock,
        stop: asyncio.Event,
        acknowledged: Callable[[Status], None] | None,
    ) -> None:
        self._bench = bench
        self._path = path
        self._clock = clock
        self._stop = stop
        self._acknowledged = acknowledged
        self._queue: asyncio.Queue[Item] = asyncio.Queue(QUEUE_LENGTH)
        self._started = clock.now()
        self._reason = "stopped"
        self._status = Status(str(path), 0.0, {})

    async def run(self, duration: float | None, drivers: Callable[[str], DriverType]) -> Status:
        connections = [
            Connection(drivers(sensors[0].driver), sensors, self._clock)
            for sensors in self._bench.ports().values()
        ]
        go = asyncio.Event()
        async with control.serve(self._answer) as address:
            tasks = [asyncio.create_task(c.run(self._queue, go), name=c.port) for c in connections]
            try:
                if not await self._all_connected(connections):
                    return self._status
                with _WritingThread() as thread:
                    intake = await thread.run(lambda: self._create(connections, address, duration))
                    try:
                        go.set()
                        await self._write(intake, thread, duration, tasks)
                        await self._cancel(tasks)
                        await self._finish(intake, thread)
                    except BaseException:
                        await asyncio.shield(thread.run(intake.abandon))
                        raise
            finally:
                await self._cancel(tasks)
        return self._status

    async def _cancel(self, tasks: list[asyncio.Task[None]]) -> None:
        """Cancel what is left of tasks; wait until they have left their devices quiet.

        Not for ever: one that does not end is said to, and left alone.
        """
        going = [task for task in tasks if not task.done()]
        for task in going:
            task.cancel()
        if not going:
            return
        _, stuck = await asyncio.wait(going, timeout=CANCEL_TIMEOUT)
        for task in stuck:
            tasks.remove(task)
            text = f"the driver on {task.get_name()} does not end; it was left alone"
            with contextlib.suppress(asyncio.QueueFull):
                self._queue.put_nowait(Event("", EventKind.STATUS, text, self._clock.now()))

    async def _all_connected(self, connections: list[Connection]) -> bool:
        stopped = asyncio.ensure_future(self._stop.wait())
        waiting = asyncio.gather(*(c.connected for c in connections), return_exceptions=True)
        try:
            await asyncio.wait((waiting, stopped), return_when=asyncio.FIRST_COMPLETED)
            if self._stop.is_set():
                return False
            failures = [e for e in waiting.result() if isinstance(e, Exception)]
        finally:
            waiting.cancel()
            stopped.cancel()
            await asyncio.wait([stopped])
        for failure in failures:
            if not isinstance(failure, (DeviceError, RemoteProtocolError)):
                raise failure  # the bench's fault, or the program's, but no device's
        if failures:
            raise ExceptionGroup(f"{len(failures)} ports cannot be used", failures)
        return True

    def _create(
        self, connections: list[Connection], address: tuple[int, str], duration: float | None
    ) -> BlockWriter:
        layouts: dict[str, SensorLayout] = {}
        for connection in connections:
            information = {i.sensor: i for i in connection.information}
            for sensor in connection.sensors:
                layout = SensorLayout.of(sensor, connection.driver)
                said = information.get(sensor.name)
                if said is not None:
                    layout = replace(
                        layout,
                        sampling_rate=said.sampling_rate or layout.sampling_rate,
                        model=said.model or layout.model,
                        serial_number=said.serial_number or layout.serial_number,
                    )
                layouts[sensor.name] = layout
        ordered = [layouts[sensor.name] for sensor in self._bench.sensors]
        self._started = self._clock.now()
        writer = RecordingWriter.create(
            self._path,
            self._bench,
            sensors=ordered,
            created=self._started,
            control=address,
            attributes={} if duration is None else {"duration": duration},
        )
        writer.event(Event("", EventKind.STARTED, f"{len(ordered)} sensors", self._started))
        _LOGGER.info("recording to %s", self._path, extra={"recording": str(self._path)})
        return BlockWriter(writer, {layout.name: layout.sampling_rate for layout in ordered})

    async def _write(
        self,
        intake: BlockWriter,
        thread: _WritingThread,
        duration: float | None,
        tasks: Sequence[asyncio.Task[None]],
    ) -> None:
        """Take what comes from the queue until it is time to stop."""
        loop = asyncio.get_running_loop()
        last_commit, n_committed = -math.inf, 0
        while not self._stop.is_set():
            batch = await self._batch()
            await thread.run(partial(intake.take, batch))
            for task in tasks:
                if task.done():  # a connection ends only by a fault in the code
                    task.result()
            waits = intake.n_written > n_committed
            if loop.time() >= last_commit + (LEAST_COMMIT_INTERVAL if waits else COMMIT_INTERVAL):
                n_committed = intake.n_written
                self._acknowledge(intake, await thread.run(intake.commit))
                last_commit = loop.time()
            elif (sensors := self._with_states(intake)) != self._status.sensors:
                self._tell(replace(self._status, sensors=sensors))
            if duration is not None and self._is_complete(intake, duration):
                self._reason = "duration reached"
                return

    async def _batch(self) -> list[Item]:
        """Return what has come in the next moment: one trip to the thread for many blocks."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_BATCH_INTERVAL):
                await self._stop.wait()
        return self._waiting()

    def _waiting(self) -> list[Item]:
        batch: list[Item] = []
        while not self._queue.empty():
            batch.append(self._queue.get_nowait())
        return batch

    async def _finish(self, intake: BlockWriter, thread: _WritingThread) -> None:
        await thread.run(partial(intake.take, self._waiting()))
        close = partial(intake.close, self._clock.now(), self._reason)
        self._acknowledge(intake, await thread.run(close))

    def _acknowledge(self, intake: BlockWriter, committed: Committed) -> None:
        self._tell(
            Status(str(self._path), self._elapsed(), intake.status(committed), committed.closed)
        )

    def _tell(self, status: Status) -> None:
        self._status = status
        if self._acknowledged is not None:
            self._acknowledged(status)

    def _with_states(self, intake: BlockWriter) -> dict[str, SensorStatus]:
        """Return what was acknowledged last, with what the sensors' states are now."""
        states = intake.states()
        return {n: replace(one, state=states[n]) for n, one in self._status.sensors.items()}

    def _elapsed(self) -> float:
        return (self._clock.now().monotonic_ns - self._started.monotonic_ns) / 1e9

    def _is_complete(self, intake: BlockWriter, duration: float) -> bool:
        if intake.recorded() >= duration:
            return True
        # Blocks of the last moment are still on their way.
        return self._elapsed() >= duration + _LAST_BLOCKS

    async def _answer(self, command: str, text: str) -> dict[str, Any]:
        """Do what came through the control channel."""
        if command == "stop":
            self._reason = "stopped by command"
            self._stop.set()
        elif command == "mark":
            await self._queue.put(Event("", EventKind.MARK, text, self._clock.now()))
        return self._status.to_dict()


class _WritingThread:
    """The one thread that touches the file."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="recording")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()

    async def run(self, function: Callable[[], _Result]) -> _Result:
        """Run a function there, to its end even if this task is cancelled meanwhile."""
        future = asyncio.get_running_loop().run_in_executor(self._executor, function)
        try:
            return await asyncio.shield(future)
        except asyncio.CancelledError:
            await asyncio.wait([future])
            raise
