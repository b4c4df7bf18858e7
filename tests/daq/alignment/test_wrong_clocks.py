"""Clocks that are wrong, in recordings whose clocks are known: seen, and stated truly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.results.band_summary import levels
from tests.known_clocks import NOISE, Scene, record
from tui.output.results import wrong_times

if TYPE_CHECKING:
    from pathlib import Path

    from daq.estimation.snapshot import Snapshot
    from tests.known_clocks import Truth

SETTINGS = Settings(equalise="off")
EDGES = (0.02, 0.1, 0.25, 0.43)
"""Of bands, as fractions of the sampling rate."""


def estimated(path: Path, scene: Scene) -> tuple[Snapshot, Truth]:
    truth = record(path / "r.h5", scene)
    return estimate([path / "r.h5"], SETTINGS), truth


def errors(snapshot: Snapshot, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return level over truth in dB, and whether the interval holds the truth, by band."""
    edges = np.searchsorted(snapshot.frequency, min(scene.rates) * np.array(EDGES))
    found = levels(snapshot.results["three-sensor"], snapshot, SETTINGS, edges)
    low, high = found.ends()
    with np.errstate(invalid="ignore"):
        error = 10 * np.log10(found.mean / NOISE)
    return error, (low <= NOISE) & (high >= NOISE)


@pytest.mark.parametrize("snr", [3.0, 1e4])
def test_the_stated_residual_of_a_good_clock_is_that_of_its_filter(
    tmp_path: Path, snr: float
) -> None:
    scene = Scene(snr=snr, seconds=300.0)
    snapshot, truth = estimated(tmp_path, scene)
    assert all(clock.is_understood for clock in snapshot.clocks)
    assert not wrong_times(snapshot)
    stated = np.array(list(snapshot.diagnostics.synchronisation.residual.values()))[1:]
    real = truth.residual(snapshot)[1:]
    assert (stated > real / 2).all()
    assert (stated < 4 * real.max()).all()


def test_samples_lost_all_the_time_are_not_taken_for_a_fast_clock(tmp_path: Path) -> None:
    """One of 1000 samples is lost: the delays lie on a line, of a rate that no clock has."""
    slips = {1: [(5.0 * n, 1) for n in range(1, 60)]}
    scene = Scene(seconds=300.0, slips=slips)
    snapshot, _ = estimated(tmp_path, scene)
    assert [clock.is_understood for clock in snapshot.clocks] == [True, False, True]
    _, holds = errors(snapshot, scene)
    assert holds.all()
    (line,) = wrong_times(snapshot)
    assert "The clock of B (−985 ppm) is not understood" in line
    assert "lost or repeated without being counted" in line
