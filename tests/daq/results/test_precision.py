"""Numbers of a result: the c.o.v., differences between two tests, levels that are withdrawn."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from daq.bench.sensitivity import KnownSensitivity
from daq.estimation.contributions import with_sensitivities
from daq.results.band_summary import BandMeans, Levels, Spectrum
from daq.results.comparison import compare, difference
from daq.results.result import Result
from daq.results.uncertainty_budget import level_budget
from estimator.self_noise.result import SelfNoise
from tests.tui.example_snapshot import SETTINGS, empty_snapshot, made_snapshot


def test_half_the_scatter_takes_four_times_as_long() -> None:
    snapshot = made_snapshot(n_effective=1000.0)
    cov = Result(snapshot, SETTINGS).precision().cov
    found = Result(snapshot, replace(SETTINGS, target_cov=cov / 2)).precision()
    assert not found.is_reached
    assert found.seconds_left == pytest.approx(3 * snapshot.n_segments)  # one a second
    assert found.total == pytest.approx(4 * snapshot.elapsed, rel=0.1)
    assert Result(made_snapshot(n_effective=4000.0), SETTINGS).precision().cov == pytest.approx(
        cov / 2, rel=0.01
    )


def test_a_target_that_is_reached_takes_no_more_time() -> None:
    snapshot = made_snapshot()
    cov = Result(snapshot, SETTINGS).precision().cov
    found = Result(snapshot, replace(SETTINGS, target_cov=cov)).precision()
    assert found.is_reached
    assert found.seconds_left == 0.0
    assert found.total == snapshot.elapsed
    of_some = Result(
        replace(snapshot, not_estimated=("C",)), replace(SETTINGS, target_cov=cov)
    ).precision()
    assert not of_some.is_reached


def test_segments_that_were_left_out_slow_it_down() -> None:
    snapshot = made_snapshot()
    gappy = replace(snapshot, n_dropped=snapshot.n_segments)
    left = [Result(each, SETTINGS).precision().seconds_left for each in (snapshot, gappy)]
    assert left[0] is not None
    assert left[1] == pytest.approx(2 * left[0])


def test_without_a_target_or_an_estimate_there_is_none() -> None:
    free = Result(made_snapshot(), replace(SETTINGS, target_cov=None)).precision()
    assert (free.seconds_left, free.total, free.is_reached) == (None, None, False)
    nothing = Result(empty_snapshot(), SETTINGS).precision()
    assert math.isnan(nothing.cov)
    assert nothing.seconds_left is None
    assert not nothing.is_reached


def test_it_is_that_of_the_worst_third_of_an_octave_of_the_worst_channel() -> None:
    snapshot = made_snapshot()
    noise = snapshot.results["three-sensor"]
    level = np.full_like(noise.noise_psd, 2.0)
    level[:, 8] = np.nan
    share = np.full_like(level, 0.1)
    share[10:, 4] = 0.2
    share[100:, 4] = 5.0  # beyond the band, which ends at 20 Hz
    cumulants = np.stack([level**k * share ** (2 * (k - 1)) for k in (2, 3, 4)])
    changed = SelfNoise.of(noise.method, level, cumulants, noise.flags)
    snapshot = replace(snapshot, results={"three-sensor": changed})
    settings = replace(SETTINGS, window="rectangular", overlap=0.0)
    # bins are 0.5 Hz apart: the lowest band has one, those from 5 Hz on have two or more
    covs = Result(snapshot, settings).covs
    assert covs[0] == pytest.approx(0.1)
    assert covs[4] == pytest.approx(0.2 / np.sqrt(2))
    assert math.isnan(covs[8])
    assert Result(snapshot, settings).precision().cov == max(covs[:8])
    by_bin = replace(settings, target_cov=None, target_cov_bin=0.4)
    assert Result(snapshot, by_bin).covs[4] == pytest.approx(0.2)
    assert Result(snapshot, by_bin).precision().is_reached


def test_a_method_that_is_only_shown_is_not_the_one_that_counts() -> None:
    snapshot = made_snapshot()
    compared = replace(snapshot, results={"three-channel": snapshot.results["three-channel"]})
    assert math.isnan(Result(compared, SETTINGS).precision().cov)
    assert math.isfinite(Result(snapshot, SETTINGS).precision().cov)


# --- differences between two tests -----------------------------------------------------------


def mean_of(level: float, error: float) -> BandMeans:
    """Return a mean with the log-normal interval of this relative error."""
    factor = math.exp(1.96 * error)
    return BandMeans(
        *(np.array([v]) for v in (level, level * error, level / factor, level * factor))
    )


@pytest.mark.parametrize("errors", [(0.03, 0.03), (0.05, 0.2)])
def test_the_interval_covers_the_true_difference(errors: tuple[float, float]) -> None:
    rng = np.random.default_rng(5)
    drawn = np.exp(rng.normal(0, errors, size=(2000, 2)))
    found = [
        difference("A", "X", *(mean_of(v, e) for v, e in zip(pair, errors, strict=True)))
        for pair in drawn.tolist()
    ]
    covered = np.mean([each.low_db <= 0 <= each.high_db for each in found])
    assert covered == pytest.approx(0.95, abs=3.3 * math.sqrt(0.95 * 0.05 / 2000))
    certain = np.mean([each.is_certain for each in found])
    assert certain == pytest.approx(1 - covered)


def test_like_channels_are_compared_in_the_common_band() -> None:
    snapshot = made_snapshot(n_effective=2000.0)
    noise = snapshot.results["three-sensor"]
    scale = np.array([4.0, 8.0, 16.0])[:, None, None]
    doubled = SelfNoise.of(noise.method, 2 * noise.noise_psd, scale * noise.cumulants, noise.flags)
    louder = replace(snapshot, csm=2 * snapshot.csm, results={"three-sensor": doubled})
    other = replace(SETTINGS, band=(2.0, 30.0))
    found = compare(Result(louder, SETTINGS), Result(snapshot, other))
    assert len(found) == 9
    for each in found.values():
        assert each.db == pytest.approx(10 * math.log10(2), abs=1e-6)
        assert each.low_db < each.db < each.high_db
        assert each.is_certain


def test_an_uncertain_sensitivity_is_no_part_of_a_difference() -> None:
    """It is the same in both tests; the temperature may not be."""
    snapshot = made_snapshot(n_effective=2000.0)
    names = [(label.sensor, label.channel) for label in snapshot.channels]
    exact = compare(Result(snapshot, SETTINGS), Result(snapshot, SETTINGS))
    for known, same in (
        (KnownSensitivity(own=0.1), True),
        (KnownSensitivity(own=0.1, coefficient=0.01), False),
    ):
        stated = with_sensitivities(snapshot, dict.fromkeys(names, known.at((0.0, 40.0))))
        found = compare(Result(stated, SETTINGS), Result(stated, SETTINGS))
        assert (found == exact) == same
        assert found[names[0]].high_db >= exact[names[0]].high_db


def test_what_has_nothing_in_common_is_not_compared() -> None:
    snapshot = made_snapshot()
    others = (
        replace(snapshot, unit="m/s"),
        replace(snapshot, results={}),
        replace(snapshot, channels=tuple(replace(c, sensor="Z") for c in snapshot.channels)),
    )
    assert all(
        compare(Result(snapshot, SETTINGS), Result(other, SETTINGS)) == {} for other in others
    )
    apart = replace(SETTINGS, band=(30.0, 40.0))
    assert compare(Result(snapshot, SETTINGS), Result(snapshot, apart)) == {}


def test_a_mean_below_zero_has_no_difference() -> None:
    below = BandMeans(*(np.array([v]) for v in (-1.0, 1.0, -3.0, 1.0)))
    found = difference("A", "X", below, mean_of(1.0, 0.1))
    assert math.isnan(found.db)
    assert not found.is_certain
    vague = BandMeans(*(np.array([v]) for v in (1.0, 1.0, -1.0, 3.0)))
    found = difference("A", "X", vague, mean_of(1.0, 0.1))
    assert found.low_db == -math.inf
    assert math.isfinite(found.high_db)


# --- levels that are withdrawn ---------------------------------------------------------------


def levels() -> Levels:
    snapshot = made_snapshot()
    noise = snapshot.results["three-sensor"]
    found = Spectrum(noise, snapshot, SETTINGS).levels(np.array([2, 8, 16]))
    return replace(found, contributions=())


def bounded_by(share: float) -> Levels:
    """Return levels whose bound is this share of them."""
    found = levels()
    scatter = found.of_scatter
    factors = share ** np.arange(2, len(scatter.cumulants) + 2)  # variance, third, fourth
    cumulants = scatter.cumulants * factors.reshape(-1, *(1,) * (scatter.cumulants.ndim - 1))
    return replace(found, bound=replace(scatter, mean=share * scatter.mean, cumulants=cumulants))


def test_a_withdrawn_level_has_no_lower_end() -> None:
    found = bounded_by(0.01)
    low, high = found.ends()
    assert found.withdrawn().all()
    assert np.isneginf(low).all()
    assert (high < 0.1 * found.mean).all()


def test_an_interval_below_zero_is_withdrawn() -> None:
    """Motion across the axes leaves less than nothing: "below 0" was said of 43 dB."""
    found = bounded_by(0.5)
    found = replace(found, of_scatter=replace(found.of_scatter, mean=-found.mean))
    assert (found.of_scatter.interval()[1] < 0).all()  # what this is about
    low, high = found.ends()
    assert found.withdrawn().all()
    assert np.isneginf(low).all()
    assert (high > found.bound.mean).all()
    unknown = np.full_like(found.bound.mean, np.nan)
    _, high = replace(found, bound=replace(found.bound, mean=unknown)).ends()
    assert np.isposinf(high).all()


def test_how_far_an_estimate_is_below_zero_lowers_no_upper_end() -> None:
    """Noise was passed at a thirtieth of its level, by a motion that lacked a direction."""
    found = bounded_by(100.0)
    end = found.of_scatter.interval()[1] - found.mean  # nearly: the interval is not symmetrical
    found = replace(found, of_scatter=replace(found.of_scatter, mean=-0.98 * end))
    by_scatter = found.of_scatter.interval()[1]
    positive = by_scatter > 0
    assert positive.any()
    assert (by_scatter < 0.5 * end)[positive].all()
    assert (found.ends()[1] > 0.9 * end)[positive].all()


def test_a_level_below_its_bound_keeps_its_ends() -> None:
    found = bounded_by(100.0)
    low, high = found.ends()
    assert not found.withdrawn().any()
    assert (low > 0.1 * found.mean).all()
    assert (high > found.mean).all()


def test_a_budget_says_that_a_scatter_is_not_known() -> None:
    """`--json` of a bench with a clipped sensor ended in the root of a negative variance."""
    found, labels = bounded_by(0.5), made_snapshot().channels
    scatter = replace(found.of_scatter, cumulants=-found.of_scatter.cumulants)
    budget = level_budget(replace(found, of_scatter=scatter), 0, labels[0], (1.0, 2.0))
    assert np.isinf(budget.components[0].relative)
    assert np.isneginf(budget.interval[0])


@pytest.mark.parametrize("share", [1e-3, 0.01, 0.1, 0.3, 0.6, 0.9, 1.1, 3.0, 100.0])
def test_no_estimate_is_exported_beside_an_interval_that_excludes_it(share: float) -> None:
    """The mean of a band was 194 beside an upper end of 40.7, in JSON and certificates."""
    found, labels = bounded_by(share), made_snapshot().channels
    for column, label in enumerate(labels):
        means = found.of_channel(column)
        for row, (estimate, low, high) in enumerate(
            zip(means.estimate, means.low, means.high, strict=True)
        ):
            budget = level_budget(found, column, label, (1.0, 2.0), row=row)
            is_held = low <= means.mean[row] <= high
            assert np.isnan(estimate) if not is_held else estimate == means.mean[row]
            np.testing.assert_equal(budget.value, estimate)
