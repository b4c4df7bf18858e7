"""Clocks of digitizers that are set: every sample that arrived is recorded once, none is invented.

The digitizer is `tests.peers.digitizer`, which shares no code with the drivers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.devices.guralp.decoders import ScreamDecoder
from daq.devices.seedlink.decoder import SeedLinkDecoder, StreamSelection
from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime
from daq.recorder.sample_index import SampleIndexer
from tests.daq.devices.found import blocks_of, events_of
from tests.peers.digitizer import CODES, START, Digitizer, Sent, scream, seedlink

STREAMS = ("DEMOZ2", "DEMON2", "DEMOE2")


def arrival(sent: Sent) -> HostTime:
    utc = round(START.timestamp() * 1e9) + round(sent.arrival * 1e9)
    return HostTime(5_000_000_000_000 + round(sent.arrival * 1e9), utc)


def by_seedlink(
    digitizer: Digitizer, *, numbers: Callable[[int], int] = lambda n: n, hold: float = 10.0
) -> list[Any]:
    chosen = StreamSelection("XX", "STA", tuple(("*", code) for code in CODES), 3)
    decoder = SeedLinkDecoder({"A": chosen}, {"A": np.dtype(np.int32)}, hold=hold)
    found: list[Any] = []
    for sent in digitizer.records():
        found += decoder.receive(seedlink(sent, 100, numbers(sent.number)), arrival(sent))
    return found


def by_scream(digitizer: Digitizer) -> list[Any]:
    decoder = ScreamDecoder({"A": STREAMS})
    found: list[Any] = []
    for sent in digitizer.records():
        found += decoder.receive_datagram(scream(sent, 100, sent.number), arrival(sent))
    return found


def recorded(
    found: list[Any],
) -> tuple[NDArray[np.int64], NDArray[np.int32], list[Block], list[Event]]:
    """Return the indices and rows that the recorder writes, the blocks, and the events."""
    indexer = SampleIndexer(100.0)
    blocks = blocks_of(found)
    index, rows = [], []
    for block in blocks:
        placed = indexer.place(block).block
        assert placed is not None
        assert placed.n_samples == block.n_samples
        index.append(np.arange(placed.first_sample, placed.end_sample))
        rows.append(placed.counts)
    events = events_of(found)
    return np.concatenate(index), np.concatenate(rows), blocks, events


def true_index(rows: NDArray[np.int32], digitizer: Digitizer) -> NDArray[np.int64]:
    """Return the true index of each recorded row, by its values."""
    known = {row.tobytes(): n for n, row in enumerate(digitizer.samples)}
    return np.array([known[row.tobytes()] for row in np.ascontiguousarray(rows)])


def check(
    found: list[Any], digitizer: Digitizer, *, exact: bool = True, missing: int = 0
) -> tuple[list[Block], list[Event]]:
    """See that every row is recorded once, with its index, or behind a gap that is an estimate."""
    index, rows, blocks, events = recorded(found)
    true = true_index(rows, digitizer)
    assert (np.diff(true) > 0).all()
    assert true[0] == index[0] == 0
    assert len(true) >= len(digitizer.samples) - missing - 3 * 120  # the last records are open
    if exact:
        assert np.array_equal(index, true)
    else:
        estimated = [b for b in blocks if BlockFlag.MISSING_ESTIMATED in b.flags]
        assert len(estimated) == 1
        before = index < estimated[0].first_sample
        assert np.array_equal(index[before], true[before])
    return blocks, events


@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize("size", [0.02, -0.02, 0.3, -1.0, 20.0, -3600.0])
def test_a_step_of_the_stated_time_keeps_every_row_of_seedlink(
    size: float, *, numbered: bool
) -> None:
    digitizer = Digitizer(seconds=120.0, steps=((77.33, size),), seed=round(abs(size) * 100))
    numbers = (lambda n: n) if numbered else (lambda n: 7 * n)
    undecided = not numbered and 0 < size < 0.3  # too small for the jitter of arrivals
    blocks, events = check(by_seedlink(digitizer, numbers=numbers), digitizer, exact=not undecided)
    if not undecided:
        assert [event.kind for event in events] == [EventKind.RESET]
        (restart,) = [b for b in blocks[1:] if BlockFlag.CLOCK_RESTART in b.flags]
        assert restart.first_sample == 7733
        stated = digitizer.stated(7733).timestamp() * 1e9
        assert restart.device_counter == pytest.approx(stated, abs=1e5)


@pytest.mark.parametrize("size", [1.0, -1.0, -20.0, 3600.0])
def test_a_step_of_the_stated_time_keeps_every_row_of_gcf(size: float) -> None:
    digitizer = Digitizer(seconds=120.0, steps=((77.0, size),), whole_seconds=True)
    blocks, events = check(by_scream(digitizer), digitizer)
    assert [event.kind for event in events] == [EventKind.RESET]
    (restart,) = [b for b in blocks[1:] if BlockFlag.CLOCK_RESTART in b.flags]
    assert restart.first_sample == 7700


@pytest.mark.parametrize("ppm", [-400.0, 400.0])
def test_an_oscillator_off_its_rate_loses_no_row_and_makes_no_gap(ppm: float) -> None:
    digitizer = Digitizer(seconds=700.0, ppm=ppm)
    blocks, events = check(by_seedlink(digitizer), digitizer)
    assert not events
    assert not any(b.flags & BlockFlag.CLOCK_RESTART for b in blocks[1:])
    stated = [digitizer.stated(b.first_sample).timestamp() * 1e9 for b in blocks]
    np.testing.assert_allclose([b.device_counter or 0 for b in blocks], stated, rtol=0, atol=1e6)


@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize(("begin", "end"), [(100.0, 101.3), (100.0, 108.0), (80.0, 180.0)])
def test_records_that_never_arrive_are_a_gap_of_their_length(
    begin: float, end: float, *, numbered: bool
) -> None:
    digitizer = Digitizer(lost=((begin, end),), ppm=50.0)
    numbers = (lambda n: n) if numbered else (lambda n: 7 * n)
    missing = round((end - begin + 2.4) * 100)
    found = by_seedlink(digitizer, numbers=numbers, hold=2.0)
    blocks, events = check(found, digitizer, missing=missing)
    assert not events
    assert not any(BlockFlag.CLOCK_RESTART in b.flags for b in blocks[1:])


@pytest.mark.parametrize("seed", range(2))
def test_a_busy_link_makes_no_gap_and_no_epoch(seed: int) -> None:
    """Delays of 0.5 s on average, and stalls of up to 20 s that are made up later."""
    rng = np.random.default_rng(seed)
    stalls = tuple(
        (t, t + d) for t, d in zip(range(20, 560, 45), rng.uniform(1, 20, 12), strict=True)
    )
    digitizer = Digitizer(seconds=600.0, jitter=0.5, stalls=stalls, seed=seed)
    blocks, events = check(by_seedlink(digitizer), digitizer)
    assert not events
    assert not any(
        b.flags & (BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED) for b in blocks[1:]
    )


def test_records_sent_again_are_recorded_once() -> None:
    """After a reconnection: 30 s of records in a burst, with the numbers that they had."""
    digitizer = Digitizer()
    chosen = StreamSelection("XX", "STA", tuple(("*", code) for code in CODES), 3)
    decoder = SeedLinkDecoder({"A": chosen}, {"A": np.dtype(np.int32)}, hold=10.0)
    found: list[Any] = []
    records = digitizer.records()
    for number, sent in enumerate(records):
        found += decoder.receive(seedlink(sent, 100, sent.number), arrival(sent))
        if number == 400:
            for again in records[310:401]:
                found += decoder.receive(seedlink(again, 100, again.number), arrival(sent))
    blocks, events = check(found, digitizer)
    assert not events
    assert not any(BlockFlag.CLOCK_RESTART in b.flags for b in blocks[1:])


def test_a_clock_may_be_set_several_times_while_records_are_lost() -> None:
    steps = ((50.0, 0.5), (90.0, -2.0), (130.0, 30.0), (180.0, -30.0))
    digitizer = Digitizer(steps=steps, lost=((110.0, 113.0), (150.0, 152.0)))
    blocks, events = check(by_seedlink(digitizer, hold=2.0), digitizer, missing=1000)
    assert [event.kind for event in events] == [EventKind.RESET] * 4
    restarts = [b.first_sample for b in blocks[1:] if BlockFlag.CLOCK_RESTART in b.flags]
    assert restarts == [5000, 9000, 13000, 18000]


@pytest.mark.parametrize("jitter", [0.04, 0.16, 0.64])
def test_lost_packets_are_gaps_however_unsteady_the_link(jitter: float) -> None:
    """The number of a lost packet is missed by the next one, which may be of another stream."""
    lost = tuple((30.3 + 20 * k, 31.5 + 20 * k) for k in range(12))
    digitizer = Digitizer(300.0, lost=lost, jitter=jitter, seed=3)
    index, rows, blocks, events = recorded(by_seedlink(digitizer))
    truth = true_index(rows, digitizer)  # raises where channels are not of one time
    assert not events
    assert np.ptp(index - truth) == 0
    assert np.count_nonzero(np.diff(truth) > 1) == len(lost)
    assert not any(BlockFlag.CLOCK_RESTART in b.flags for b in blocks[1:])
    n_estimated = sum(BlockFlag.MISSING_ESTIMATED in b.flags for b in blocks)
    assert (n_estimated == 0) == (jitter < 0.1)
