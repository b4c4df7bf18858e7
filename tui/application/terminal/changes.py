"""What a slow terminal has to be sent: only cells that changed, the least changes first.

Theory of operation: what Textual writes goes into a picture of the screen, cell by cell, and not to
the terminal. Whenever the line has room, the rows that differ from what the terminal shows are
sent, shortest first, as many as fit. So nothing queues: however much is drawn, the terminal is
behind by what changed last, and the answer to a key, one short row, is there before the curves.
Colours are reduced to eight and backgrounds left out, for they are most of the bytes.

Understood are the sequences that Textual writes into its frames: positions (CSI H), styles
(CSI m), ends of lines (CSI K), line feeds and text. All others, such as those that choose modes, go
to the terminal as they are.
"""

from __future__ import annotations

import re

from rich.cells import cell_len

_TOKEN = re.compile(
    r"\x1b\[(?P<parameters>[0-9;:<=>?]*)(?P<middle>[ -/]*)(?P<final>[@-~])"
    r"|(?P<link>\x1b\]8;[^\x07\x1b]*(?:\x07|\x1b\\))"
    r"|(?P<other>\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)|\x1b[^\[\]]|[\x00-\x09\x0b-\x1a\x1c-\x1f])"
    r"|(?P<line_feed>\n)|(?P<text>[^\x00-\x1f\x1b]+)"
)
_FRAME = {"?2026h", "?2026l"}
"""Begin and end of a frame; what is sent has no frames."""
_NEW_SCREEN = {"?1049h", "?1049l"}
Cell = tuple[str, str]
"""Character and style; an empty character is the second half of a wide one."""
BLANK: Cell = (" ", "")
JUMP = 8
"""Equal cells from which on it is shorter to set the cursor behind them."""
_ATTRIBUTES = {"1", "2", "4", "7"}
MIN_SATURATION = 0.25
"""Saturation from which on a colour is sent."""
MIN_COMPONENT = 0.66
"""Share of the strongest of red, green and blue from which on another one counts."""


class ScreenChanges:
    """The screen as it should be, and as the terminal shows it.

    Parameters
    ----------
    width, height : int
        In cells.
    """

    def __init__(self, width: int, height: int) -> None:
        self._x = self._y = 0
        self._style = ""
        self._styles: dict[str, str] = {}
        self.resize(width, height)

    def resize(self, width: int, height: int) -> None:
        """Begin again with another size, and an empty screen."""
        self._width, self._height = width, height
        self._wanted = [[BLANK] * width for _ in range(height)]
        self._sent = [[BLANK] * width for _ in range(height)]
        self._changed: set[int] = set()

    def feed(self, text: str) -> str:
        """Take what Textual writes; return what must go to the terminal at once."""
        passed = []
        for token in _TOKEN.finditer(text):
            if (written := token["text"]) is not None:
                self._write(written)
            elif token["line_feed"]:
                self._x, self._y = 0, self._y + 1
            elif token["other"]:
                passed.append(token["other"])
            elif token["final"] is not None:
                passed.append(self._control(token))
        return "".join(passed)

    def _control(self, token: re.Match[str]) -> str:
        parameters, final = token["parameters"], token["final"]
        if final == "m" and not parameters.startswith((">", "<", "?")):
            self._style = self._reduced(parameters)
            return ""
        if final == "H":
            y, _, x = parameters.partition(";")
            self._x, self._y = int(x or 1) - 1, int(y or 1) - 1
            return ""
        if final == "K" and 0 <= self._y < self._height:
            blanks = max(0, self._width - self._x)
            self._wanted[self._y][self._x :] = [BLANK] * blanks
            self._changed.add(self._y)
            return ""
        if parameters + final in _FRAME:
            return ""
        if parameters + final in _NEW_SCREEN or (final == "J" and parameters == "2"):
            self.resize(self._width, self._height)
        return token[0]

    def _write(self, text: str) -> None:
        if not 0 <= self._y < self._height:
            return
        row = self._wanted[self._y]
        for character in text:
            width = 1 if character.isascii() else cell_len(character)
            if self._x + width > self._width:
                break
            if not width:
                continue
            if not row[self._x][0]:  # the second half of a wide one: its first half goes
                row[self._x - 1] = BLANK
            row[self._x] = character, self._style
            if width > 1:
                row[self._x + 1] = "", self._style
            self._x += width
            if self._x < self._width and not row[self._x][0]:
                row[self._x] = BLANK
        self._changed.add(self._y)

    def _reduced(self, codes: str) -> str:
        """Return a style without background, its colour one of eight."""
        if codes not in self._styles:
            self._styles[codes] = _reduced(codes.split(";"))
        return self._styles[codes]

    @property
    def rows(self) -> list[str]:
        """The rows as they should be, without styles."""
        return ["".join(character for character, _ in row) for row in self._wanted]

    def take(self, room: int) -> str:
        """Return the rows to send, the shortest first: at most `room` bytes, but at least one row.

        They count as sent.
        """
        rows = []
        for y in sorted(self._changed):
            row = self._row(y)
            if row:
                rows.append((len(row.encode()), y, row))
            else:
                self._changed.discard(y)
        taken: list[str] = []
        for n_bytes, y, row in sorted(rows):
            if taken and n_bytes > room:
                break
            taken.append(row)
            room -= n_bytes
            self._sent[y] = list(self._wanted[y])
            self._changed.discard(y)
        return "".join(taken)

    def _row(self, y: int) -> str:
        """Return what turns a row as sent into the row as wanted."""
        wanted, sent = self._wanted[y], self._sent[y]
        end = self._width
        while end and wanted[end - 1] == BLANK:
            end -= 1
        parts, style, x = [], "", 0
        at = -1  # where the terminal's cursor is
        while x < end:
            if wanted[x] == sent[x] or not wanted[x][0]:
                x += 1
                continue
            if at >= 0 and x - at < JUMP and all(cell[1] == style for cell in wanted[at:x]):
                parts.append("".join(character for character, _ in wanted[at:x]))
            elif at != x:
                parts.append(f"\x1b[{y + 1};{x + 1}H")
            character, new = wanted[x]
            if new != style:
                parts.append(f"\x1b[0{new and ';' + new}m")
                style = new
            parts.append(character)
            at = x + max(1, cell_len(character))
            x = at
        if any(cell != BLANK for cell in sent[end:]):
            parts.append(f"\x1b[{y + 1};{end + 1}H" if at != end else "")
            parts.append("\x1b[0m\x1b[K" if style else "\x1b[K")
            style = ""
        return "".join(parts) + ("\x1b[0m" if style else "")


def _reduced(codes: list[str]) -> str:
    kept, n = [], 0
    while n < len(codes):
        code = codes[n]
        if code in {"38", "48"}:
            kind = codes[n + 1] if n + 1 < len(codes) else ""
            values = codes[n + 2 : n + (5 if kind == "2" else 3)]
            if code == "38" and kind == "2" and len(values) == 3:
                kept += _colour(*map(int, values))
            n += 5 if kind == "2" else 3
            continue
        if code in {"", "0"}:
            kept = []
        elif code in _ATTRIBUTES or (code.isdigit() and 30 <= int(code) <= 37):
            kept.append(code)
        elif code.isdigit() and 91 <= int(code) <= 96:
            kept.append(str(int(code) - 60))
        n += 1
    return ";".join(kept)


def _colour(red: int, green: int, blue: int) -> list[str]:
    """Return the code of the nearest of eight colours; none for greys."""
    most, least = max(red, green, blue), min(red, green, blue)
    if most - least < MIN_SATURATION * max(most, 1):
        return []
    bits = (value > MIN_COMPONENT * most for value in (red, green, blue))
    return [str(30 + sum(bit << n for n, bit in enumerate(bits)))]
