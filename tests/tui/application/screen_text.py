"""The text of a Textual screen, as it exports a picture of itself."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any
from unittest.mock import patch

from rich.console import Console
from textual.app import App
from textual.pilot import Pilot

FOLDER = Path(__file__).parent / "pictures"
TURNS = 100


def screen_text(app: App[Any]) -> str:
    """Return what is on the screen, line by line, without colours."""
    # As text and not as SVG, which takes most of the time of a picture.
    with patch.object(Console, "export_svg", lambda console, **_: console.export_text()):
        lines = app.export_screenshot().replace("\xa0", " ").rstrip().splitlines()
    return "\n".join(line.rstrip() for line in lines) + "\n"


AT_REST = 4
"""Turns in which a screen at rest does not change."""


async def assert_looks_as_before(pilot: Pilot[Any], name: str) -> None:
    """Compare the screen with the picture kept of it; HUDDLE_NEW_PICTURES=1 keeps a new one.

    On a busy machine a layout may still be on its way: the screen has some turns to come to rest.
    """
    kept = FOLDER / f"{name}.txt"
    if os.environ.get("HUDDLE_NEW_PICTURES"):
        FOLDER.mkdir(exist_ok=True)
        kept.write_text(screen_text(pilot.app), encoding="utf-8")
    expected = kept.read_text(encoding="utf-8")
    for _ in range(TURNS):
        if screen_text(pilot.app) == expected:
            return
        await pilot.pause()
    assert screen_text(pilot.app) == expected


async def resized(pilot: Pilot[Any], size: tuple[int, int]) -> None:
    """Resize the terminal, and wait until the screen has that size and comes to rest.

    On a busy machine the new layout comes some turns later.
    """
    await pilot.resize_terminal(*size)
    before, still = "", 0
    for _ in range(TURNS):
        await pilot.pause()
        now = screen_text(pilot.app)
        still = still + 1 if now == before and pilot.app.screen.size == size else 0
        if still == AT_REST:
            return
        before = now
    raise AssertionError(f"the screen of {pilot.app.screen.size} does not come to rest at {size}")
