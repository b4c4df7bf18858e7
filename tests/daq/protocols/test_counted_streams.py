"""Counters of devices whose clocks are off, and frames in a stream that holds other bytes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.devices.epson.burst import find_frames
from daq.protocols.block import HostTime
from daq.protocols.sample_counter import SampleCounter

RATE = 100.0


def frames(
    ppm: float, seconds: float, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the numbers of frames as sent, some twice and some lost, and when each was taken."""
    n = round(seconds * RATE * (1 + ppm * 1e-6))
    times = rng.permutation(np.arange(500, n - 500, 250))[:40]
    copies = np.ones(n, np.int64)
    copies[times[:20]] = 2  # repeated frames
    copies[times[20:]] = 0  # lost frames
    sent = np.repeat(np.arange(n), copies)
    return sent, sent / (RATE * (1 + ppm * 1e-6))


def reads(taken: NDArray[np.float64], rng: np.random.Generator) -> list[tuple[int, int, float]]:
    """Return the frames of each read and its time: a busy host, with stalls that it makes up."""
    now, found, first = 0.0, [], 0
    while first < len(taken):
        stall = rng.uniform(0.2, 5.0) if rng.random() < 0.005 else 0.0
        now += 0.05 + rng.exponential(0.02) + stall
        end = int(np.searchsorted(taken, now))
        if end > first:
            found.append((first, end, now))
            first = end
    return found


@pytest.mark.parametrize(("modulus", "ppm"), [(256, -10_000), (256, 900), (65_536, -10_000)])
def test_every_frame_of_a_counter_off_its_rate_has_its_index(modulus: int, ppm: float) -> None:
    rng = np.random.default_rng(round(abs(ppm)) + modulus)
    sent, taken = frames(ppm, 1500, rng)
    counter = SampleCounter(modulus, RATE)
    n_repeated, found, restarts = 0, [], 0
    for first, end, now in reads(taken, rng):
        at = HostTime(round((now + 1e4) * 1e9), 0)
        runs, again = counter.place(sent[first:end] % modulus, at)
        n_repeated += again
        restarts += sum(run.restarted for run in runs)
        for run in runs:
            index = np.arange(run.first_sample, run.first_sample + run.stop - run.start)
            found.append(np.column_stack([index, sent[first:end][run.start : run.stop]]))
    placed = np.concatenate(found)
    assert restarts == 0
    assert n_repeated == 20
    assert np.array_equal(placed[:, 0], placed[:, 1])
    assert len(placed) == len(np.unique(sent))


@pytest.mark.parametrize("ppm", [-900, 900])
def test_a_counter_off_its_rate_restarts_after_the_time_that_passed(ppm: float) -> None:
    counter, true_rate = SampleCounter(65_536, RATE), RATE * (1 + ppm * 1e-6)
    for block in range(2000):
        at = HostTime(round((block * 50 + 49) / true_rate * 1e9), 0)
        counter.place(np.arange(block * 50, block * 50 + 50) % 65_536, at)
    at = HostTime(round((100_000 / true_rate + 7.49) * 1e9), 0)
    (run,), _ = counter.place(np.arange(50), at)
    assert run.restarted
    assert run.missing == pytest.approx(7.49 * true_rate - 49, abs=10)


# --- frames ----------------------------------------------------------------------------------


SIZE = 6


def valid(windows: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which windows begin with 1 and end with 2."""
    good: NDArray[np.bool_] = (windows[:, 0] == 1) & (windows[:, -1] == 2)
    return good


def scanned(stream: bytes) -> tuple[list[int], int]:
    """Return where frames begin, and the number of bytes decided: one byte after the other."""
    found, at = [], 0
    while at + SIZE <= len(stream):
        good = stream[at] == 1 and stream[at + SIZE - 1] == 2
        if good:
            found.append(at)
        at += SIZE if good else 1
    return found, at


def test_long_garbage_gives_the_frames_of_a_scan() -> None:
    random = np.random.default_rng(3)
    stream = random.integers(0, 4, 200_000, np.uint8).tobytes()

    runs, consumed = find_frames(np.frombuffer(stream, np.uint8), SIZE, valid)

    begins = [start + number * SIZE for start, count in runs for number in range(count)]
    assert (begins, consumed) == scanned(stream)
    assert len(begins) > 5000


def test_search_of_garbage_looks_at_few_windows_at_a_time() -> None:
    most = 0

    def none(windows: NDArray[np.uint8]) -> NDArray[np.bool_]:
        nonlocal most
        most = max(most, windows.size)
        return np.zeros(len(windows), dtype=np.bool_)

    garbage = np.zeros(1_000_000, np.uint8)

    runs, consumed = find_frames(garbage, SIZE, none)

    assert (runs, consumed) == ([], len(garbage) - SIZE + 1)
    assert most <= len(garbage)  # all windows have SIZE times as many bytes
