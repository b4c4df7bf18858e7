"""What counts show of their limits: signals made here, and what must not raise an alarm."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import butter, sosfilt

from estimator.checks.count_limits import CountLimits, codes, share_at_ends, share_of_repeats, wraps

Signal = Callable[[np.random.Generator, int], NDArray[np.float64]]


def white(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    return rng.standard_normal(n)


def smooth(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    found = sosfilt(butter(4, 0.03, output="sos"), rng.standard_normal(n))
    return np.asarray(found / found.std())


def drift(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    walk = np.cumsum(rng.standard_normal(n))
    return np.asarray((walk - walk.mean()) / walk.std())


def knocks(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    found = 0.05 * rng.standard_normal(n)
    for at in rng.integers(0, n - 80, n // 400):
        ring = np.sin(2 * np.pi * rng.uniform(0.05, 0.4) * np.arange(80))
        found[at : at + 80] += 20 * rng.exponential() * np.exp(-np.arange(80) / 10) * ring
    return found


def spikes(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    found = 0.1 * rng.standard_normal(n)
    found[rng.integers(0, n, n // 300)] += rng.normal(0, 30, n // 300)
    return found


def settling(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    return 20 * np.exp(-np.arange(n) / (n / 10)) + 0.3 * rng.standard_normal(n)


def moved(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    return 10 * (np.arange(n) > rng.uniform(0.2, 0.8) * n) + 0.2 * rng.standard_normal(n)


def tone(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    phase = 2 * np.pi * 0.0317 * np.arange(n) + rng.uniform(0, 6)
    return np.asarray(1.4 * np.sin(phase) + 0.01 * rng.standard_normal(n))


ORDINARY = (white, smooth, drift, knocks, spikes, settling, moved, tone)
LEVELS = (0.3, 1.0, 3.0, 30.0, 1e3, 1e5)


@pytest.mark.parametrize("signal", ORDINARY)
@pytest.mark.parametrize("level", LEVELS)
def test_no_alarm_on_quiet_coarse_and_ordinary_signals(signal: Signal, level: float) -> None:
    """From noise far below one count to all bits of a good digitizer, with any offset."""
    rng = np.random.default_rng([ORDINARY.index(signal), int(10 * level)])
    for n in (500, 2000, 2000, 20_000):
        offset = rng.integers(-2000, 2000)
        counts = np.rint(
            np.column_stack([level * (signal(rng, n) + offset) for _ in range(3)])
        ).astype(np.int64)
        found = CountLimits.of(counts, {k: np.ones(n, bool) for k in range(3)})
        assert found == CountLimits({}, {}, {}, {})
        assert share_of_repeats(counts[:, :1]) == 0.0


@pytest.mark.parametrize("noise", [0.0, 3.0], ids=["hard", "soft"])
@pytest.mark.parametrize("signal", [white, smooth])
def test_a_signal_that_is_cut_off_is_clipped(signal: Signal, noise: float) -> None:
    """At counts that no full scale names; a soft end has the noise of the digitizer on it."""
    rng = np.random.default_rng(1)
    cut = np.clip(1000 * signal(rng, 20_000), -2000, 1500) + noise * rng.standard_normal(20_000)
    share = share_at_ends(np.rint(cut).astype(np.int64))
    wanted = np.mean((cut >= 1500 - 10) | (cut <= -2000 + 10))
    assert 0.5 * wanted < share < 1.5 * wanted


def test_knocks_that_all_reach_the_end_are_clipped() -> None:
    """Hardly a sample lies on their slopes."""
    rng = np.random.default_rng(2)
    knocked = 100 * rng.standard_normal(20_000)
    knocked[rng.integers(0, 20_000, 60)] *= 1e6
    assert 55 <= 20_000 * share_at_ends(np.rint(np.clip(knocked, -3000, 3000))) <= 60


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16, 18, 20, 24, 28, 32])
@pytest.mark.parametrize("offset", [0.0, 0.4], ids=["centred", "offset"])
@pytest.mark.parametrize("signed", [True, False])
def test_a_wrap_is_named_with_its_bits(bits: int, offset: float, signed: bool) -> None:
    rng = np.random.default_rng(bits)
    size = 1 << bits
    true = np.rint(size * (smooth(rng, 4000) / 4 + offset)).astype(np.int64)
    counts = (true + size // 2) % size - size // 2 if signed else true % size
    found = wraps(counts)
    assert found is not None
    assert found.bits == bits
    assert found.n == np.count_nonzero(np.diff((true + (size // 2) * signed) // size))
    assert wraps(counts.astype(np.float64)) == found  # a driver may record floats


def test_a_rough_signal_that_wraps_is_named() -> None:
    """White noise: its steps say nothing; its distribution goes on across both ends."""
    true = np.rint(30_000 * white(np.random.default_rng(2), 30_000)).astype(np.int64)
    found = wraps((true + 32768) % 65536 - 32768)
    assert found is not None
    assert found.bits == 16
    assert wraps(true) is None


@pytest.mark.parametrize("bit", [0, 1, 3, 6, 8])
def test_a_bit_that_never_changes_is_found(bit: int) -> None:
    counts = np.rint(5000 * white(np.random.default_rng(bit), 2000)).astype(np.int64) & ~(1 << bit)
    found = codes(counts)
    assert found is not None
    assert (found.step, found.stuck_bits) == ((2, ()) if bit == 0 else (1, (bit,)))


def test_coarse_steps_and_single_codes_are_found() -> None:
    rng = np.random.default_rng(3)
    coarse = codes(256 * np.rint(300 * white(rng, 2000)).astype(np.int64))
    assert coarse is not None
    assert coarse.step == 256
    assert coarse.bits == pytest.approx(np.log2(2000), abs=0.3)
    counts = np.rint(20 * white(rng, 20_000)).astype(np.int64)
    found = codes(np.where(counts == 5, 6, counts))
    assert found is not None
    assert (found.step, found.stuck_bits, found.n_missing) == (1, (), 1)


@pytest.mark.parametrize("refresh", [0.1, 0.2, 0.4, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0])
@pytest.mark.parametrize("n_channels", [1, 3])
def test_readings_that_repeat_are_counted(refresh: float, n_channels: int) -> None:
    """Polls with jitter of a device that refreshes less often, in phase with nothing."""
    rng = np.random.default_rng(int(100 * refresh))
    taken = np.arange(2000) + 0.1 * rng.standard_normal(2000) * (refresh < 1)
    fresh = np.floor(refresh * taken + 1).astype(int)
    values = np.rint(300 * rng.standard_normal((2010, n_channels))).astype(np.int64)
    share = share_of_repeats(values[fresh])
    assert share == pytest.approx(np.mean(np.diff(fresh) == 0), abs=0.01)
