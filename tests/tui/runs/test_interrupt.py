"""Ctrl-C during a run."""

from __future__ import annotations

import signal

import pytest

from tui.runs.recorder_process import defer_interrupt


def test_the_first_ctrl_c_stops_the_recorder_and_the_second_raises() -> None:
    before = signal.getsignal(signal.SIGINT)
    stops = []
    with defer_interrupt(lambda: stops.append("stop")) as interruption:
        before_it = interruption.pressed
        signal.raise_signal(signal.SIGINT)
        assert (before_it, interruption.pressed, stops) == (False, True, ["stop"])
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
    assert stops == ["stop"]
