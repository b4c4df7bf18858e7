"""Lines of the screen without control characters that names, events or paths bring along."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.segment import Segment
from textual.filter import LineFilter

if TYPE_CHECKING:
    from textual.color import Color

_CONTROLS = dict.fromkeys((*range(32), *range(127, 160)))


class HarmlessLines(LineFilter):
    """Removes control characters, which terminals obey and which take no cell of the screen."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:  # noqa: ARG002 -- of the seam
        """Return the segments without them."""
        return [
            segment
            if segment.control or segment.text.isprintable()
            else Segment(segment.text.translate(_CONTROLS), segment.style)
            for segment in segments
        ]
