"""Whether the clock that says how old recordings are can be believed."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from daq.recorder.clock_trust import REMOVAL_DELAY, ClockTrust

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
