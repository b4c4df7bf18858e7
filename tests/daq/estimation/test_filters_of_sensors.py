"""A sensor with a filter that others do not have, or whose filter changes: levels are held."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

import huddle
from daq.estimation.diagnosis import Findings
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.results.result import Result
from estimator.checks.advice_on_noise import ResponseChanges

Filter = Callable[[np.ndarray], np.ndarray]

RATE = 40.0
N = round(1200 * RATE)
NOISE = 2 / RATE  # PSD of white noise of variance 1


def high_pass(corner: float) -> Filter:
    sections = signal.butter(2, corner, "high", fs=RATE, output="sos")
    return lambda samples: np.asarray(signal.sosfilt(sections, samples, axis=0))


def resonant(frequency: float) -> Filter:
    peak = signal.iirpeak(frequency, 10, fs=RATE)
    return lambda samples: samples + signal.lfilter(*peak, samples, axis=0)


def in_an_octave(gain: float) -> Filter:
    sections = signal.butter(2, [1, 2], "band", fs=RATE, output="sos")
    return lambda samples: samples + gain * signal.sosfiltfilt(sections, samples, axis=0)


RISES = in_an_octave(0.0), in_an_octave(0.02)
"""Gain of an octave, before and after."""


@functools.cache  # two tests look at one bench
def estimated(
    seed: int, before: Filter, after: Filter, *, ratio: float = 1e6, octaves: bool = False
) -> Snapshot:
    """White motion of this ratio to white noise; B has one filter, after 45 % another."""
    rng = np.random.default_rng([seed, 474747])
    motion = np.sqrt(ratio) * rng.standard_normal((N, 3))
    samples = {}
    for name in "ABC":
        felt = motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
        if name == "B":
            early = np.arange(N)[:, None] < 0.45 * N
            felt = np.where(early, before(felt), after(felt))
        samples[name] = felt + rng.standard_normal((N, 3))
    return huddle.self_noise(samples, fs=RATE, segment="5s", octaves=octaves).snapshot


def held(snapshot: Snapshot) -> np.ndarray:
    """Return whether levels of two lines and of octaves hold the noise."""
    edges = np.searchsorted(snapshot.frequency, [0.4, 0.6, 0.8, 1.6, 3.2, 6.4, 12.8, 18.0])
    low, high = Result(snapshot, Settings()).spectrum("three-sensor").levels(edges).ends()
    return np.asarray((low <= NOISE) & (high >= NOISE))


def test_what_leaks_is_in_the_interval_from_the_first_line_on() -> None:
    """The slope of a response at the first line is not known from lines on both sides of it."""
    assert held(estimated(1, high_pass(0.8), high_pass(0.8))).mean() > 0.93


@pytest.mark.parametrize(
    ("before", "after", "ratio"),
    [
        (resonant(8.0), resonant(8.2), 1e6),
        (*RISES, 1e4),
        *(
            pytest.param(high_pass(0.8), high_pass(1.0), ratio, marks=pytest.mark.long)
            for ratio in (1e4, 1e6)
        ),
        pytest.param(resonant(8.0), resonant(8.2), 1e4, marks=pytest.mark.long),
        pytest.param(*RISES, 1e6, marks=pytest.mark.long),
    ],
)
def test_a_response_that_changes_at_some_frequencies_is_named_and_held(
    before: Filter, after: Filter, ratio: float
) -> None:
    """Levels were up to 45 dB off, or another sensor was named, too."""
    snapshot = estimated(2, before, after, ratio=ratio)
    assert held(snapshot).mean() > 0.93
    (change,) = [e for e in snapshot.diagnostics.advice if isinstance(e, ResponseChanges)]
    assert change.sensors == (1,)


def test_a_gain_that_changes_in_one_octave_is_held_with_octaves() -> None:
    snapshot = estimated(3, *RISES, octaves=True)
    assert held(snapshot).mean() > 0.93


def test_what_clocks_explain_is_no_change_of_a_response() -> None:
    """Beside times that nobody could check, a gain that rose by 240 % was named."""
    snapshot = estimated(2, *RISES, ratio=1e4)
    found = Findings(diagnosis=snapshot.diagnostics.diagnosis)
    assert found.beside_clocks(snapshot.clocks) == found

    def changes(column: int, *, drifts: bool = False, unchecked: bool = False) -> list[str]:
        clocks = list(snapshot.clocks)
        clocks[column] = replace(clocks[column], drifts=drifts, unchecked=unchecked)
        after = found.beside_clocks(clocks).diagnosis
        assert after is not None
        own = [each for each in after.advice if isinstance(each, ResponseChanges)]
        return [each.words(snapshot.names).line for each in own]

    assert changes(0, drifts=True) == []
    (line,) = changes(1, unchecked=True)
    assert ", or its times drift; " in line
    (line,) = changes(0, unchecked=True)  # as of a dead sensor: it hid the changes of others
    assert "times" not in line
