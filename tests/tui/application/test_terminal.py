"""Slow lines and terminals without Unicode: what they are sent."""

from __future__ import annotations

import numpy as np
import pytest

from tui.application.terminal.ascii_text import ascii_text, is_ascii_only
from tui.application.terminal.changes import ScreenChanges

STYLES = ("", "1;38;2;255;107;107;48;2;16;20;28", "38;2;76;201;240", "7")
WORDS = ("curve", "⣿⠒⠉⣀", "−118.1±1.2", "漢字", " " * 9, "A X")


def frame(rng: np.random.Generator) -> str:
    """Return some changes as Textual writes them."""
    parts = ["\x1b[?2026h"]
    for _ in range(rng.integers(1, 9)):
        style = STYLES[rng.integers(len(STYLES))]
        text = "".join(rng.choice(WORDS, rng.integers(1, 4)))
        parts.append(f"\x1b[{rng.integers(1, 11)};{rng.integers(1, 41)}H")
        parts.append(f"\x1b[{style}m{text}\x1b[0m" if style else text)
    return "".join((*parts, "\n", "\x1b[?2026l"))


def test_the_terminal_comes_to_show_what_was_drawn_with_the_least_changes_first() -> None:
    rng = np.random.default_rng(5)
    drawn, terminal = ScreenChanges(40, 10), ScreenChanges(40, 10)
    n_drawn = n_sent = 0
    for n in range(200):
        text = frame(rng)
        n_drawn += len(text.encode())
        assert drawn.feed(text) == ""
        sent = drawn.take(30)
        n_sent += len(sent.encode())
        assert terminal.feed(sent) == ""
        if n % 20 == 19:  # time to catch up
            while sent := drawn.take(30):
                terminal.feed(sent)
            assert terminal.rows == drawn.rows
    assert n_sent < n_drawn / 2
    drawn.feed("\x1b[2;1H" + "long " * 7 + "\x1b[9;1Hkey")
    assert "key" in drawn.take(10)
    assert drawn.take(10**6)
    assert drawn.take(10**6) == ""  # nothing changed: nothing is sent


def test_modes_bells_and_links_are_passed_and_colours_reduced() -> None:
    screen = ScreenChanges(20, 3)
    assert screen.feed("\x1b[?1049h\x1b[?1000h\x07\x1b[>9u") == "\x1b[?1049h\x1b[?1000h\x07\x1b[>9u"
    screen.feed(
        "\x1b[1;1H\x1b[1;38;2;255;90;90;48;2;9;9;9mno\x1b[0m \x1b[38;2;99;99;99mgrey\x1b[0m"
    )
    screen.feed("\x1b]8;id=1;file:///a\x1b\\link\x1b]8;;\x1b\\")
    assert screen.rows[0].rstrip() == "no greylink"
    assert screen.take(99) == "\x1b[1;1H\x1b[0;1;31mno\x1b[1;4H\x1b[0mgreylink"
    screen.feed("\x1b[?1049l")
    assert screen.take(99) == ""  # nothing is drawn on the screen behind


def test_ascii_has_the_width_of_what_it_stands_for() -> None:
    text = "● live  ▲ clipping ━━╌╌ ⣿⠒⠉⣀⠀ −118.1±1.2 (m/s²)²/Hz … § ┳┻"
    plain = ascii_text(text)
    assert plain == "* live  ! clipping ---- #-'.  -118.1+1.2 (m/s2)2/Hz ~ ? ++"
    assert len(plain) == len(text)


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, False),
        ({"LANG": "de_DE.UTF-8"}, False),
        ({"LC_CTYPE": "C.UTF-8"}, False),
        ({"LC_CTYPE": "C.UTF-8", "LANG": "C"}, True),  # Python's own doing
        ({"LANG": "de_DE.ISO-8859-1"}, True),
        ({"LC_ALL": "C", "LANG": "de_DE.UTF-8"}, True),
        ({"LC_ALL": "C.utf8"}, False),
    ],
)
def test_the_locale_decides_for_ascii(environment: dict[str, str], *, expected: bool) -> None:
    assert is_ascii_only(environment) == expected
