"""Where texts and tables are printed: names of sensors and files act on nothing."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import rich.table
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from tui.output.exit_codes import ExitCode
from tui.page.table import SHOWN_CONTROLS, WIDTH_OF_TABLES, Cell, Table
from tui.page.terminal import styled, terminal_table


class PlainConsole(Console):
    """A console on which no text acts: control characters in names or files are shown as such.

    Files and pipes get a row of a table, and a paragraph, on one line each.
    """

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: ANN401 - the library's own
        """Print texts and tables; unbroken where no terminal shows them."""
        shown = [styled(one) if isinstance(one, Cell) else one for one in objects]
        shown = [terminal_table(one) if isinstance(one, Table) else one for one in shown]
        if self.is_terminal:
            super().print(*shown, **options)
            return
        usual = self.width
        if any(isinstance(each, rich.table.Table) for each in shown):
            self.width = WIDTH_OF_TABLES
        else:
            options.setdefault("soft_wrap", True)
        super().print(*shown, **options)
        self.width = usual

    def on_broken_pipe(self) -> None:
        """End quietly, not as a limit that is not met."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())
        raise SystemExit(ExitCode.CLOSED_PIPE)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Yield segments, with control characters only where Rich has put them."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text == "\n" or segment.text.isprintable():
                yield segment
            else:
                yield Segment(segment.text.translate(SHOWN_CONTROLS), segment.style)
