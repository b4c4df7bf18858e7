"""The text of a Textual screen, as it exports a picture of itself."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

from rich.console import Console

if TYPE_CHECKING:
    from textual.app import App
    from textual.pilot import Pilot

FOLDER = Path(__file__).parent / "pictures"
TURNS = 20


def screen_text(app: App[None]) -> str:
    """Return what is on the screen, line by line, without colours."""
    # As text and not as SVG, which takes most of the time of a picture.
    with patch.object(Console, "export_svg", lambda console, **_: console.export_text()):
        lines = app.export_screenshot().replace("\xa0", " ").rstrip().splitlines()
    return "\n".join(line.rstrip() for line in lines) + "\n"


async def assert_looks_as_before(pilot: Pilot[None], name: str) -> None:
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
