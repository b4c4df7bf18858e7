"""The plot of the Test view, and the colours of all: cursor, zoom, freezing, table, themes."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from rich.segment import Segment
from rich.style import Style
from textual.color import Color
from textual.widgets import Static

from daq.bench.masks.mask import NOISE_MODELS
from daq.bench.masks.mask_file import masks_named
from daq.bench.model import Limit
from daq.estimation.noise_estimates import ALL_METHODS
from daq.results.band_summary import BandMeans
from daq.results.result import Result
from estimator.types import FloatArray
from tests.tui.application.screen_text import assert_looks_as_before, screen_text
from tests.tui.application.test_app import NARROW, WIDE, opened, pressed, running, shown, view
from tests.tui.example_snapshot import SETTINGS, ProgressCallback, demo_bench, made_snapshot
from tui.application.app import HuddleApp
from tui.application.state import State
from tui.application.test_view.braille import cells, joined
from tui.application.test_view.curves import level_limits, noise_curve
from tui.application.test_view.plot import LevelAxis
from tui.application.test_view.plotted import (
    STYLES,
    Choice,
    curves,
    moved,
    panned,
    reading,
    whole_span,
    zoomed,
)
from tui.application.test_view.units import GRAVITY, SpectrumUnit, units_of
from tui.application.themes import COLOUR_BLIND, NO_COLOUR, SAFE, THEMES


def test_units_agree_with_their_definitions() -> None:
    level = -120.0  # dB re 1 (m/s²)²/Hz
    by_name = {unit.name: unit for unit in units_of("m/s²")}
    assert by_name["(m/s²)²/Hz"].value(level) == pytest.approx(1e-12)
    assert by_name["g²/Hz"].value(level) == pytest.approx(1e-12 / GRAVITY**2)
    assert by_name["ng/√Hz"].value(level) == pytest.approx(1e-6 / GRAVITY * 1e9)
    assert [unit.name for unit in units_of("m/s")][2:] == ["m/s/√Hz"]


def test_upper_bounds_are_within_the_plot_and_no_levels() -> None:
    mean, high = np.full(3, 1e-9), np.full(3, 2e-9)
    means = BandMeans(mean, mean, -mean, high, is_bound=np.ones(3, dtype=bool))
    curve = noise_curve(
        *(np.arange(1.0, 6.0), means),
        edges=np.arange(4),
        label="multi-part",
        style=("", "", ""),
    )
    assert np.isnan(curve.level_db).all()
    low, highest = level_limits([curve])
    assert low < 10 * np.log10(2e-9) < highest
    assert reading(curve, 1, units_of("m/s²")[0]).startswith("below ")


@pytest.mark.parametrize("unit", units_of("m/s²"), ids=lambda unit: unit.name)
@pytest.mark.parametrize("span", [(-130.0, -80.0), (-121.0, -119.0), (-200.0, 20.0)])
def test_ticks_are_round_few_and_within(unit: SpectrumUnit, span: tuple[float, float]) -> None:
    ticks = unit.ticks(*span)
    assert len(ticks) <= 8
    assert all(span[0] <= tick <= span[1] for tick in ticks)
    assert len(set(unit.labels(ticks))) == len(ticks)
    for tick in ticks:
        digits = f"{abs(unit.value(tick)):.6e}"
        assert unit.is_db or digits[:3] in {"1.0", "2.0", "3.0", "5.0"}


def test_labels_of_a_low_plot_are_on_rows_of_their_own() -> None:
    """Seven rows beside a table of channels had nine labels: "−−95 dB"."""
    axis = LevelAxis()
    axis.rows = 6
    assert axis.get_ticks(-120.0, -80.0) == [-120.0, -110.0, -100.0, -90.0, -80.0]


def test_zoom_pan_and_cursor_stay_within_the_spectrum() -> None:
    snapshot = made_snapshot()
    first, last = whole_span(snapshot)
    choice = moved(Choice(), snapshot, 0.0)
    assert choice.cursor == pytest.approx((first + last) / 2)
    near = zoomed(choice, snapshot, 0.25)
    assert near.span is not None
    assert near.span[1] - near.span[0] == pytest.approx((last - first) / 4)
    for _ in range(20):
        near = panned(near, snapshot, 0.5)
    assert near.span is not None
    assert near.span[1] == pytest.approx(last)
    assert near.cursor is not None
    assert near.span[0] <= near.cursor <= near.span[1]
    for _ in range(20):
        near = zoomed(near, snapshot, 0.5)
    assert near.span is not None
    assert near.span[1] - near.span[0] >= 0.02  # ends somewhere
    assert zoomed(near, snapshot, 1e6).span is None  # all of it


def test_lines_are_dots_in_the_cells_that_they_cross() -> None:
    x, y = joined(np.array([0.0, 7.0, 7.0]), np.array([0.0, 7.0, -3.0]))
    found = {(column, row): character for column, row, character in cells(x, y, 3, 2)}
    assert found == {(0, 0): "⠑", (1, 0): "⢄", (2, 1): "⠑"}  # what is outside is left out


async def test_keys_move_the_cursor_and_change_the_unit(told: ProgressCallback) -> None:
    async with opened(told, *running(), size=WIDE) as (app, pilot):
        await pressed(pilot, app, "full_stop", "full_stop", "plus", "u", "u", "u")
        title = str(app.screen.query_one("#title", Static).render())
        choice = view(app).choice
        assert choice.cursor is not None
        assert title.startswith(f"{10**choice.cursor:.3g} Hz  A.X")
        noise = 1e-12 / GRAVITY**2  # of A.X, in g²/Hz
        shown_noise = float(title.split("three-sensor ")[1].split(maxsplit=1)[0])
        assert shown_noise == pytest.approx(1e9 * math.sqrt(noise), rel=0.3)  # 100 averages
        await pressed(pilot, app, "escape")
        assert "ng/√Hz" in screen_text(app)
        assert view(app).choice.span is None
        text = await pressed(pilot, app, "space", "right", "space", "down")
        assert "A.X, A.Y, B.Y   noise in ng/√Hz" in text
        names = ("A.X", "A.Y", "B.Y")
        assert all(f"{m}  {name}" in text for m, name in zip("●×◆", names, strict=True))
        await pressed(pilot, app, "l")
        assert "A.X, A.Y, B.Y, C.Y   noise" in screen_text(app)
        await pressed(pilot, app, "l", "escape")
        assert "B Y   power spectral density in ng/√Hz" in screen_text(app)


async def test_frozen_curves_stay_while_the_test_goes_on(told: ProgressCallback) -> None:
    async with opened(told, *running()) as (app, pilot):
        await pressed(pilot, app, "f")
        assert "c.o.v. 46 %" in screen_text(app)
        curves = screen_text(app).splitlines()[2:15]
        await shown(pilot, app, *running(n_effective=5000.0))
        text = screen_text(app)
        assert "frozen at 1:40" in text
        assert "c.o.v. 6.4 %" in text
        assert text.splitlines()[2:15] == curves
        await pressed(pilot, app, "f")
        assert "frozen" not in screen_text(app)
        assert screen_text(app).splitlines()[2:15] != curves


@pytest.mark.parametrize(("name", "size"), [("narrow", NARROW), ("wide", WIDE)])
async def test_pictures(told: ProgressCallback, name: str, size: tuple[int, int]) -> None:
    async with opened(told, *running(), size=size) as (app, pilot):
        await pressed(pilot, app, "full_stop", "plus", "u", "t")
        await assert_looks_as_before(pilot, f"{name}-test-cursor")
        await pressed(pilot, app, "escape", "l", "u", "u", "u", "e")
        await assert_looks_as_before(pilot, f"{name}-test-like")


def test_limits_and_noise_models_are_curves() -> None:
    bench = demo_bench(
        Limit(name="as the site", model="ahnm"),
        Limit(name="sheet", frequency=(1.0, 30.0), psd=(0.5, 0.5), unit="µg/√Hz"),
    )
    result = Result(made_snapshot(), SETTINGS, bench)
    state = State("b", result=result, models=masks_named("nhnm"))
    shown = {each.label: each for each in curves(state, Choice(), n_points=60)}
    for label, model in (("as the site", "ahnm"), ("NHNM", "nhnm")):
        curve = shown[label]
        at = 10**curve.log_frequency
        expected = 10 * np.log10(NOISE_MODELS[model].at(at, "m/s²"))
        known = np.isfinite(expected) & np.isfinite(curve.level_db)
        assert known.sum() > 10
        # straight between the frequencies of the spectrum, the lowest of which are an octave apart
        np.testing.assert_allclose(curve.level_db[known], expected[known], atol=1.5)
        np.testing.assert_allclose(
            curve.level_db[known][at[known] > 5], expected[known][at[known] > 5], atol=0.1
        )
    level = shown["sheet"].level_db
    assert np.nanmax(np.abs(level - 20 * np.log10(0.5 * 9.80665e-6))) < 1e-9


@pytest.mark.parametrize("size", [NARROW, (200, 60)])
async def test_estimates_are_steps_with_whiskers_and_bins_by_a_key(
    told: ProgressCallback, size: tuple[int, int]
) -> None:
    async with opened(told, *running(n_effective=500), size=size) as (app, pilot):
        state, choice = app.state, app.screen.choice  # type: ignore[attr-defined]
        for is_fine in (False, True):
            found = curves(state, replace(choice, bins=is_fine), n_points=size[0] - 12)
            noise = next(each for each in found if each.label == "three-sensor")
            assert noise.is_stepped is not is_fine
            octaves = np.ptp(noise.log_frequency) / np.log10(2)
            assert (len(noise.log_frequency) <= 1 + 3.5 * octaves) is not is_fine
        steps = next(e for e in curves(state, choice, n_points=size[0] - 12) if e.is_stepped)
        line, levels = steps.line
        assert len(line) == 2 * len(steps.level_db)
        assert (np.diff(levels)[::2] == 0).all()  # flat from edge to edge
        zoomed = curves(state, replace(choice, span=(0.9, 1.2)), n_points=size[0] - 12)
        fine = next(each for each in zoomed if each.is_stepped)
        assert len(fine.log_frequency) >= 2 * len(steps.log_frequency)  # twelfths where they fit
        before = screen_text(app)
        await pressed(pilot, app, "b")
        assert screen_text(app) != before
        await pressed(pilot, app, "b")
        assert screen_text(app) == before


async def test_limits_are_drawn_apart_and_named_on_their_lines(told: ProgressCallback) -> None:
    limits = tuple(
        Limit(name=name, frequency=(1.0, 50.0), psd=(psd, psd))
        for name, psd in (("data sheet", 7e-12), ("order 17", 7e-12))
    )
    told.bench = demo_bench(*limits)
    for size in (NARROW, (200, 60)):
        async with opened(told, *running(), size=size) as (app, _pilot):
            found = curves(app.state, Choice(methods=("three-sensor",)), n_points=60)
            drawn = [each for each in found if each.name]
            assert [each.name for each in drawn] == ["data sheet", "order 17"]
            assert len({each.style for each in drawn}) == len({each.marker for each in drawn}) == 2
            rows = [row for row in screen_text(app).splitlines() if "┃" in row or "┫" in row]
            named = {name: sum(name in row for row in rows) for name in ("data sheet", "order 17")}
            assert named == {"data sheet": 2, "order 17": 2}  # on its line, and in the legend


# --- colour themes ---------------------------------------------------------------------------


# Machado, Oliveira, Fernandes (2009), severity 1: linear RGB as colour-blind eyes see it.
SEEN = {
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
}
XYZ = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)  # of linear sRGB
CLEAR = 20.0
"""Difference of two colours in CIE L*a*b* that nobody takes for one another at a glance."""


def lab(colour: str, seen: list[list[float]]) -> FloatArray:
    """Return a colour in CIE L*a*b*, as eyes of a kind see it."""
    part = np.array([int(colour[n : n + 2], 16) for n in (1, 3, 5)]) / 255
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    xyz = XYZ @ np.clip(np.array(seen) @ linear, 0, 1) / XYZ.sum(axis=1)
    root = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * root[1] - 16, *(500, 200) * (root[:2] - root[1:])])


def nearest(colours: list[str], seen: list[list[float]]) -> float:
    """Return the least difference between two of some colours."""
    return min(
        float(np.linalg.norm(lab(one, seen) - lab(other, seen)))
        for one, other in itertools.combinations(colours, 2)
    )


def test_every_method_has_a_style_in_all_themes() -> None:
    assert set(STYLES) == set(ALL_METHODS)
    assert {colour for *colours, _ in STYLES.values() for colour in colours} <= set(SAFE)
    assert len({marker for _, _, marker in STYLES.values()}) == len(STYLES)


@pytest.mark.parametrize("eyes", SEEN)
def test_colour_blind_eyes_tell_states_and_curves_apart(eyes: str) -> None:
    states = [SAFE[name] for name in ("green", "yellow", "#ff6b6b")]
    curves = [SAFE[colour] for colour, _, _ in STYLES.values()]
    limit = SAFE["#ff6b6b"]
    assert nearest(states, SEEN[eyes]) > CLEAR
    assert nearest([*curves, limit], SEEN[eyes]) > CLEAR


async def test_themes_change_colours_and_nothing_else(tmp_path: Path) -> None:
    async with opened(ProgressCallback(tmp_path / "run.h5")) as (
        app,
        pilot,
    ):
        await shown(pilot, app, *running())
        assert set(app.available_themes) == set(THEMES)
        said, drawn = set(), {}
        for theme in THEMES:
            app.theme = theme
            await shown(pilot, app)
            said.add(screen_text(app))
            drawn[theme] = set(re.findall(r"fill: (#[0-9a-f]{6})", app.export_screenshot()))
    assert len(said) == 1
    green = "#98e024"  # as Textual draws it
    assert drawn["huddle"] >= {"#4cc9f0", "#f4a261", "#ff6b6b", green}
    assert not {*SAFE, green} & drawn[COLOUR_BLIND]
    assert {SAFE[colour] for colour in ("#4cc9f0", "#ff6b6b")} <= drawn[COLOUR_BLIND]
    frame = "#c5c8c6"  # of the picture
    assert {c for c in drawn[NO_COLOUR] - {frame} if len({c[1:3], c[3:5], c[5:]}) > 1} == set()


def test_a_terminal_of_16_colours_shows_its_own_red_and_yellow(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """FAIL was magenta there, and NOT DECIDED red: the nearest of 16 to the theme's colours."""
    drawn = [Segment("NOT DECIDED", Style(color="yellow"))]
    seen = []
    for system in ("truecolor", "standard"):
        monkeypatch.setattr(Console, "color_system", system)
        (lines,) = HuddleApp(ProgressCallback(tmp_path / "run.h5")).get_line_filters()
        (segment,) = lines.apply(drawn, Color(0, 0, 0))
        seen.append(segment.style == drawn[0].style)
    assert seen == [False, True]
