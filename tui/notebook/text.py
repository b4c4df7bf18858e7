"""Results as text: what a notebook shows of them."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import TYPE_CHECKING

from rich.console import Console, RenderableType
from rich.text import Text

from estimator.errors import BandError
from tui.output.results import averages_line, result_table, result_title
from tui.page import html as page
from tui.page.blocks import Paragraph, Part
from tui.page.table import Table
from tui.page.terminal import styled, terminal_table
from tui.wording.verdict_text import Decision, facts_below

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.results.result import Result

_WIDTH = 100


def text(result: Result) -> str:
    """Return the table that ``huddle estimate`` prints, and where the advice is."""
    try:
        parts: list[RenderableType | Table] = [
            *(Text(line) for line in _decision(result)),
            styled(result_title(result)),
            Text(averages_line(result.snapshot)),
            result_table(result),
        ]
    except BandError as error:
        return rendered([Text(f"Self-noise: {error}"), Text(averages_line(result.snapshot))])
    parts += map(Text, facts_below(result, "print(*result.facts, sep='\\n')"))
    return rendered(parts)


def _decision(result: Result) -> list[str]:
    """Return the first line of a test with limits."""
    return [] if (decision := Decision.of(result)) is None else [str(decision)]


def html(result: Result) -> str:
    """Return the table that ``huddle estimate`` prints, as HTML."""
    try:
        table = replace(result_table(result), title=str(result_title(result)))
    except BandError as error:
        return page.html(Paragraph(f"Self-noise: {error}"))
    below = (averages_line(result.snapshot), *(each.line for each in result.facts))
    blocks: list[Part] = [*map(Paragraph, _decision(result)), table, *map(Paragraph, below)]
    return "".join(page.html(each) for each in blocks)


def rendered(parts: Sequence[RenderableType | Table]) -> str:
    """Return what a terminal without colours would show."""
    screen = Console(file=io.StringIO(), width=_WIDTH, color_system=None, markup=False, emoji=False)
    with screen.capture() as shown:
        for part in parts:
            screen.print(terminal_table(part) if isinstance(part, Table) else part)
    return "\n".join(line.rstrip() for line in shown.get().splitlines())
