"""Characters of the screen as ASCII, one for one, for terminals whose locale is not UTF-8."""

from __future__ import annotations

from collections.abc import Mapping

BRAILLE = 0x2800
UPPER, LOWER = 0b00011011, 0b11100100
"""Dots of the upper and of the lower half of a Braille character."""
FULL = 6
"""Dots from which on a character is drawn full."""
ONE_FOR_ONE = (
    ("●•■▪", "*"),
    ("○◦", "o"),
    ("▲▴", "!"),
    ("▾▼", "v"),
    ("×✗", "x"),
    ("✓√", "v"),
    ("━─╌╍┄┅═⠒", "-"),
    ("┃│┆┇║▏▎▍▕", "|"),
    ("┳┻┣┫╋┼├┤┬┴╭╮╯╰┌┐└┘╔╗╚╝", "+"),
    ("█▇▆▅▄▃▂▁▀▐▌▊▉▋▔", "#"),
    ("░▒▓", "."),
    ("←‹", "<"),
    ("→›", ">"),
    ("↑", "^"),
    ("↓", "v"),
    ("−–—", "-"),
    ("…", "~"),
    ("·", "."),
    ("°", "d"),
    ("µμ", "u"),
    ("²", "2"),
    ("³", "3"),
    ("±", "+"),
    ("≤", "<"),
    ("≥", ">"),
    ("ü", "u"),
    ("\xa0", " "),
)


def _table() -> dict[int, str]:
    table = {ord(one): plain for many, plain in ONE_FOR_ONE for one in many}
    for dots in range(1, 256):
        if BRAILLE + dots in table:
            continue
        upper, lower = bool(dots & UPPER), bool(dots & LOWER)
        full = dots.bit_count() >= FULL
        table[BRAILLE + dots] = "#" if full else ":" if upper and lower else "'" if upper else "."
    table[BRAILLE] = " "
    return table


TABLE = _table()


def ascii_text(text: str) -> str:
    """Return a text with one ASCII character for each of its characters."""
    if text.isascii():
        return text
    return text.translate(TABLE).encode("ascii", "replace").decode("ascii")


def is_ascii_only(environment: Mapping[str, str]) -> bool:
    """Return whether the locale says that the terminal does not understand UTF-8.

    Without any locale, as in many containers, it is taken to understand it. Python itself sets
    ``LC_CTYPE`` to ``C.UTF-8`` where ``LANG`` is ``C``.
    """
    named = environment.get("LC_ALL", "")
    if not named:
        named, language = environment.get("LC_CTYPE", ""), environment.get("LANG", "")
        if not named or (named == "C.UTF-8" and language):
            named = language
    return bool(named) and "utf8" not in named.lower().replace("-", "")
