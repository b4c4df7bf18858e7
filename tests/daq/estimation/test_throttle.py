"""Live estimates take a tenth of the time at most."""

from __future__ import annotations

from daq.estimation.throttle import MAX_CPU_SHARE, Throttle


def test_an_estimate_that_takes_long_makes_the_next_one_wait() -> None:
    at = 100.0
    spacing = Throttle(lambda: at)
    assert spacing.due  # the first
    taken, estimates = 0.0, 0
    for second in range(1000):
        at = 100.0 + second
        if spacing.due:
            with spacing:
                at += 2.5
            taken, estimates = taken + 2.5, estimates + 1
    assert estimates == 40  # one in 25 s
    assert taken <= MAX_CPU_SHARE * 1000


def test_quick_estimates_come_with_every_segment() -> None:
    at = 0.0
    spacing = Throttle(lambda: at)
    for second in range(0, 100, 5):
        at = float(second)
        assert spacing.due
        with spacing:
            at += 0.4
