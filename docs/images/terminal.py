"""Pictures of the application, for the README and for the gallery that the site has."""

from __future__ import annotations

import html
import re
from pathlib import Path

from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from tui.application.app import HuddleApp
from tui.commands.tui_controls import RecordingControls

BRAILLE = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (0, 3), (1, 3))
METHODS = ("three-sensor", "three-channel")
_TEXT = re.compile(
    r'<text class="([^"]*)" x="([\d.]+)" y="([\d.]+)" textLength="[\d.]+" '
    r'clip-path="[^"]*">(.*?)</text>'
)
_WEB_FONT = re.compile(r"@font-face \{.*?\}\s*", re.DOTALL)
CELL, LINE = 12.2, 24.4  # of a character in the picture


def placed(run: re.Match[str]) -> str:
    """Put every character of a run of text into its own cell, and draw Braille as dots."""
    name, x, y = run[1], float(run[2]), float(run[3])
    parts = []
    for column, character in enumerate(html.unescape(run[4])):
        left = x + column * CELL
        dots = ord(character) - 0x2800
        if 0 < dots < 256:
            for bit, (across, down) in enumerate(BRAILLE):
                if dots >> bit & 1:
                    cx, cy = left + CELL * (across + 0.5) / 2, y - 18.6 + LINE * (down + 0.5) / 4
                    parts.append(f'<circle class="{name}" cx="{cx:.1f}" cy="{cy:.1f}" r="1.9"/>')
        elif character.strip("\xa0 "):
            text = html.escape(character)
            parts.append(f'<text class="{name}" x="{left:.1f}" y="{y}">{text}</text>')
    return "".join(parts)


async def photograph(recording: Path, *, size: tuple[int, int], keys: tuple[str, ...]) -> str:
    """Return a picture (SVG) of the application on a recording of a bench, after some keys."""
    settings = Settings(segment=2.0, methods=METHODS, band=(2.0, 20.0), target_cov=0.15)
    with Recording.open(recording) as opened:
        bench = opened.bench
    app = HuddleApp(RecordingControls(recording, settings, bench), path=recording)
    async with app.run_test(size=size) as pilot:
        while app.state.snapshot is None:
            await pilot.pause(0.1)
        await pilot.press(*keys)
        await pilot.pause(0.5)
        picture = app.export_screenshot(title="huddle")
    plain = _WEB_FONT.sub("", picture).replace("Fira Code", "DejaVu Sans Mono")
    return _TEXT.sub(placed, plain)
