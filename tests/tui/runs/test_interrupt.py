"""Ctrl-C while a result is being made."""

from __future__ import annotations

import signal

import pytest

from tui.runs.interrupt import defer_interrupt


def test_the_first_ctrl_c_waits_for_the_result_and_the_second_does_not() -> None:
    before = signal.getsignal(signal.SIGINT)
    with defer_interrupt() as interruption:
        before_it = interruption.pressed
        signal.raise_signal(signal.SIGINT)
        assert (before_it, interruption.pressed) == (False, True)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_one_that_was_pressed_before_counts() -> None:
    with defer_interrupt(spent=True) as interruption:
        assert interruption.pressed
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
