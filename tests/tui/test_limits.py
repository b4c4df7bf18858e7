"""Masks of the bench file are met or not by what is known, not by what scatters."""

from __future__ import annotations

from importlib import resources

import pytest

from daq.bench import parse
from tests.tui.made import SETTINGS, made_snapshot
from tui.limits import exceeded

MASK = """
[[limits]]
name = "data sheet"
frequency = [1.0, 30.0]
psd = [{psd}, {psd}]
{more}
"""


def found(psd: float, more: str = "", *, n_effective: float = 1000.0) -> list[tuple[str, str]]:
    text = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    bench = parse(text + MASK.format(psd=psd, more=more), check=False)
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


def test_a_mask_outside_the_spectrum_says_nothing() -> None:
    text = MASK.format(psd=1e-15, more="").replace("[1.0, 30.0]", "[300.0, 400.0]")
    base = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    assert exceeded(parse(base + text, check=False), made_snapshot(), SETTINGS) == []


def test_a_failure_says_where_and_by_how_much() -> None:
    text = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    bench = parse(text + MASK.format(psd=8.5e-12, more=""), check=False)
    (failure,) = exceeded(bench, made_snapshot(n_effective=5000.0), SETTINGS)
    assert str(failure).startswith("C.Z does not meet 'data sheet': three-sensor −110.")
    assert failure.noise_psd == pytest.approx(9e-12, rel=0.05)
