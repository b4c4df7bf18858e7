"""Tests that every driver must pass, run against its simulated device.

A package subclasses :class:`DriverConformance` in one of its test modules::

    class TestAX3(DriverConformance):
        driver = DRIVER

        @contextlib.asynccontextmanager
        async def serve(self):
            server = ...
            yield Served([Sensor(...)], vanish=server.close, truth=server.sent)

The tests run in real time, each for some seconds. Where the sensors' port is ``socket://``, the
suite also puts itself between driver and device and lets the connection pause.

Only with ``truth`` can the suite see whether samples, times and rates are right: a driver that
drops one sample in fifty or swaps two channels yields blocks in perfect order.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import pytest
from pydantic import BaseModel

from daq.errors import DeviceError, NoAnswerError, NotConnectedError
from daq.host_clock import HostClock, SystemClock
from daq.protocols.block import Block, BlockFlag, DeviceItem, Event, EventKind, HostTime
from daq.protocols.errors import RemoteProtocolError
from daq.recorder.connection import BlockValidator
from daq.transport.address import host_and_port

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Sequence
    from contextlib import AbstractAsyncContextManager

    from numpy.typing import NDArray

    from daq.bench.model import Sensor
    from daq.devices.interface import AnyDriver

LIMIT = 60.0
"""Seconds that any test may take."""
PAUSE = 2.0
"""Seconds for which a connection pauses."""
LATENCY = 0.3
"""Seconds by which the host time of a block may be later than its last sample."""
EARLY = 0.02
"""Seconds by which it may be earlier: clocks of simulators are read before or after sampling."""
RATE_ERROR = 0.005
"""Relative difference between the rate of the device and that of the bench file, beside the error
of the clock by which the rate is measured: ``EARLY`` at both ends of the rows."""
MAX_DRIFT = 0.06
"""Seconds by which the delay of host times may change from the first half of a session to the
second."""
MIN_HALF = 5
"""Number of blocks in half of a session from which this is tested."""
MAX_BLOCKED = 0.05
"""Seconds for which a driver may keep the event loop busy."""
TICK = 0.005
"""Interval at which the event loop is observed, in s."""
NORMAL_EVENTS = {EventKind.CONNECTED, EventKind.STATUS}
"""Kinds of events of a device that nothing is wrong with."""
SOCKET = "socket://"


@dataclass(frozen=True, slots=True, eq=False)
class Sent:
    """What a simulated device has sent of one sensor.

    Attributes
    ----------
    counts : ndarray, shape (n_samples, n_channels)
        Every sample since the device started, those lost on the wire included.
    due : ndarray, shape (n_samples,)
        When each sample was taken or left the device, in s of ``time.monotonic``.
    """

    counts: NDArray[Any]
    due: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Served:
    """A simulated device that runs.

    Attributes
    ----------
    sensors
        All sensors of its port, as a bench file would connect to them.
    vanish : callable or None
        Ends the device at once, as a pulled cable does.
    truth : callable or None
        Takes the name of a sensor and returns what the device has sent of it so far. Samples must
        differ from one another.
    drop : callable or None
        Lets the wire lose some samples, which the device counts.
    pause : callable or None
        Lets the wire hold everything for some seconds and then deliver it. Not needed where the
        port is ``socket://``.
    slip : callable or None
        Takes a number of samples, which the device leaves out without counting them. Of a negative
        number it sends its last samples again and counts them as new ones.
    restart : callable or None
        Restarts the device: nothing is sampled for a second, then its counter begins again.
    away : callable or None
        Takes the name of a sensor of a shared port, and whether its device does not answer.
    """

    sensors: Sequence[Sensor]
    vanish: Callable[[], object] | None = None
    truth: Callable[[str], Sent] | None = None
    drop: Callable[[], object] | None = None
    pause: Callable[[], object] | None = None
    slip: Callable[[int], object] | None = None
    restart: Callable[[], object] | None = None
    away: Callable[[str, bool], object] | None = None


class DriverConformance:
    """The tests; a subclass names the driver and serves its simulated device."""

    driver: ClassVar[AnyDriver]
    seconds: ClassVar[float] = 2.0
    """How much is read of every sensor, in seconds of its sampling rate."""

    def serve(self) -> AbstractAsyncContextManager[Served]:
        """Serve a simulated device until the context ends."""
        raise NotImplementedError

    # --- what it says ------------------------------------------------------------------------

    def test_it_says_what_it_is(self) -> None:
        """Name, summary, settings that refuse unknown keys."""
        driver = self.driver
        assert driver.name == driver.name.strip() != ""
        assert driver.summary, "a line for huddle init and huddle check"
        assert isinstance(driver.shares_clock, bool)
        assert issubclass(driver.settings, BaseModel)
        forbids = driver.settings.model_config.get("extra") == "forbid"
        assert forbids, "a misspelt setting must be an error: ConfigDict(extra='forbid')"

    # --- what it yields ----------------------------------------------------------------------

    def test_blocks_are_in_order_and_whole(self) -> None:
        """Twice: the port is free again after a session, and a session begins with sample 0."""

        async def run() -> None:
            async with self.serve() as served:
                for _ in range(2):
                    check_blocks(self.driver, served.sensors, await self._read(served.sensors))

        _run(run())

    def test_a_pause_ends_nothing(self) -> None:
        """The network holds everything for two seconds, then delivers it."""

        async def run() -> None:
            async with self.serve() as served:
                port = served.sensors[0].port
                if served.pause is not None:
                    found = await self._read(served.sensors, pauses=served.pause)
                    check_blocks(self.driver, served.sensors, found)
                    return
                if not port.startswith(SOCKET):
                    pytest.skip(f"the suite pauses socket:// ports; Served(pause=…) for {port}")
                async with _Proxy(*host_and_port(port)) as proxy:
                    sensors = [s.model_copy(update={"port": proxy.port}) for s in served.sensors]
                    found = await self._read(sensors, pauses=proxy.pause)
                    check_blocks(self.driver, sensors, found)

        _run(run())

    # --- whether it is true ------------------------------------------------------------------

    def test_rows_times_and_rate_are_those_of_the_device(self) -> None:
        """Every row in its place, received when it was due, at the rate of the bench file."""

        async def run() -> None:
            async with self.serve() as served:
                truth = _truth(served)
                found = await self._read(served.sensors)
                check_counters(served.sensors, found)
                for sensor in served.sensors:
                    check_truth(sensor, found, truth(sensor.name))

        _run(run())

    def test_the_event_loop_is_not_blocked(self) -> None:
        """Other devices share the loop: no call may keep it for longer than ``MAX_BLOCKED``."""

        async def run() -> None:
            async with self.serve() as served, watching_the_loop() as blocked:
                await self._read(served.sensors)
            assert not blocked, f"the event loop was blocked for {max(blocked):.3f} s"

        _run(run())

    def test_lost_samples_become_a_gap(self) -> None:
        """The wire loses samples: all later rows keep their places."""

        async def run() -> None:
            async with self.serve() as served:
                truth = _truth(served)
                if served.drop is None:
                    pytest.skip("the simulated device drops nothing")
                found = await self._read(served.sensors, first=served.drop, truth=truth)
                for sensor in served.sensors:
                    check_truth(sensor, found, truth(sensor.name), gaps=True)

        _run(run())

    @pytest.mark.parametrize("n_samples", [3, -3], ids=["left out", "counted twice"])
    def test_samples_that_no_counter_shows_change_nothing(self, n_samples: int) -> None:
        """Rows are numbered as the device counts: estimates find the step in the motion."""

        async def run() -> None:
            async with self.serve() as served:
                truth, slip = _truth(served), served.slip
                if slip is None:
                    pytest.skip("the simulated device counts right")
                found = await self._read(served.sensors, first=lambda: slip(n_samples), truth=truth)
                for sensor in served.sensors:
                    check_truth(sensor, found, truth(sensor.name), steady=False)

        _run(run())

    def test_a_restart_of_the_device_is_flagged(self) -> None:
        """Rows before and after are right, and the length of the gap follows from host time."""

        async def run() -> None:
            async with self.serve() as served:
                truth = _truth(served)
                if served.restart is None:
                    pytest.skip("the simulated device does not restart")
                found = await self._read(served.sensors, first=served.restart, truth=truth)
                for sensor in served.sensors:
                    check_restart(sensor, found, truth(sensor.name))

        _run(run())

    def test_a_hang_up_after_an_arrival_loses_nothing_that_arrived(self) -> None:
        """The line ends between a read and whatever the driver sends next."""

        async def run() -> None:
            async with self.serve() as served:
                truth, vanish = _truth(served), served.vanish
                if vanish is None:
                    pytest.skip("the simulated device cannot vanish")
                n_sent: dict[str, int] = {}

                def cut() -> None:
                    n_sent.update({s.name: len(truth(s.name).due) for s in served.sensors})
                    vanish()

                clock = CuttingClock(SystemClock(), cut)
                found: list[DeviceItem] = []
                with pytest.raises((NotConnectedError, NoAnswerError)):
                    await self._read(
                        served.sensors, first=clock.arm, seconds=1e6, clock=clock, into=found
                    )
                for sensor in served.sensors:
                    end = check_truth(sensor, found, truth(sensor.name))
                    lost = n_sent[sensor.name] - end
                    assert lost <= 0, f"{lost} samples had arrived and were not handed on"

        _run(run())

    # --- what goes wrong ---------------------------------------------------------------------

    def test_a_port_that_is_not_there_is_named(self) -> None:
        """By sensor and port."""

        async def run() -> None:
            async with self.serve() as served:
                sensors = _at(served.sensors, 1)
            with pytest.raises(NotConnectedError) as caught:
                await self._read(sensors)
            assert sensors[0].port in str(caught.value)
            assert sensors[0].name in str(caught.value)

        _run(run())

    @pytest.mark.parametrize("garbage", [b"", bytes(range(256)) * 3], ids=["silence", "garbage"])
    def test_strangers_are_no_devices(self, garbage: bytes) -> None:
        """Something listens at the port that is no such device: an error, and no block."""

        async def run() -> None:
            async with self.serve() as served, stranger(garbage) as number:
                sensors = _at(served.sensors, number)
                with pytest.raises((DeviceError, RemoteProtocolError)):
                    await self._read(sensors)

        _run(run())

    def test_a_device_that_is_away_costs_the_others_nothing(self) -> None:
        """It is named when the port is opened, tried again, and recorded when it answers."""

        async def run() -> None:
            async with self.serve() as served:
                if served.away is None:
                    pytest.skip("the simulated devices of a port cannot be away one by one")
                gone, *others = (sensor.name for sensor in served.sensors)
                wanted = {one.name: self.seconds * one.sampling_rate for one in served.sensors}
                served.away(gone, True)
                async with self.driver.open(served.sensors, SystemClock()) as session:
                    troubled = [one.sensor for one in session.information if one.trouble]
                    assert troubled == [gone], "`trouble` of the device that is away, only"
                    rows = dict.fromkeys(wanted, 0)
                    async for item in session.read():
                        if not isinstance(item, Block):
                            continue
                        name = item.sensor
                        assert name == gone or item.first_sample == rows[name], "a gap of another"
                        rows[name] += item.n_samples
                        if not rows[gone] and all(rows[one] >= wanted[one] for one in others):
                            served.away(gone, False)
                        if rows[gone] >= wanted[gone]:
                            break

        _run(run())

    def test_a_device_that_vanishes_ends_the_session(self) -> None:
        """With an error that names a sensor."""

        async def run() -> None:
            async with self.serve() as served:
                if served.vanish is None:
                    pytest.skip("the simulated device cannot vanish")
                with pytest.raises((NotConnectedError, NoAnswerError)) as caught:
                    await self._read(served.sensors, first=served.vanish, seconds=1e6)
                assert any(sensor.name in str(caught.value) for sensor in served.sensors)

        _run(run())

    async def _read(
        self,
        sensors: Sequence[Sensor],
        *,
        pauses: Callable[[], object] | None = None,
        first: Callable[[], object] | None = None,
        truth: Callable[[str], Sent] | None = None,
        seconds: float | None = None,
        clock: HostClock | None = None,
        into: list[DeviceItem] | None = None,
    ) -> list[DeviceItem]:
        """Read until every sensor has enough; ``first`` and ``pauses`` are called once, early.

        With ``truth``, what was sent before comes in addition: on a busy computer that is much.
        """
        wanted = {s.name: (seconds or self.seconds) * s.sampling_rate for s in sensors}
        found: list[DeviceItem] = [] if into is None else into
        ends = dict.fromkeys(wanted, 0)
        validator = BlockValidator(self.driver, sensors)
        async with self.driver.open(sensors, clock or SystemClock()) as session:
            assert [one.sensor for one in session.information] == list(wanted)
            for one, sensor in zip(session.information, sensors, strict=True):
                check_rate(sensor, one.sampling_rate)
            patience = session.patience
            assert patience > 0
            items = cast("AsyncGenerator[DeviceItem]", session.read())
            async with contextlib.aclosing(items):
                while any(ends[name] < n for name, n in wanted.items()):
                    try:
                        async with asyncio.timeout(patience):
                            item = validator.validated(await anext(items))
                    except TimeoutError as error:
                        if isinstance(error, DeviceError):
                            raise
                        name = sensors[0].name
                        raise NoAnswerError(f"{name!r}: nothing in {patience:g} s") from error
                    found.append(item)
                    if isinstance(item, Block):
                        ends[item.sensor] = item.end_sample
                        for act in filter(None, (pauses, first)):
                            act()
                        if first is not None and truth is not None:
                            wanted = {name: n + len(truth(name).due) for name, n in wanted.items()}
                        pauses = first = None
        return found


def _blocks_of(sensor: Sensor, found: Sequence[DeviceItem]) -> list[Block]:
    return [one for one in found if isinstance(one, Block) and one.sensor == sensor.name]


def check_blocks(driver: AnyDriver, sensors: Sequence[Sensor], found: Sequence[DeviceItem]) -> None:
    """See that the blocks of a session follow one another, and that nothing was wrong."""
    wrong = [item for item in found if isinstance(item, Event) and item.kind not in NORMAL_EVENTS]
    assert not wrong
    for sensor in sensors:
        blocks = _blocks_of(sensor, found)
        assert blocks, f"no block of {sensor.name}"
        assert blocks[0].first_sample == 0
        assert BlockFlag.CLOCK_RESTART in blocks[0].flags, "the sampling clock begins here"
        assert not blocks[0].reason, "nothing was lost before the first sample"
        dtype = driver.counts_dtype(sensor)
        end, at = 0, 0
        for block in blocks:
            assert block.counts.dtype == dtype
            assert block.counts.shape == (block.n_samples, len(sensor.channels))
            if block.instants_ns is None:
                assert block.first_sample == end, "samples were lost"
            else:  # a busy host polls late, and says what it left out
                assert block.first_sample >= end
                assert bool(block.reason) == (block.first_sample > end)
                assert np.all(np.diff(block.instants_ns) > 0)
            assert block.received.monotonic_ns >= at
            end, at = block.end_sample, block.received.monotonic_ns


_TIME_STEP = 1_000_000
"""Steps in ns in which devices may state the time: text loggers write milliseconds."""


def check_counters(sensors: Sequence[Sensor], found: Sequence[DeviceItem]) -> None:
    """See that the device's counter of each sensor grows with the index of the samples.

    A counter of samples grows evenly. One that grows by 1e9 a second is a time in ns, and each
    of its values is rounded by up to half of ``_TIME_STEP``, however few samples a block has.
    """
    for sensor in sensors:
        blocks = [b for b in _blocks_of(sensor, found) if b.device_counter is not None]
        counters = np.array([block.device_counter for block in blocks], np.int64)
        index = np.array([block.first_sample for block in blocks], np.int64)
        assert np.all(np.diff(counters) > 0), f"device_counter of {sensor.name} does not grow"
        if len(blocks) > 2:
            slope = np.diff(counters) / np.diff(index)
            mean = (counters[-1] - counters[0]) / (index[-1] - index[0])
            rounded = _TIME_STEP / np.diff(index) if _is_time(mean, sensor) else 0.0
            uneven = f"device_counter of {sensor.name} is uneven"
            assert np.all(abs(slope - mean) <= 0.01 * mean + rounded), uneven


def _is_time(slope: float, sensor: Sensor) -> bool:
    """Return whether a counter that grows by ``slope`` a sample is the time in ns."""
    return abs(slope * sensor.sampling_rate / 1e9 - 1) <= 0.05


def check_rate(
    sensor: Sensor, rate: float | None, *, source: str = "stated", error: float = 0.0
) -> None:
    """See that a rate, if one is known with a relative ``error``, is that of the bench file."""
    off = rate / sensor.sampling_rate - 1 if rate is not None else 0.0
    assert abs(off) <= RATE_ERROR + error, (
        f"{sensor.name}: {source} rate {rate:.5g} Hz, {off:+.1%} off the bench file's"
    )


def check_truth(
    sensor: Sensor,
    found: Sequence[DeviceItem],
    sent: Sent,
    *,
    gaps: bool = False,
    steady: bool = True,
) -> int:
    """See that rows, host times and rate of a session are those of the device.

    Parameters
    ----------
    gaps
        Whether samples may, and must, be missing.
    steady
        Whether the device samples at its rate throughout.

    Returns
    -------
    int
        The number of samples sent up to the last row.
    """
    name, blocks = sensor.name, _blocks_of(sensor, found)
    index = np.concatenate([np.arange(b.first_sample, b.end_sample) for b in blocks])
    counts = np.concatenate([block.counts for block in blocks])
    starts = np.flatnonzero(_same(sent.counts, counts[0]))
    n_first = min(blocks[0].n_samples, 8)
    start = next(
        (s for s in starts if _same(sent.counts[s : s + n_first], counts[:n_first]).all()), None
    )
    assert start is not None, f"{name}: no row sent is {counts[0]}: channels or scale are wrong"
    place = index + (start - index[0])
    assert place[-1] < len(sent.counts), f"{name}: rows were numbered that were not sent"
    wrong = ~_same(sent.counts[place], counts)
    assert not wrong.any(), (
        f"{name}: {wrong.sum()} of {len(wrong)} rows are not those of their numbers, the first is"
        f" {index[wrong.argmax()]}"
    )
    n_gaps = np.count_nonzero(np.diff(index) > 1)
    assert bool(n_gaps) == gaps, f"{name}: {n_gaps} gaps"
    last = place[np.cumsum([block.n_samples for block in blocks]) - 1]
    received = np.array([block.received.monotonic_ns * 1e-9 for block in blocks])
    late = received - sent.due[last]
    assert late.min() >= -EARLY, f"{name}: received {-late.min():.3f} s before it was sampled"
    usual = np.quantile(late, 0.25)  # a busy computer delays some, a driver all
    assert usual <= LATENCY, f"{name}: received {usual:.3f} s after the last sample"
    if len(late) >= 2 * MIN_HALF:  # the least of a half: others may have been held up
        halves = np.split(late, [len(late) // 2])
        drift = halves[1].min() - halves[0].min()
        assert abs(drift) <= MAX_DRIFT, f"{name}: host time runs away by {drift:.3f} s"
    elapsed = sent.due[place[-1]] - sent.due[place[0]]
    if elapsed > 0 and steady:
        rate = (place[-1] - place[0]) / elapsed
        check_rate(sensor, rate, source="measured", error=2 * EARLY / elapsed)
    return int(place[-1]) + 1


def check_restart(sensor: Sensor, found: Sequence[DeviceItem], sent: Sent) -> None:
    """See that a session has one restart of the device, and that rows on both sides are right."""
    name, rate, blocks = sensor.name, sensor.sampling_rate, _blocks_of(sensor, found)
    anew = [k for k, b in enumerate(blocks) if BlockFlag.CLOCK_RESTART in b.flags]
    assert len(anew) == 2, f"{name}: {len(anew)} blocks with CLOCK_RESTART; expected 2"
    before, after = blocks[: anew[1]], blocks[anew[1] :]
    assert BlockFlag.MISSING_ESTIMATED in after[0].flags, f"{name}: the gap is not exact"
    end = check_truth(sensor, before, sent, steady=False)
    last = check_truth(sensor, after, sent, steady=False)
    first = last - (after[-1].end_sample - after[0].first_sample)
    missing = (sent.due[first] - sent.due[end - 1]) * rate - 1
    off = after[0].first_sample - before[-1].end_sample - missing
    assert abs(off) <= 2 * LATENCY * rate, f"{name}: the gap is off by {off:.0f} samples"


def _same(sent: NDArray[Any], counts: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which rows are equal; of whole counts, what was sent may be given before rounding."""
    is_whole = np.issubdtype(counts.dtype, np.integer)
    relative = 1e-8 if is_whole else max(1e-8, float(np.finfo(counts.dtype).eps))
    most = (0.5 if is_whole else 0.0) + relative * np.abs(sent)
    same: NDArray[np.bool_] = (np.abs(sent - counts.astype(np.float64)) <= most).all(axis=1)
    return same


def _truth(served: Served) -> Callable[[str], Sent]:
    if served.truth is None:
        pytest.skip("the simulated device does not tell what it sent: Served(truth=…)")
    return served.truth


class CuttingClock:
    """A host clock that cuts the line at an arrival: after a read, before anything is sent."""

    def __init__(self, clock: SystemClock, cut: Callable[[], object]) -> None:
        self._clock = clock
        self._cut = cut
        self._is_armed = False

    @property
    def speed(self) -> float:
        """Speed of the clock."""
        return self._clock.speed

    @property
    def suspended(self) -> float:
        """Return the time of suspension in s."""
        return self._clock.suspended

    def arm(self) -> None:
        """Cut at the next reading of the clock."""
        self._is_armed = True

    def now(self) -> HostTime:
        """Cut if armed, and return the time."""
        if self._is_armed:
            self._is_armed = False
            self._cut()
        return self._clock.now()

    def utc_ns(self) -> int:
        """Return UTC in ns."""
        return self._clock.utc_ns()


@contextlib.asynccontextmanager
async def watching_the_loop() -> AsyncIterator[list[float]]:
    """Yield a list that collects how long the event loop was blocked, in s.

    A busy computer holds up every thread; only what holds up this one counts.
    """
    blocked: list[float] = []
    beats: list[float] = []
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(TICK):
            beats.append(time.monotonic())

    async def look() -> None:
        before, waited = time.monotonic(), _waited()
        while True:
            await asyncio.sleep(TICK)
            now, waited_before, waited = time.monotonic(), waited, _waited()
            running = np.diff([before, *(b for b in beats if before < b < now), now])
            held_up = max(running[running > 2 * TICK].sum(), waited - waited_before)
            if now - before - held_up > MAX_BLOCKED:
                blocked.append(now - before)
            beats.clear()
            before = time.monotonic()

    thread = threading.Thread(target=beat, name="beats beside the event loop")
    thread.start()
    looking = asyncio.create_task(look())
    try:
        yield blocked
    finally:
        looking.cancel()
        ended.set()
        thread.join()
        await asyncio.gather(looking, return_exceptions=True)


def _waited() -> float:
    """Return for how long this thread could run and had no processor, in s; 0 where unknown."""
    try:
        with open("/proc/thread-self/schedstat", encoding="ascii") as file:  # noqa: PTH123 - often
            return int(file.read().split()[1]) * 1e-9
    except (OSError, ValueError, IndexError):  # not Linux
        return 0.0


def _run(coroutine: Coroutine[object, object, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(LIMIT):
            await coroutine

    asyncio.run(limited())


def _at(sensors: Sequence[Sensor], number: int) -> list[Sensor]:
    """Return sensors on another TCP port of this computer."""
    scheme, found, _ = sensors[0].port.partition("://")
    if scheme == "udp":
        pytest.skip("nobody can be a stranger on a UDP port")
    port = f"{scheme if found else 'socket'}://127.0.0.1:{number}"
    return [sensor.model_copy(update={"port": port}) for sensor in sensors]


@contextlib.asynccontextmanager
async def stranger(garbage: bytes) -> AsyncIterator[int]:
    """Serve something that says the same to whatever comes."""
    tasks: set[asyncio.Task[None]] = set()

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is not None:
            tasks.add(task)
        with contextlib.suppress(ConnectionError):
            writer.write(garbage)
            while await reader.read(4096):
                writer.write(garbage)
        writer.transport.abort()

    async with await asyncio.start_server(talk, "127.0.0.1", 0) as server:
        yield server.sockets[0].getsockname()[1]
    await asyncio.gather(*tasks)


class _Proxy:
    """Stands between driver and device, and holds what passes for a while."""

    def __init__(self, host: str, number: int) -> None:
        self._where = host, number
        self._open = asyncio.Event()
        self._open.set()
        self._tasks: set[asyncio.Task[None]] = set()
        self.port = ""

    async def __aenter__(self) -> _Proxy:
        self._server = await asyncio.start_server(self._connected, "127.0.0.1", 0)
        self.port = f"{SOCKET}127.0.0.1:{self._server.sockets[0].getsockname()[1]}"
        return self

    async def __aexit__(self, *_: object) -> None:
        self._open.set()
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def pause(self) -> None:
        """Hold everything for ``PAUSE`` seconds."""
        self._open.clear()
        asyncio.get_running_loop().call_later(PAUSE, self._open.set)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        device_reader, device_writer = await asyncio.open_connection(*self._where)
        for source, sink in ((reader, device_writer), (device_reader, writer)):
            task = asyncio.create_task(self._pass_on(source, sink))
            self._tasks.add(task)

    async def _pass_on(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        try:
            while received := await source.read(4096):
                await self._open.wait()
                sink.write(received)
        except ConnectionError:
            pass
        finally:
            sink.close()
