"""What a recording says of the computer's clock, and whether the clock can be believed."""

from __future__ import annotations

import ctypes
import sys
from datetime import UTC, datetime, timedelta

import pytest

from daq.host_clock import SystemClock
from daq.protocols.block import Event, EventKind
from daq.recorder.clock_trust import REMOVAL_DELAY, ClockTrust, ClockWatch, KernelClock, clock_state

UTC_NS = 1_790_000_000_000_000_000
GOOD = KernelClock(synchronised=True, offset=-0.0003, error=0.002, max_error=0.04)


class Computer:
    """A computer whose clocks a test sets."""

    def __init__(self, *, speed: float = 1.0) -> None:
        self.monotonic_ns, self.utc_ns = 5_000_000_000, UTC_NS
        self.state: KernelClock | None = GOOD
        clock = SystemClock(
            speed,
            monotonic_ns=lambda: self.monotonic_ns,
            always_ns=lambda: self.monotonic_ns,
            utc_ns=lambda: self.utc_ns,
        )
        self.watch = ClockWatch(clock, state=lambda: self.state)

    def after(self, seconds: float, *, step: float = 0.0) -> Event | None:
        """Return what is reported after some seconds, in which the clock was set."""
        self.monotonic_ns += round(seconds * 1e9)
        self.utc_ns += round((seconds + step) * 1e9)
        return self.watch.look()


def test_the_state_is_reported_at_the_start_and_every_hour() -> None:
    computer = Computer()
    first = computer.after(0)
    assert first is not None
    assert (first.sensor, first.kind) == ("", EventKind.CLOCK)
    assert first.text == (
        "synchronised: offset -0.300 ms, estimated error 2.000 ms, at most 40 ms (adjtimex)"
    )
    assert [computer.after(900) for _ in range(3)] == [None] * 3
    computer.state = KernelClock(synchronised=False, offset=0.0, error=0.0, max_error=16.0)
    later = computer.after(900)
    assert later is not None
    assert later.text == "unverified: not synchronised (adjtimex)"
    computer.state = None
    unknown = computer.after(3600)
    assert unknown is not None
    assert unknown.text.startswith("state unknown")


@pytest.mark.parametrize("step", [0.11, -3.5, 259_200.0])
def test_a_step_is_reported_at_once_and_times_do_not_follow(step: float) -> None:
    computer = Computer()
    computer.after(0)
    assert computer.after(2, step=0.05) is None  # slewed, or too small to matter alone
    event = computer.after(2, step=step - 0.05)
    assert event is not None
    assert event.text.startswith(f"moved by {step:+.3f} s; the times of this recording do")
    assert event.received.utc_ns == UTC_NS + 4_000_000_000
    assert computer.after(2) is None


def test_a_step_before_the_first_look_is_reported() -> None:
    event = Computer().after(2, step=-3600.0)
    assert event is not None
    assert event.text.startswith("moved by -3600.000 s")


def test_a_simulated_bench_that_is_fast_has_no_steps() -> None:
    computer = Computer(speed=8.0)
    computer.after(0)
    assert computer.after(2) is None


@pytest.mark.skipif(sys.platform != "linux", reason="reads the kernel's clock")
def test_the_state_is_that_of_the_kernel() -> None:
    state = clock_state()
    assert state is not None
    reply = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(1024))
    assert state.synchronised == (reply != 5)
    assert 0 <= state.error <= 3600
    assert abs(state.offset) < 1


# --- a clock that says how old recordings are ------------------------------------------------


START = datetime(2026, 11, 21, 12, 0, 30, tzinfo=UTC)


class Clocks:
    """The system's clock, and one that is never set."""

    def __init__(self, now: datetime) -> None:
        self.now, self.monotonic = now, 100.0

    def pass_time(self, duration: timedelta) -> None:
        """Let both go on."""
        self.now += duration
        self.monotonic += duration.total_seconds()


def test_a_clock_before_the_release_is_not_plausible() -> None:
    clocks = Clocks(datetime(1970, 1, 1, tzinfo=UTC))
    trust = ClockTrust(lambda: clocks.now, lambda: clocks.monotonic)
    assert "shows 1970-01-01, before this software was released" in trust.doubt()


@pytest.mark.parametrize("jump", [timedelta(days=3650), timedelta(hours=-2)])
def test_a_clock_is_not_plausible_for_a_day_after_a_jump(jump: timedelta) -> None:
    clocks = Clocks(START)
    trust = ClockTrust(lambda: clocks.now, lambda: clocks.monotonic)
    clocks.pass_time(timedelta(days=40))
    assert trust.doubt() == ""
    clocks.now += jump
    clocks.pass_time(timedelta(minutes=5))
    assert "was set by more than 1 h" in trust.doubt()
    clocks.pass_time(REMOVAL_DELAY / 2)
    assert trust.doubt() != ""
    clocks.pass_time(REMOVAL_DELAY)
    assert trust.doubt() == ""
