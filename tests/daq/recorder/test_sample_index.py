"""Where blocks stand in a recording, whatever sessions, resets and repetitions lie between."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.protocols.block import Block, BlockFlag, HostTime
from daq.recorder.sample_index import Gap, SampleIndexer

RATE = 100.0


def at(seconds: float) -> HostTime:
    return HostTime(round(seconds * 1e9), round(seconds * 1e9))


def block(
    first: int,
    n: int,
    seconds: float,
    *,
    flags: BlockFlag = BlockFlag.NONE,
    counter: int | None = None,
    reason: str = "",
) -> Block:
    counts = np.arange(first, first + n, dtype=np.int32)[:, None]
    return Block("a", first, counts, at(seconds), counter, flags, reason)


def placed_by(continuity: SampleIndexer, sent: Block) -> tuple[Block, Gap | None]:
    """Place a block that is recorded; return it, and the gap before it."""
    placed = continuity.place(sent)
    assert placed.block is not None
    return placed.block, placed.gap


def test_within_a_session_a_jump_is_a_gap_of_that_length() -> None:
    continuity = SampleIndexer(RATE)
    assert continuity.place(block(0, 10, 0.1)).gap is None
    placed, gap = placed_by(continuity, block(15, 10, 0.25, reason="checksum"))
    assert gap == Gap(10, 5, "checksum", estimated=False)
    assert placed.first_sample == 15
    assert continuity.next_sample == 25


def test_an_estimate_of_the_protocol_remains_an_estimate() -> None:
    continuity = SampleIndexer(RATE)
    continuity.place(block(0, 10, 0.1))
    placed = continuity.place(block(15, 10, 0.25, flags=BlockFlag.MISSING_ESTIMATED))
    assert placed.gap == Gap(10, 5, "lost", estimated=True)


def test_samples_lost_before_the_first_are_a_gap() -> None:
    placed = SampleIndexer(RATE).place(block(3, 10, 0.1))
    assert placed.gap == Gap(0, 3, "lost", estimated=False)


def test_a_new_session_is_placed_by_host_time() -> None:
    continuity = SampleIndexer(RATE)
    continuity.place(block(0, 10, 0.1))
    continuity.new_session("disconnected")
    # Its last sample came 5.2 s after the last one before: 520 samples on, 10 of them here.
    placed, gap = placed_by(continuity, block(0, 10, 5.3))
    assert gap == Gap(10, 510, "disconnected", estimated=True)
    assert placed.first_sample == 520
    assert placed.flags == BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
    follows, gap = placed_by(continuity, block(10, 10, 5.4))
    assert (gap, follows.first_sample) == (None, 530)


def test_that_nothing_is_missing_before_a_new_session_is_an_estimate() -> None:
    continuity = SampleIndexer(RATE)
    continuity.place(block(0, 10, 0.1))
    continuity.new_session("disconnected")
    placed, gap = placed_by(continuity, block(0, 10, 0.2))
    assert (gap, placed.first_sample) == (None, 10)
    assert BlockFlag.MISSING_ESTIMATED in placed.flags


def test_a_resumed_session_continues_the_index_of_the_last() -> None:
    continuity = SampleIndexer(RATE)
    continuity.place(block(0, 10, 0.1))
    continuity.new_session("refused")
    continuity.place(block(0, 10, 1.1))
    continuity.resume("disconnected")
    placed, gap = placed_by(continuity, block(510, 10, 99.0))
    assert gap == Gap(110, 500, "disconnected", estimated=False)
    assert not placed.flags
    _, gap = placed_by(continuity, block(530, 10, 99.2))
    assert gap == Gap(620, 10, "lost", estimated=False)


def test_device_time_makes_the_gap_exact() -> None:
    continuity = SampleIndexer(RATE)
    utc = BlockFlag.DEVICE_UTC
    continuity.place(block(0, 10, 0.1, flags=utc, counter=10**18))
    continuity.new_session("stalled")
    # 3.00 s later by the device; the host saw it late.
    placed = continuity.place(block(0, 10, 4.7, flags=utc, counter=10**18 + 3 * 10**9))
    assert placed.gap == Gap(10, 290, "stalled", estimated=False)


def test_samples_sent_again_after_a_break_are_recorded_once() -> None:
    continuity = SampleIndexer(RATE)
    utc = BlockFlag.DEVICE_UTC
    continuity.place(block(0, 200, 2.0, flags=utc, counter=10**18))
    continuity.new_session("disconnected")
    again = continuity.place(block(0, 100, 5.0, flags=utc, counter=10**18 + 10**9))
    assert (again.block, again.gap, again.repeated) == (None, None, 100)
    sent = block(100, 150, 5.1, flags=utc, counter=10**18 + 2 * 10**9)
    follows, gap = placed_by(continuity, sent)
    assert (gap, follows.first_sample) == (None, 200)


@pytest.mark.parametrize("date", [0, 3 * 10**18])
def test_a_device_that_returns_with_another_date_is_placed_by_host_time(date: int) -> None:
    continuity = SampleIndexer(RATE)
    utc = BlockFlag.DEVICE_UTC
    continuity.place(block(0, 10, 0.1, flags=utc, counter=10**18))
    continuity.new_session("disconnected")
    placed = continuity.place(block(0, 10, 5.3, flags=utc, counter=date))
    assert placed.gap == Gap(10, 510, "disconnected", estimated=True)


def test_a_reset_within_a_session_is_placed_by_host_time() -> None:
    continuity = SampleIndexer(RATE)
    continuity.place(block(0, 100, 1.0))
    placed = continuity.place(block(0, 10, 3.1, flags=BlockFlag.CLOCK_RESTART, reason="reset"))
    assert placed.gap == Gap(100, 200, "reset", estimated=True)


def test_a_session_that_was_lost_without_a_sample_changes_nothing() -> None:
    continuity = SampleIndexer(RATE)
    continuity.new_session("disconnected")
    placed, gap = placed_by(continuity, block(0, 10, 9.0))
    assert (gap, placed.first_sample) == (None, 0)


def test_samples_missing_at_the_end_are_a_gap() -> None:
    continuity = SampleIndexer(RATE)
    assert continuity.lost_until(at(5.0)) is None
    continuity.place(block(0, 10, 0.1))
    assert continuity.lost_until(at(2.1)) == Gap(10, 200, "lost at the end", estimated=True)
    assert continuity.lost_until(at(0.1)) is None


@given(st.lists(st.tuples(st.integers(0, 200), st.integers(1, 30)), max_size=30))
def test_no_sample_is_recorded_twice_and_none_is_lost(pieces: list[tuple[int, int]]) -> None:
    """Blocks late, repeated and overlapping in any way."""
    continuity = SampleIndexer(RATE)
    recorded: list[int] = []
    highest = 0
    for first, n in pieces:
        before = highest
        placed = continuity.place(block(first, n, 0.0))
        highest = max(highest, first + n)
        if placed.block is not None:
            assert placed.block.first_sample == max(before, first)
            recorded += placed.block.counts[:, 0].tolist()
        if placed.gap is not None:
            assert (placed.gap.first_sample, placed.gap.missing) == (before, first - before)
        assert continuity.next_sample == highest
    assert recorded == sorted(set(recorded))
