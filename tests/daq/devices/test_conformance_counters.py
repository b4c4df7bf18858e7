"""The conformance suite tells a time that is rounded from a counter that is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from daq.conformance.suite import check_counters
from daq.protocols.block import Block, HostTime
from tests.sensors import sensor_at

RATE = 100.0
SENSOR = sensor_at("socket://localhost:1", "text", "one", rate=RATE, channels="x")
FIRST = np.concatenate([[0], np.cumsum(np.resize([1, 3, 2, 7], 60))])
"""Index of the first sample of each block: blocks of one to seven samples."""


def blocks(counters: np.ndarray) -> list[Block]:
    lengths = np.append(np.diff(FIRST), 1)
    return [
        Block("one", int(first), np.zeros((n, 1)), HostTime(0, 0), int(counter))
        for first, n, counter in zip(FIRST, lengths, counters, strict=True)
    ]


@pytest.mark.parametrize("phase_us", range(0, 1000, 125))
@pytest.mark.parametrize("ppm", [-30, 0, 30])
def test_a_time_of_whole_milliseconds_is_even(phase_us: int, ppm: int) -> None:
    """Two blocks of one sample are 10 ms apart, stated as 9, 10 or 11 ms."""
    shaken = np.random.default_rng(phase_us).uniform(-1e5, 1e5, len(FIRST))
    instants = FIRST * 1e9 / RATE * (1 + ppm * 1e-6) + phase_us * 1e3 + shaken
    check_counters([SENSOR], blocks(np.round(instants / 1e6) * 1_000_000))


def test_a_time_that_wanders_is_uneven() -> None:
    instants = FIRST * 1e9 / RATE
    instants[len(instants) // 2 :] += 30e6
    with pytest.raises(AssertionError, match="uneven"):
        check_counters([SENSOR], blocks(instants))


def test_a_counter_of_samples_is_exact() -> None:
    check_counters([SENSOR], blocks(FIRST + 7))
    wrong = FIRST + (np.arange(len(FIRST)) > 9)
    with pytest.raises(AssertionError, match="uneven"):
        check_counters([SENSOR], blocks(wrong))


def test_a_counter_of_blocks_is_none_of_samples() -> None:
    with pytest.raises(AssertionError, match="uneven"):
        check_counters([SENSOR], blocks(np.arange(len(FIRST))))


def test_a_constant_counter_does_not_grow() -> None:
    with pytest.raises(AssertionError, match="does not grow"):
        check_counters([SENSOR], blocks(np.zeros(len(FIRST))))
