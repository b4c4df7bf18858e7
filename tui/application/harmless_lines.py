"""Lines of the screen without control characters that names, events or paths bring along."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.segment import Segment
from textual.filter import LineFilter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from textual.color import Color

_CONTROLS = dict.fromkeys((*range(32), *range(127, 160)))


class HarmlessLines(LineFilter):
    """Removes control characters, which terminals obey and which take no cell of the screen.

    Parameters
    ----------
    filters : sequence of LineFilter
        What each line goes through afterwards; Textual makes a new line for each filter of its own.
    """

    def __init__(self, filters: Sequence[LineFilter]) -> None:
        super().__init__()
        self._filters = filters

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        """Return the segments without them."""
        segments = [
            segment
            if segment.control or segment.text.isprintable()
            else Segment(segment.text.translate(_CONTROLS), segment.style)
            for segment in segments
        ]
        for each in self._filters:
            segments = each.apply(segments, background)
        return segments
