"""The c.o.v. of a result, and when it reaches what is wanted: computed once for every screen."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from daq.results.result import Result
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
