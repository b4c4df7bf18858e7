"""What clocks may have added or taken is in every interval; a sensor's late begin is said."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies.clocks import free_running
from benchmarks.studies.synthesis import Latency, synthesise
from daq.estimation.diagnosis import bias_of_clocks
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.estimation.snapshot_diagnostics import CLOCK_FACTOR, Synchronisation
from daq.results.facts.clocks import Polled
from daq.results.facts.recordings import SpanShortened
from daq.results.result import Result
from estimator.checks.advice import Rank
from estimator.methods import self_noise
from tests.daq.clocks.recordings import Sensor, write, write_polled
from tests.tui.example_snapshot import SETTINGS, empty_snapshot, made_snapshot
from tui.output.results import result_table
from tui.wording.formatting import level_with_error

BAND = (5.0, 15.0)
OPPOSITE = np.array([[0.0, 1.0, 1.0], [1.0, 0.0, 4.0], [1.0, 4.0, 0.0]])
"""Variances of the delay between sensors: B is late when C is early, by as much."""


def test_means_are_lowered_by_four_times_what_is_expected_of_the_clocks() -> None:
    means = [
        Result(snapshot, SETTINGS).means("three-sensor", BAND)
        for snapshot in (made_snapshot(clock_share=0.0), made_snapshot(clock_share=0.01))
    ]
    for without, with_clocks in zip(*means, strict=True):
        assert with_clocks.mean == without.mean
        assert with_clocks.high == without.high
        lowered = CLOCK_FACTOR * 0.01 * without.mean
        assert without.low - with_clocks.low == pytest.approx(lowered)


def test_they_add_no_more_than_the_noise_itself_and_nothing_where_unknown() -> None:
    snapshot = made_snapshot(clock_share=3.0)
    added = snapshot.added_by_clocks
    assert added is not None
    np.testing.assert_allclose(added, np.abs(snapshot.results["three-sensor"].noise_psd))
    assert empty_snapshot().added_by_clocks is None
    unknown = made_snapshot(clock_share=float("nan")).added_by_clocks
    assert unknown is not None
    assert not unknown.any()


def test_tables_show_both_halves_where_the_lower_one_is_wider() -> None:
    assert level_with_error(1.0, 10**0.01, 10**-0.01) == "0.00 ±0.10"
    assert level_with_error(1.0, 10**0.01, 10**-0.03) == "0.00 +0.10 −0.30"
    assert level_with_error(1.0, 10**0.01, -1.0) == "below 0.10"
    assert level_with_error(-1.0, 10**0.01, -2.0) == "below 0.10"
    assert level_with_error(-1.0, -0.5, -2.0) == "below 0"
    assert level_with_error(100.0, 10**0.01, 1.0) == "below 0.10"  # a bound beneath it
    assert level_with_error(1.0, math.inf, 0.5) == "not known"
    table = result_table(Result(made_snapshot(clock_share=0.05), SETTINGS))
    assert "+" in table.rows[0][3]
    table = result_table(Result(made_snapshot(clock_share=0.0001), SETTINGS))
    assert "±" in table.rows[-1][3]  # the first has an uneven scatter


def test_short_levels_say_the_same() -> None:
    """In the tables of the application, for one channel and where there is little room."""
    assert level_with_error(1.0, 10**0.01, 10**-0.03, short=True) == "0.0±0.3"
    assert level_with_error(1.0, 10**0.001, 10**-0.001, short=True) == "0.0±<.1"
    assert level_with_error(1.0, 10**0.01, 10**-0.01, short=True, bare=True) == "0.0"
    for low in (-math.inf, -1.0):
        assert level_with_error(1.0, 10**0.01, low, short=True) == "<0.1"
    assert level_with_error(100.0, 10**0.01, 1.0, short=True, bare=True) == "<0.1"
    assert level_with_error(1.0, math.inf, 0.5, short=True) == "not known"
    assert level_with_error(-1.0, -0.5, -2.0, short=True) == "below 0"


def test_curves_of_free_running_clocks_carry_it_at_every_frequency(tmp_path: Path) -> None:
    """By arrival times alone, 1 ms late on the mean."""
    path = synthesise(tmp_path / "a.h5", free_running(snr=1e3), duration=120.0, latency=Latency())
    settings = Settings(segment=2.0, clocks="arrivals", methods=("three-sensor",))
    snapshot = estimate([path], settings)
    noise, added = snapshot.results["three-sensor"], snapshot.added_by_clocks
    assert added is not None
    known = np.isfinite(noise.low) & (added > 0)
    usual = noise.low + added  # as scatter alone has it
    assert np.all(usual[known] <= noise.noise_psd[known] + 1e-12 * np.abs(noise.noise_psd[known]))
    rising = added[:, 2:] / np.abs(noise.noise_psd[:, 2:])
    assert np.nanmedian(rising[150:170]) > 10 * np.nanmedian(rising[10:20])  # as f²


def test_clocks_that_err_in_opposite_ways_widen_the_upper_end() -> None:
    """The three-sensor noise of the first is then ω² S σ² too low, in the mean over the motion."""
    frequency = np.arange(101) * np.float64(0.5)
    psd, noise, late = 1e-6, 1e-10, 20e-6
    turn = np.exp(-0.5 * (2 * np.pi * frequency[:, None, None] * late) ** 2 * OPPOSITE)
    csm = psd * turn + noise * np.eye(3)
    dims = (1, 1, 1)
    csm = csm.astype(np.complex128)
    results = {"three-sensor": self_noise("three-sensor", csm, dims=dims, n_effective=1e9)}
    found = bias_of_clocks(
        Synchronisation({"A": 0.0, "B": late, "C": late}),
        dims=dims,
        frequency=frequency,
        csm=csm,
        results=results,
    )
    assert found.removed is not None
    missing = noise - results["three-sensor"].noise_psd[1:, 0]
    assert np.all(missing > 0)
    assert np.all(found.removed[1:, 0] > missing)
    np.testing.assert_allclose(found.removed[1:41, 0], CLOCK_FACTOR * missing[:40], rtol=0.05)


def test_errors_of_two_clocks_take_nothing_from_the_noise_of_two_sensors() -> None:
    frequency = np.arange(11) * np.float64(1.0)
    csm = np.broadcast_to(np.ones((2, 2)) + 1e-3 * np.eye(2), (11, 2, 2)).astype(np.complex128)
    found = bias_of_clocks(
        Synchronisation({"A": 0.0, "B": 1e-4}),
        dims=(1, 1),
        frequency=frequency,
        csm=csm,
        results={"two-channel": self_noise("two-channel", csm, dims=(1, 1), n_effective=1e3)},
    )
    assert found.removed is not None
    assert not found.removed.any()
    assert found.noise_bias is not None
    assert (found.noise_bias[1:, 1] > 0).all()


@pytest.mark.parametrize("late", [1e-6, 5e-3])
def test_uneven_instants_of_polls_are_in_the_interval_at_all_frequencies(
    tmp_path: Path, late: float
) -> None:
    """Devices sample evenly, 20 dB above their noise; far below the motion that adds the most."""
    path = write_polled(
        tmp_path / "p.h5", {each: np.zeros(15_000, np.bool_) for each in "abc"}, late=late
    )
    settings = Settings(segment=5.0, band=(0.5, 3.0), methods=("three-sensor",))
    result = Result(estimate([path], settings), settings)
    facts = [each for each in result.facts if isinstance(each, Polled)]
    assert [each.rank for each in facts] == [Rank.DELAYS if late > 1e-4 else Rank.TO_KNOW] * 3
    truth = 0.01 * 2 / 50
    means = result.means("three-sensor")
    assert sum(bool(each.low[0] < truth < each.high[0]) for each in means) >= 8
    if late > 1e-4:
        assert facts[0].uneven == pytest.approx(late / math.sqrt(12), rel=0.05)
        assert np.mean([each.mean[0] for each in means]) > 1.5 * truth


# --- a shortened span ------------------------------------------------------------------------


SHORTENED = Settings(segment=2.0)
RATE, SECONDS = 10.0, 1200.0


def estimated(path: Path, *, begin: float = 0.0, end: float = SECONDS) -> Snapshot:
    """Return the estimate of three sensors, of which C has samples from `begin` to `end`, in s."""
    rng = np.random.default_rng(5)
    motion = 1e3 * rng.standard_normal((round(RATE * SECONDS), 1))
    sensors = {}
    for name in "ABC":
        counts = np.rint(motion + 10.0 * rng.standard_normal(motion.shape)).astype(np.int32)
        first, last = (round(RATE * t) for t in ((begin, end) if name == "C" else (0.0, SECONDS)))
        own = first / RATE if name == "C" else 0.0
        sensors[name] = Sensor(counts[first:last], RATE, start=own, utc=True)
    return estimate([write(path, sensors)], SHORTENED)


def shortened(snapshot: Snapshot) -> list[SpanShortened]:
    return [fact for fact in Result(snapshot, SHORTENED).facts if isinstance(fact, SpanShortened)]


@pytest.mark.parametrize(
    ("begin", "end", "seconds", "rank"),
    [
        (200.0, 1200.0, 200.0, Rank.DELAYS),
        (0.0, 1050.0, 150.0, Rank.DELAYS),
        (100.0, 1200.0, 100.0, Rank.TO_KNOW),
    ],
)
def test_what_others_have_beyond_a_sensor_is_said(
    tmp_path: Path, begin: float, end: float, seconds: float, rank: Rank
) -> None:
    snapshot = estimated(tmp_path / "r.h5", begin=begin, end=end)
    (fact,) = shortened(snapshot)
    assert snapshot.elapsed == pytest.approx(SECONDS - seconds, abs=3.0)
    assert (fact.sensors, fact.at_end, fact.rank) == (("C",), end < SECONDS, rank)
    assert fact.unused == pytest.approx(seconds, abs=1.0)


def test_less_than_a_minute_is_no_fact(tmp_path: Path) -> None:
    assert shortened(estimated(tmp_path / "r.h5", begin=50.0, end=1150.0)) == []
