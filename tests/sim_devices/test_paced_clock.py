"""The clock of a simulated bench: when it runs, and for whom it waits."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from daq.host_clock import SystemClock
from daq.recorder.clock_trust import ClockWatch
from sim_devices.server.paced_clock import LONGEST, NS, PacedClock, PacedLoop

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="locks of files")

MS = 1_000_000


class System:
    """The system's clock, moved by the test."""

    def __init__(self) -> None:
        self.ns = time.monotonic_ns()
        self.is_interrupted = True

    def __call__(self) -> int:
        """Return the time."""
        return self.ns


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return the file of a clock that runs as fast as the system's."""
    PacedClock.create(tmp_path / "clock").close()
    return tmp_path / "clock"


@pytest.fixture
def system() -> System:
    return System()


@pytest.fixture
def clock(file: Path, system: System) -> Iterator[PacedClock]:
    clock = PacedClock(file, system_ns=system)
    yield clock
    clock.close()


def test_without_participants_the_clock_is_the_systems(clock: PacedClock, system: System) -> None:
    assert clock.now_ns() == system.ns
    system.ns += NS
    assert clock.now_ns() == system.ns
    assert clock.left_out == 0


def test_the_clock_stops_while_a_participant_is_behind(clock: PacedClock, system: System) -> None:
    began = clock.now_ns()
    with clock.participate() as first, clock.participate() as second:
        first.let_run_until(began + 50 * MS)
        second.let_run_until(began + 70 * MS)
        system.ns += 5 * MS
        assert clock.now_ns() == began + 5 * MS
        system.ns += NS
        assert clock.now_ns() == began + 50 * MS
        first.let_run_until(began + 80 * MS)
        assert clock.now_ns() == began + 50 * MS, "what was left out does not come back"
        system.ns += 15 * MS
        assert clock.now_ns() == began + 65 * MS
        system.ns += NS
        assert clock.now_ns() == began + 70 * MS
    system.ns += NS
    assert clock.now_ns() == began + 70 * MS + NS
    assert clock.left_out == pytest.approx(2.0 - 0.05)


def test_a_computer_that_waits_for_its_simulators_has_not_set_its_clock(
    clock: PacedClock, system: System
) -> None:
    host = SystemClock(monotonic_ns=clock.now_ns, always_ns=clock.now_ns, utc_ns=clock.utc_ns)
    watch = ClockWatch(host)
    assert watch.look() is not None  # the state at the start
    with clock.participate() as behind:
        behind.let_run_until(clock.now_ns())
        system.ns += 5 * NS
        assert watch.look() is None


def test_the_clock_never_decreases(clock: PacedClock, system: System) -> None:
    began = clock.now_ns()
    with clock.participate() as participant:
        participant.let_run_until(began + 60 * MS)
        system.ns += 50 * MS
        assert clock.now_ns() == began + 50 * MS
        participant.let_run_until(began + 20 * MS)
        assert clock.now_ns() == began + 50 * MS


@pytest.mark.parametrize("is_held", [False, True])
def test_the_clock_never_decreases_for_an_interrupted_reader(
    clock: PacedClock, file: Path, system: System, is_held: bool
) -> None:
    """Between any two steps another process may find that the clock is held, and run for long."""
    other = PacedClock(file, system_ns=system)

    def interrupted() -> int:
        looked = system.ns
        if not system.is_interrupted:
            system.is_interrupted = True
            system.ns += NS
            other.now_ns()
        return looked

    interrupting = PacedClock(file, system_ns=interrupted)
    with other.participate() as participant:
        participant.let_run_until(clock.now_ns() + 50 * MS)
        system.ns += NS if is_held else MS
        began = clock.now_ns()
        system.ns += MS
        system.is_interrupted = False
        assert interrupting.now_ns() >= began
        assert system.is_interrupted
        assert clock.now_ns() >= began
    other.close()
    interrupting.close()


def test_time_left_out_by_two_processes_is_left_out_once(
    clock: PacedClock, file: Path, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = PacedClock(file, system_ns=system)
    with other.participate() as participant:
        began = clock.now_ns()
        participant.let_run_until(began + 50 * MS)
        system.ns += NS
        table = vars(clock)["_table"]

        class Interrupting:
            """The table, for who is interrupted between reading and writing."""

            def __getitem__(self, place: int | slice) -> object:
                found = table[place]
                if isinstance(place, slice):  # who is waited for: the last that is read
                    other.now_ns()
                return found

            def __setitem__(self, place: int, value: int) -> None:
                table[place] = value

        with monkeypatch.context() as patch:
            patch.setattr(clock, "_table", Interrupting())
            assert clock.now_ns() == began + 50 * MS
        assert clock.now_ns() == began + 50 * MS
    other.close()


def test_all_processes_with_the_file_have_one_time(
    clock: PacedClock, file: Path, system: System
) -> None:
    other = PacedClock(file, system_ns=system)
    with other.participate() as participant:
        began = clock.now_ns()
        participant.let_run_until(began + 50 * MS)
        system.ns += NS
        assert clock.now_ns() == other.now_ns() == began + 50 * MS
    assert clock.utc_ns() == other.utc_ns()
    other.close()


def test_the_clock_may_have_another_rate(tmp_path: Path, system: System) -> None:
    PacedClock.create(tmp_path / "clock", rate=2.5).close()
    clock = PacedClock(tmp_path / "clock", system_ns=system)
    began = clock.now_ns()
    system.ns += NS
    assert clock.now_ns() - began == 2.5 * NS
    clock.close()


def test_the_clock_does_not_wait_for_a_participant_that_left(
    clock: PacedClock, system: System
) -> None:
    for _ in range(3):
        with clock.participate():
            system.ns += NS
    began = clock.now_ns()
    system.ns += NS
    assert clock.now_ns() == began + NS
    assert len(list(clock.path.parent.glob("clock.*[0-9]"))) == 1


def test_the_clock_does_not_wait_for_a_killed_participant(
    clock: PacedClock, system: System
) -> None:
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        with PacedClock(clock.path, system_ns=system).participate():
            os.write(writing, b"!")
            signal.pause()  # until it is killed
        os._exit(1)
    try:
        os.read(reading, 1)
        began = clock.now_ns()
        system.ns += NS
        behind = clock.now_ns()
        assert behind <= began + LONGEST
        system.ns += NS
        assert clock.now_ns() == behind
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(reading)
        os.close(writing)
    for _ in range(3):  # the one look finds that nobody is there, the next counts on
        system.ns += NS
        now = clock.now_ns()
    assert now >= behind + NS


def test_an_event_loop_uses_the_clock_and_stops_it(file: Path) -> None:
    clock = PacedClock(file)

    async def main() -> float:
        loop = asyncio.get_running_loop()
        began = clock.now_ns()
        with clock.participate() as other:
            other.let_run_until(began + 50 * MS)
            sleeping = asyncio.create_task(asyncio.sleep(0.1))
            while time.monotonic_ns() < began + 2 * LONGEST + 50 * MS:  # by the system's clock
                await loop.run_in_executor(None, os.getpid)  # I/O goes on
            assert not sleeping.done()
            assert clock.now_ns() == began + 50 * MS
        await sleeping
        assert loop.time() >= began / NS + 0.1
        before, system = clock.now_ns(), time.monotonic_ns()
        while time.monotonic_ns() < system + 2 * LONGEST:
            pass  # looks at nothing that comes
        return (clock.now_ns() - before) / NS

    with asyncio.Runner(loop_factory=lambda: PacedLoop(clock)) as runner:
        ran_on = runner.run(main())
    assert ran_on <= LONGEST / NS
    clock.close()
