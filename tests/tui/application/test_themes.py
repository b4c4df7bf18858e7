"""Colour themes: what is drawn in them, and whether colour-blind eyes tell their colours apart."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from rich.segment import Segment
from rich.style import Style
from textual.color import Color

from daq.estimation.noise_estimates import ALL_METHODS
from estimator.types import FloatArray
from tests.tui.application.screen_text import screen_text
from tests.tui.application.test_app import opened, running, shown
from tests.tui.example_snapshot import ProgressCallback
from tui.application.app import HuddleApp
from tui.application.test_view.plotted import STYLES
from tui.application.themes import COLOUR_BLIND, NO_COLOUR, SAFE, THEMES

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
