"""The text of a Textual screen, out of the picture it exports of itself."""

from __future__ import annotations

import html
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from textual.app import App
    from textual.pilot import Pilot

FOLDER = Path(__file__).parent / "pictures"
_TEXT = re.compile(
    r'<text class="[^"]*-r\d+" x="([\d.]+)" y="[\d.]+" textLength="[\d.]+" '
    r'clip-path="url\(#[^"]*-line-(\d+)\)">(.*?)</text>'
)
TURNS = 20
_CELL = 12.2  # width of a character in the picture


def screen_text(app: App[None]) -> str:
    """Return what is on the screen, line by line, without colours."""
    lines: dict[int, str] = {}
    for x, number, text in _TEXT.findall(app.export_screenshot()):
        line = lines.get(int(number), "").ljust(round(float(x) / _CELL))
        lines[int(number)] = line + html.unescape(text).replace("\xa0", " ")
    return "\n".join(lines.get(n, "").rstrip() for n in range(max(lines, default=-1) + 1)) + "\n"


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
