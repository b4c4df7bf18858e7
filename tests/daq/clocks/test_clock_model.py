"""Clocks from arrival times, against clocks that are known."""

from __future__ import annotations

import numpy as np
import pytest

from daq.clocks.arrival_times import ArrivalTimes
from daq.clocks.clock_model import (
    Clock,
    MeasuredDelays,
)
from daq.clocks.kalman import Observations, Smoothed, smooth
from daq.clocks.lower_envelope import supporting_line
from daq.clocks.slips import Step, lost_by_delays
from daq.clocks.usb_polling import Polls
from daq.protocols.block import BlockFlag
from daq.recording.file_format import BLOCK_DTYPE

RATE = 200.0
BLOCK = 20


def block_rows(arrivals: np.ndarray, flags: np.ndarray | None = None) -> np.ndarray:
    """Rows of blocks of 20 samples that arrived then (s)."""
    rows = np.zeros(len(arrivals), BLOCK_DTYPE)
    rows["first_sample"] = BLOCK * np.arange(len(arrivals))
    rows["n_samples"] = BLOCK
    rows["monotonic_ns"] = np.round(arrivals * 1e9)
    rows["device_counter"] = -1
    if flags is not None:
        rows["flags"] = flags
    return rows


def last_samples(n_blocks: int, ppm: float = 0.0) -> np.ndarray:
    """When the last sample of each block is taken."""
    return (BLOCK * np.arange(1, n_blocks + 1) - 1) / (RATE * (1 + ppm * 1e-6))


def solved(rows: np.ndarray, *, pieces: int = 1) -> Clock:
    arrivals = ArrivalTimes(RATE, 0, 0)
    for piece in np.array_split(rows, pieces):
        arrivals.add(piece)
    return arrivals.solve("a")


def test_the_supporting_line_is_the_highest_under_all_points() -> None:
    rng = np.random.default_rng(1)
    x = np.arange(5000.0)
    y = 3e-6 * x + 0.7 + rng.exponential(1e-3, 5000)
    intercept, slope = supporting_line(x, y)
    above = y - intercept - slope * x
    assert above.min() > -1e-12
    assert np.count_nonzero(above < 1e-9) == 2  # an edge of the hull
    assert slope == pytest.approx(3e-6, abs=5e-9)


@pytest.mark.parametrize("ppm", [0.0, 20.0, -20.0, 10_000.0])
def test_one_sided_latency_and_outliers_do_not_shift_the_clock(ppm: float) -> None:
    rng = np.random.default_rng(2)
    taken = last_samples(6000, ppm)  # ten minutes
    late = 4e-4 + rng.exponential(1e-3, 6000)
    late[rng.random(6000) < 0.05] += rng.exponential(0.3)  # a busy host
    late[2000:2200] += 0.08  # 20 s behind
    clock = solved(block_rows(np.maximum.accumulate(taken + late)))
    assert clock.state.n_epochs == 1
    assert clock.state.ppm == pytest.approx(ppm, abs=0.15)
    index = np.arange(1000.0, 119_000.0, 500.0)
    error = clock.at(index) - index / (RATE * (1 + ppm * 1e-6)) - 4e-4
    # The earliest of 100 blocks comes 10 µs after the shortest latency.
    assert np.abs(error).max() < 60e-6
    assert clock.state.residual < 30e-6
    assert np.allclose(clock.position(clock.at(index)), index, atol=1e-6)


def test_the_clock_does_not_depend_on_the_division_of_blocks() -> None:
    rng = np.random.default_rng(3)
    rows = block_rows(last_samples(3000, 15.0) + rng.exponential(1e-3, 3000))
    index = np.arange(0.0, 60_000.0, 100.0)
    difference = solved(rows).at(index) - solved(rows, pieces=17).at(index)
    assert np.abs(difference).max() < 1e-6


def test_a_wandering_and_stepping_rate_is_tracked() -> None:
    rng = np.random.default_rng(4)
    seconds = np.arange(0, 3600, BLOCK / RATE)
    rate = np.cumsum(0.2e-6 / 60 * np.sqrt(0.1) * rng.standard_normal(len(seconds)))
    rate += 2e-6 * (1 - np.exp(-np.maximum(seconds - 1800, 0) / 60))
    taken = last_samples(len(seconds)) - np.cumsum(rate) * 0.1
    clock = solved(block_rows(taken + rng.exponential(1e-3, len(seconds))))
    index = BLOCK * np.arange(1.0, len(seconds) + 1) - 1
    error = clock.at(index) - taken
    assert np.std(error) < 6e-6
    assert np.std(error) < 2 * clock.state.residual
    assert clock.state.wander_ppm == pytest.approx(np.std(rate) * 1e6, rel=0.1)


def test_restarts_begin_an_epoch_and_keep_the_rate() -> None:
    rng = np.random.default_rng(5)
    flags = np.zeros(6000, np.int32)
    flags[[0, 3000, 5950]] = BlockFlag.CLOCK_RESTART
    taken = last_samples(6000, 18.0)
    taken[3000:] += 0.00123
    taken[5950:] += 0.00200
    clock = solved(block_rows(taken + rng.exponential(2e-4, 6000), flags))
    assert [epoch.first_sample for epoch in clock.epochs] == [0, 60_000, 119_000]
    index = np.array([30_000.0, 90_000.0, 119_500.0])
    expected = (index / (RATE * (1 + 18e-6))) + [0, 0.00123, 0.00323]
    # The last one, 5 s long, has the rate of those before.
    assert np.abs(clock.at(index) - expected).max() < 20e-6


def test_a_late_first_block_does_not_fix_its_epoch() -> None:
    # Of the second epoch, that block alone lies before a multiple of ten seconds.
    rng = np.random.default_rng(5)
    flags = np.zeros(6000, np.int32)
    flags[[0, 2099]] = BlockFlag.CLOCK_RESTART
    taken = last_samples(6000, 18.0)
    arrivals = taken + rng.exponential(1e-3, 6000)
    arrivals[2099] += 20e-3
    clock = solved(block_rows(np.maximum.accumulate(arrivals), flags))
    error = clock.at(BLOCK * np.arange(1.0, 6001) - 1) - taken
    assert error[:2099].std() < 5e-6
    assert error[2099:].std() < 5e-6


@pytest.mark.parametrize("n_late", [1, 3, 10])
def test_a_few_blocks_seconds_late_do_not_affect_the_others(n_late: int) -> None:
    rng = np.random.default_rng(13)
    taken = last_samples(6000, 12.0)
    late = 4e-4 + rng.exponential(1e-3, 6000)
    usual = solved(block_rows(np.maximum.accumulate(taken + late))).state.residual
    late[rng.choice(6000, n_late, replace=False)] += rng.uniform(0.5, 3.0, n_late)
    clock = solved(block_rows(np.maximum.accumulate(taken + late)))
    error = clock.at(BLOCK * np.arange(1.0, 6001) - 1) - taken
    assert error.std() < 5e-6
    assert clock.state.residual < 1.5 * usual


def test_suspension_of_the_host_does_not_change_the_clock() -> None:
    rng = np.random.default_rng(6)
    taken = last_samples(6000, -12.0)
    arrivals = taken + rng.exponential(5e-4, 6000)
    arrivals[4000:] -= 37.0  # CLOCK_MONOTONIC stands still in suspend, the device's counter not
    clock = solved(block_rows(arrivals))
    assert [epoch.first_sample for epoch in clock.epochs] == [0, 80_000]
    assert clock.state.ppm == pytest.approx(-12.0, abs=0.02)
    error = clock.at(BLOCK * np.arange(1.0, 6001) - 1) - taken
    assert error[:4000].std() < 4e-6
    assert error[4000:].std() < 4e-6


@pytest.mark.parametrize("pieces", [1, 17])
def test_a_short_suspension_is_distinguished_from_a_minute_of_delay(pieces: int) -> None:
    rng = np.random.default_rng(6)
    arrivals = last_samples(12_000, -12.0) + rng.exponential(5e-4, 12_000)
    arrivals[4000:4600] = arrivals[4600]  # held up
    arrivals[10_000:] -= 5.0  # asleep
    clock = solved(block_rows(arrivals), pieces=pieces)
    assert [epoch.first_sample for epoch in clock.epochs] == [0, 200_000]


@pytest.mark.parametrize("pieces", [1, 17])
@pytest.mark.parametrize("restart", [0, 3000])
@pytest.mark.parametrize("n_late", [1, 50])
def test_late_blocks_at_the_start_are_no_sleep(n_late: int, restart: int, pieces: int) -> None:
    rng = np.random.default_rng(6)
    arrivals = last_samples(6000, -12.0) + rng.exponential(5e-4, 6000)
    arrivals[restart : restart + n_late] += 0.2
    flags = np.zeros(6000, int)
    flags[restart] = BlockFlag.CLOCK_RESTART
    clock = solved(block_rows(arrivals, flags), pieces=pieces)
    assert [epoch.first_sample for epoch in clock.epochs] == sorted({0, BLOCK * restart})
    assert clock.state.residual < 4e-6


def test_utc_stepped_by_ntp_or_a_leap_second_changes_nothing() -> None:
    rng = np.random.default_rng(7)
    rows = block_rows(last_samples(3000, 5.0) + rng.exponential(1e-3, 3000))
    stepped = rows.copy()
    stepped["utc_ns"][1500:] += 1_000_000_000
    index = np.arange(0.0, 60_000.0, 1000.0)
    assert np.array_equal(solved(rows).at(index), solved(stepped).at(index))


def test_device_utc_at_a_constant_rate_is_the_clock_exactly() -> None:
    rows = block_rows(np.zeros(600))
    rows["flags"] = BlockFlag.DEVICE_UTC
    rows["device_counter"] = np.round(0.0055e9 + rows["first_sample"] / RATE * 1e9)
    clock = solved(rows)
    assert clock.state.source == "device UTC"
    index = np.arange(0.0, 12_000.0, 7.0)
    assert np.abs(clock.at(index) - (0.0055 + index / RATE)).max() < 1e-9
    drifting = rows.copy()
    drifting["device_counter"] += np.round(1e-5 * rows["first_sample"] / RATE * 1e9).astype(int)
    clock = solved(drifting)
    assert clock.state.ppm == pytest.approx(-10.0, abs=0.01)
    assert np.abs(clock.at(index) - (0.0055 + index / RATE * (1 + 1e-5))).max() < 1e-8


@pytest.mark.parametrize("leap", [-1, 1])
@pytest.mark.parametrize("pieces", [1, 5])
def test_a_leap_second_of_device_utc_is_no_step_of_its_clock(leap: int, pieces: int) -> None:
    rows = block_rows(np.zeros(600))
    rows["flags"] = BlockFlag.DEVICE_UTC
    rows["device_counter"] = np.round(0.0055e9 + rows["first_sample"] / RATE * 1e9)
    rows["device_counter"][300:] += leap * 10**9
    clock = solved(rows, pieces=pieces)
    index = np.arange(0.0, 12_000.0, 7.0)
    assert clock.state.n_epochs == 1
    assert np.abs(clock.at(index) - (0.0055 + index / RATE)).max() < 1e-9


def test_delays_from_the_samples_outweigh_arrivals_up_to_their_constant() -> None:
    rng = np.random.default_rng(8)
    poll = 16e-3
    taken = last_samples(18_000, 15.0)
    arrivals = ArrivalTimes(RATE, 0, 0)
    arrivals.add(block_rows(np.ceil(taken / poll) * poll + rng.exponential(5e-5, len(taken))))
    index = np.arange(1000.0, 359_000.0, 1000.0)
    seconds = index / (RATE * (1 + 15e-6))
    measured = MeasuredDelays(
        index, seconds + 1e-6 * rng.standard_normal(len(index)), np.full(len(index), 1e-6)
    )
    alone = arrivals.solve("a").at(index) - seconds
    refined = arrivals.solve("a", measured)
    assert refined.state.refined
    error = refined.at(index) - seconds
    assert np.std(error) < 1e-6
    assert np.std(alone) > 1e-5
    assert abs(np.mean(error)) < 1e-6  # the constant is that of the samples
    assert refined.state.residual < 1e-6


@pytest.mark.parametrize(
    ("std", "hole", "sparse"),
    [(1e-6, (0.0, 0.0), True), (1e-3, (0.0, 0.0), False), (1e-6, (500.0, 900.0), False)],
)
def test_arrivals_are_as_sparse_as_delays_that_far_outweigh_them(
    monkeypatch: pytest.MonkeyPatch, std: float, hole: tuple[float, float], *, sparse: bool
) -> None:
    rng = np.random.default_rng(3)
    taken = last_samples(24_000, 15.0)
    arrivals = ArrivalTimes(RATE, 0, 0)
    arrivals.add(block_rows(taken + rng.exponential(1e-3, len(taken))))
    index = np.arange(2000.0, 478_000.0, 8000.0)
    index = index[(index / RATE < hole[0]) | (index / RATE > hole[1])]
    seconds = index / (RATE * (1 + 15e-6))
    late = std * rng.standard_normal(len(index))
    measured = MeasuredDelays(index, seconds + late, np.full(len(index), std))
    rows: list[int] = []

    def counted(observations: Observations, **options: float) -> Smoothed:
        rows.append(int((~observations.from_samples).sum()))
        return smooth(observations, **options)

    monkeypatch.setattr("daq.clocks.kalman.smooth", counted)
    clock = arrivals.solve("a", measured)
    assert (rows[0] < 70) == sparse  # of 240
    if std < 1e-5:
        assert np.std(clock.at(index) - seconds) < 1e-6
        assert clock.state.residual < 1e-6


def test_an_epoch_shorter_than_a_segment_does_not_spoil_the_others() -> None:
    rng = np.random.default_rng(8)
    flags = np.zeros(6000, int)
    flags[[3000, 3005]] = BlockFlag.CLOCK_RESTART
    arrivals = ArrivalTimes(RATE, 0, 0)
    taken = last_samples(6000, 15.0)
    arrivals.add(block_rows(np.ceil(taken / 16e-3) * 16e-3, flags))
    index = np.concatenate([np.arange(1000.0, 59_000, 1000), np.arange(61_000.0, 119_000, 1000)])
    seconds = index / (RATE * (1 + 15e-6))
    noise = 1e-6 * rng.standard_normal(len(index))
    clock = arrivals.solve("a", MeasuredDelays(index, seconds + noise, np.full(len(index), 1e-6)))
    assert [epoch.first_sample for epoch in clock.epochs] == [0, 60_000, 60_100]
    assert clock.state.refined
    assert clock.state.residual < 1e-6
    assert np.std(clock.at(index) - seconds) < 1e-6
    between = np.arange(60_000.0, 60_100)
    assert np.abs(clock.at(between) - between / (RATE * (1 + 15e-6))).max() < 20e-3


def test_the_smoother_states_its_own_error() -> None:
    rng = np.random.default_rng(9)
    n, spread = 400, []
    seconds = np.arange(0.0, 10.0 * n, 10.0)
    for _ in range(10):
        rate = np.cumsum(1e-8 * np.sqrt(10) * rng.standard_normal(n))
        truth = np.concatenate([[0.0], np.cumsum(10 * (rate[1:] + rate[:-1]) / 2)])
        found = smooth(
            Observations(
                seconds,
                np.asarray(truth + 1e-5 * rng.standard_normal(n), dtype=np.float64),
                np.zeros(n),
                np.zeros(n, dtype=bool),
                np.zeros(n, dtype=bool),
                np.ones(n, dtype=bool),
            )
        )
        spread.append(float(np.mean(((found.lateness - truth) / found.std) ** 2)))
    # Some 40 independent stretches a run: the mean of 400 squares is 1 ± 0.07; the grid's
    # half decades of walk and noise allow a third more or less.
    assert 0.6 < np.mean(spread) < 1.5


@pytest.mark.parametrize("block", [1, 5, 20, 200])
@pytest.mark.parametrize("ppm", [0.0, 15.0, -20.0])
def test_polling_is_detected_in_the_latencies(block: int, ppm: float) -> None:
    rng = np.random.default_rng(10)
    index = block * np.arange(1.0, 3001.0) - 1
    taken = index / (RATE * (1 + ppm * 1e-6)) + 0.0421

    def step(arrivals: np.ndarray, pieces: int) -> float:
        polls = Polls()
        for rows in np.array_split(np.arange(len(index)), pieces):
            polls.add(index[rows], arrivals[rows] - index[rows] / RATE)
        return polls.step(-ppm * 1e-6 / RATE)

    assert step(taken + rng.exponential(1e-3, 3000), 7) == 0.0
    polled = np.ceil(taken / 16e-3) * 16e-3 + rng.exponential(5e-5, 3000)
    # Blocks of whole samples of 5 ms meet polls of 16 ms at so many phases.
    expected = {1: 1e-3, 5: 1e-3, 20: 4e-3, 200: 8e-3}[block]
    assert step(polled, 1) == pytest.approx(expected, rel=0.2)
    assert step(polled, 7) == step(polled, 1)


@pytest.mark.parametrize("n_blocks", [1800, 6000, 36_000])
def test_errors_include_the_uncertainty_due_to_polling(n_blocks: int) -> None:
    covered = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        for ppm in (0.3, 15.0, -20.0):
            taken = last_samples(n_blocks, ppm)
            phase = rng.uniform(0.0, 16e-3)
            arrivals = np.ceil((taken - phase) / 16e-3) * 16e-3 + phase
            clock = solved(block_rows(arrivals + rng.exponential(5e-5, n_blocks)))
            index = BLOCK * np.arange(1.0, n_blocks + 1) - 1
            covered.append(np.std(clock.at(index) - taken) < 2 * clock.state.residual)
            assert clock.state.residual < 5e-3
    assert np.mean(covered) >= 0.9


def test_over_full_beats_polling_adds_no_uncertainty() -> None:
    left, stated = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        taken = last_samples(24_000, rng.choice([-1, 1]) * rng.uniform(12.0, 30.0))
        phase = rng.uniform(0.0, 16e-3)
        arrivals = np.ceil((taken - phase) / 16e-3) * 16e-3 + phase  # a step of 4 ms
        clock = solved(block_rows(arrivals + rng.exponential(5e-5, len(taken))))
        error = clock.at(BLOCK * np.arange(1.0, len(taken) + 1) - 1) - taken
        left.append(error.std())
        stated.append(clock.state.residual)
    assert np.median(left) < 1e-4  # 40 minutes; a line through all arrivals leaves 0.2 ms
    assert 0.5 < np.median(np.array(stated) / left) < 2.0


def error_over_stated(rows: np.ndarray, taken: np.ndarray) -> float:
    """Return what is left of a clock (rms about its mean), in units of what is stated."""
    clock = solved(rows)
    error = clock.at(BLOCK * np.arange(1.0, len(rows) + 1) - 1) - taken
    return float(error.std() / clock.state.residual)


@pytest.mark.parametrize("seconds", [30, 120, 300])
def test_stated_errors_match_the_actual_errors(seconds: int) -> None:
    rng = np.random.default_rng(12 + seconds)
    left, stated, off, known_to = [], [], [], []
    for _ in range(30):
        ppm = rng.uniform(-30, 30)
        taken = last_samples(10 * seconds, ppm)
        clock = solved(block_rows(np.maximum.accumulate(taken + rng.exponential(1e-3, len(taken)))))
        error = clock.at(BLOCK * np.arange(1.0, len(taken) + 1) - 1) - taken
        left.append(error.var())
        stated.append(clock.state.residual**2)
        off.append((clock.state.ppm - ppm) ** 2)
        known_to.append(clock.state.ppm_std**2)
    # The mean of 30 squares of normal slopes is known to 26 %; the root to 13 %. Three
    # observations of 10 s allow for more noise than there is.
    assert 0.7 < np.sqrt(np.mean(stated) / np.mean(left)) < 3.0
    assert 0.8 < np.sqrt(np.mean(known_to) / np.mean(off)) < 3.5


def test_a_wandering_shortest_latency_is_not_attributed_to_the_clock() -> None:
    rng = np.random.default_rng(10)
    taken = last_samples(9000, 10.0)  # a quarter of an hour
    ratios, quiet = [], []
    for _ in range(8):
        step = 10 * np.sqrt(2 * 0.1 / 100.0)  # forgets within 100 s
        busy = np.zeros(len(taken))
        for number, kick in enumerate(rng.normal(0, 40e-6 * step, len(taken) - 1), 1):
            busy[number] = busy[number - 1] * (1 - 0.1 / 100.0) + kick
        late = 5e-3 + busy + rng.exponential(1e-3, len(taken))
        ratios.append(error_over_stated(block_rows(np.maximum.accumulate(taken + late)), taken))
        rows = block_rows(np.maximum.accumulate(taken + rng.exponential(1e-3, len(taken))))
        quiet.append(solved(rows).state.residual)
    assert np.sqrt(np.mean(np.square(ratios))) < 2.0
    assert np.median(quiet) < 6e-6  # nothing is taken back where latencies are independent


@pytest.mark.parametrize("seconds", [5, 10, 20, 60])
@pytest.mark.parametrize("polled", [False, True])
def test_errors_are_large_in_the_first_seconds(seconds: int, polled: bool) -> None:
    rng = np.random.default_rng(11 + seconds)
    ratios = []
    for _ in range(40):
        taken = last_samples(10 * seconds, rng.uniform(-40, 40))
        late = rng.exponential(1e-3, len(taken))
        if polled:
            phase = rng.uniform(0, 16e-3)
            late = (phase - taken) % 16e-3 + rng.exponential(5e-5, len(taken))
        ratios.append(error_over_stated(block_rows(np.maximum.accumulate(taken + late)), taken))
    assert np.mean(np.array(ratios) < 2.0) >= 0.9


def test_polled_arrivals_do_not_contradict_a_step_that_they_cannot_see() -> None:
    seconds = np.arange(0.0, 200.0, 1.0)
    late = np.where(seconds < 100, 0.0, 1e-3)  # the first of polls, of which 5 ms are hidden
    step = Step(95.0, 105.0, 5e-3)
    assert lost_by_delays(step, RATE, (seconds, late)) == 0
    assert lost_by_delays(step, RATE, (seconds, late), known_to=5e-3) == round(5e-3 * RATE)
