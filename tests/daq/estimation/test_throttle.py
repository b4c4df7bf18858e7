"""Repeated work takes its share of the time at most."""

from __future__ import annotations

import pytest

from daq.estimation.throttle import Throttle


def test_work_that_takes_long_makes_the_next_wait() -> None:
    at = 100.0
    throttle = Throttle(0.1, now=lambda: at)
    assert throttle.is_due  # the first
    taken, times = 0.0, 0
    for second in range(1000):
        at = 100.0 + second
        if throttle.is_due:
            assert throttle.remaining == 0
            with throttle:
                at += 2.5
            assert throttle.remaining == 22.5
            taken, times = taken + 2.5, times + 1
    assert times == 40  # once in 25 s
    assert taken <= 0.1 * 1000


def test_quick_work_is_done_every_time() -> None:
    at = 0.0
    throttle = Throttle(0.1, now=lambda: at)
    for second in range(0, 100, 5):
        at = float(second)
        assert throttle.is_due
        with throttle:
            at += 0.4


def test_work_that_is_limited_elsewhere_delays_nothing() -> None:
    at = 0.0
    throttle = Throttle(0.1, now=lambda: at)
    with throttle:
        at += 1.3
        throttle.deduct(0.9)
    assert throttle.cost == 1.3 - 0.9
    at = 4.01
    assert throttle.is_due
    with throttle:
        at += 1.3
    assert throttle.cost == pytest.approx(1.3)  # deducted once


def test_what_is_due_after_a_time_waits_no_longer() -> None:
    at = 0.0
    throttle = Throttle(0.1, longest=2.0, now=lambda: at)
    with throttle:
        at += 5.0
    assert throttle.remaining == 2.0
