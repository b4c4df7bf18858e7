"""Masks of the bench file are met or not by what is known, not by what scatters."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
import pytest

from daq.bench.loading import parse
from daq.results.limits import LimitResult, exceeded, judged
from estimator.methods import self_noise
from tests.tui.example_snapshot import SETTINGS, made_snapshot
from tui.output.results import limit_line

if TYPE_CHECKING:
    from daq.bench.model import Bench

MASK = """
[[limits]]
name = "data sheet"
frequency = [1.0, 30.0]
psd = [{psd}, {psd}]
{more}
"""


def bench_with(psd: float, more: str = "") -> Bench:
    text = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    return parse(text + MASK.format(psd=psd, more=more))


def found(psd: float, more: str = "", *, n_effective: float = 1000.0) -> list[tuple[str, str]]:
    bench = bench_with(psd, more)
    snapshot = made_snapshot(n_effective=n_effective)
    return [(e.sensor, e.channel) for e in exceeded(bench, snapshot, SETTINGS)]


def test_channels_above_a_mask_are_found() -> None:
    # The channels' noise is 1, 2, … 9 pm²/s⁴/Hz, known here to 1 % or so.
    assert found(9.5e-12) == []
    assert found(6.5e-12) == [("C", "X"), ("C", "Y"), ("C", "Z")]


def test_a_mask_may_be_for_some_sensors_or_channels() -> None:
    assert found(6.5e-12, 'sensors = ["A", "B"]') == []
    assert found(6.5e-12, 'channels = ["Y"]') == [("C", "Y")]


def test_what_is_not_known_well_enough_is_not_held_against_a_channel() -> None:
    assert ("C", "Z") in found(8e-12, n_effective=5000.0)
    assert found(9.8e-12, n_effective=20.0) == []  # its mean is 10.6e-12, the correction done


def test_a_channel_just_at_its_mask_seldom_fails() -> None:
    rng = np.random.default_rng(11)
    snapshot, settings = made_snapshot(), replace(SETTINGS, window="rectangular", overlap=0.0)
    noise, bench = snapshot.results["three-sensor"], bench_with(4e-12)
    cov = np.full_like(noise.cov, 0.05)
    failing = 0
    for _ in range(60):
        drawn = 4e-12 * (1 + cov * rng.normal(size=cov.shape))
        results = {"three-sensor": replace(noise, noise_psd=drawn, cov=cov)}
        failing += len(exceeded(bench, replace(snapshot, results=results), settings))
    # One in forty of 540 and four standard deviations; band by band it would be 121.
    assert 0 < failing <= 13.5 + 4 * math.sqrt(13.5)


def test_a_mask_outside_the_spectrum_says_nothing() -> None:
    text = MASK.format(psd=1e-15, more="").replace("[1.0, 30.0]", "[300.0, 400.0]")
    base = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    assert exceeded(parse(base + text), made_snapshot(), SETTINGS) == []


def test_a_failure_says_where_and_by_how_much() -> None:
    (failure,) = exceeded(bench_with(8.5e-12), made_snapshot(n_effective=5000.0), SETTINGS)
    assert limit_line(failure).startswith("C.Z does not meet 'data sheet': three-sensor −110.")
    assert failure.noise_psd == pytest.approx(9e-12, rel=0.05)


def verdicts(psd: float, *, n_effective: float = 1000.0) -> dict[str, LimitResult]:
    snapshot = made_snapshot(n_effective=n_effective)
    return {e.sensor + e.channel: e for e in judged(bench_with(psd), snapshot, SETTINGS)}


def test_every_channel_has_its_margin_and_whether_it_is_certain() -> None:
    of = verdicts(5e-12)
    assert of["AX"].met
    assert of["AX"].certain
    assert of["AX"].margin_db == pytest.approx(10 * math.log10(5), abs=0.5)
    assert of["BY"].met
    assert not of["BY"].certain
    assert not of["CZ"].met
    assert of["CZ"].certain
    assert of["CZ"].margin_db == pytest.approx(10 * math.log10(5 / 9), abs=0.5)


def test_a_mask_where_nothing_can_be_said_is_neither_met_nor_missed() -> None:
    snapshot = made_snapshot()
    dead = snapshot.csm.copy()
    dead[:, 0, :] = dead[:, :, 0] = 0
    noise = self_noise("three-sensor", dead, dims=(3, 3, 3), n_effective=100.0)
    dead_snapshot = replace(snapshot, csm=dead, results={"three-sensor": noise})
    of = {e.sensor + e.channel: e for e in judged(bench_with(5e-12), dead_snapshot, SETTINGS)}
    assert not of["AX"].known
    assert not exceeded(
        bench_with(1e-13, 'channels = ["X"]\nsensors = ["A"]'), dead_snapshot, SETTINGS
    )


def test_a_mask_is_in_the_unit_of_the_bench_file() -> None:
    snapshot = made_snapshot(n_effective=1000.0)
    scale = 9.80665e-6**-2  # (µg)² in (m/s²)²
    (noise,) = [snapshot.results["three-sensor"]]
    in_micro_g = replace(
        snapshot,
        unit="µg",
        channels=tuple(replace(label, unit="µg") for label in snapshot.channels),
        results={
            "three-sensor": replace(
                noise,
                noise_psd=noise.noise_psd * scale,
                low=noise.low * scale,
                high=noise.high * scale,
            )
        },
    )
    failing = [(e.sensor, e.channel) for e in exceeded(bench_with(6.5e-12), in_micro_g, SETTINGS)]
    assert failing == [("C", "X"), ("C", "Y"), ("C", "Z")]
