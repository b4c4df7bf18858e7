"""Output of results: tables to standard output, JSON to a file or standard output.

Text is printed as it is: names of sensors and files may hold brackets and colons, which would
otherwise be taken for markup and emoji. Colour is asked for with ``style=`` or ``rich.text.Text``.
"""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, cast

import typer

from daq.whole_file import written
from tui.page.table import WIDTH_OF_TABLES, Table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rich.console import Console
    from rich.progress import Progress, ProgressColumn

STANDARD_OUTPUT = "-"
TESTING = "all segments are read; assumptions are tested"
"""Said while that takes seconds."""
_SPEED_PERIOD = 3600.0
"""Seconds over which the time left is predicted: a step may take many minutes."""
WIDTH_OF_FILES = 110
"""Columns of bars and rules that go into a file or a pipe."""
_NARROW = frozenset("−²³±→▲△✓✗…–—·≤≥µ°σΔ’")
"""Characters of one column, of those above U+02FF."""
_FORCED = {"FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"}
_for_json = False


class FileConsole:
    """Prints texts and tables into files and pipes, which Rich would take 40 ms for.

    What else there is to a console is that of Rich, which is loaded then.
    """

    is_terminal, width = False, WIDTH_OF_FILES

    def __init__(self, *, stderr: bool, quiet: bool) -> None:
        self.stderr, self.quiet = stderr, quiet

    @property
    def file(self) -> TextIO:
        """Where it prints: standard output or standard error, as it is now."""
        return sys.stderr if self.stderr else sys.stdout

    @cached_property
    def _rich(self) -> Console:
        return _by_rich(self.width, stderr=self.stderr, quiet=self.quiet)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - of any kind
        return getattr(self._rich, name)

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: ANN401 - as that of Rich
        """Print texts and tables, each row and paragraph on one line."""
        known = len(objects) == 1 and options.keys() <= {"style", "soft_wrap"}
        text = _in_file(objects[0]) if known else None
        if text is None:
            self._rich.print(*objects, **options)
        elif not self.quiet:
            self.file.write(f"{text}\n")
            self.file.flush()


def _in_file(shown: object) -> str | None:
    """Return a text or a table as it is in a file; None if Rich must lay it out."""
    if isinstance(shown, str):
        rows: list[tuple[str, ...]] = [(shown,)]
    elif isinstance(shown, Table) and not shown.title:
        rows = [shown.header] * any(shown.header) + list(shown.rows)
    else:
        return None
    letters = {letter for row in rows for cell in row for letter in cell}
    if isinstance(shown, str):
        letters.discard("\n")
    if not all(each.isprintable() and (each < "\u0300" or each in _NARROW) for each in letters):
        return None
    if isinstance(shown, str):
        return shown
    n_columns = max(map(len, rows), default=0)
    rows = [row + ("",) * (n_columns - len(row)) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    if sum(widths) + 2 * n_columns > WIDTH_OF_TABLES:
        return None
    return "\n".join(
        "  ".join(
            cell.ljust(width) if number in shown.left else cell.rjust(width)
            for number, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )


def console() -> Console:
    """Return standard output."""
    return _plain(sys.stdout)


@cache
def notices() -> Console:
    """Return standard error, where progress and remarks go; nowhere if it carries JSON."""
    return _plain(sys.stderr, stderr=True, quiet=_for_json)


def _plain(stream: TextIO, *, stderr: bool = False, quiet: bool = False) -> Console:
    if stream.isatty() or not _FORCED.isdisjoint(os.environ):  # as Rich decides
        return _by_rich(None if stream.isatty() else WIDTH_OF_FILES, stderr=stderr, quiet=quiet)
    return cast("Console", FileConsole(stderr=stderr, quiet=quiet))


def _by_rich(width: int | None, *, stderr: bool, quiet: bool) -> Console:
    from tui.output.plain_console import PlainConsole  # noqa: PLC0415 - files need no Rich

    return PlainConsole(
        stderr=stderr, quiet=quiet, highlight=False, markup=False, emoji=False, width=width
    )


def reserve_standard_error(*, for_json: bool) -> None:
    """Leave standard error to log lines in JSON: no remark, table or progress bar goes there."""
    global _for_json  # noqa: PLW0603 - there is one standard error
    _for_json = for_json
    notices.cache_clear()


def hint(text: str) -> None:
    """Tell a person at the terminal what to do next; files and pipes get no hints."""
    if notices().is_terminal:
        notices().print(text, style="dim", soft_wrap=True)


def shows_progress() -> bool:
    """Whether it is shown how far something is: on terminals only, not in files and pipes."""
    return notices().is_terminal and not notices().quiet


@contextmanager
def counted(
    what: str, of: str = "", *, then: str = ""
) -> Iterator[Callable[[int, int], None] | None]:
    """Show how many of something are done, and the time left; yield what is told so, or None.

    From the first that is done on. If work of unknown length follows, `then` is its name: from the
    start, and after the last.
    """
    if not shows_progress():
        yield None
        return
    from rich.progress import BarColumn, TimeRemainingColumn  # noqa: PLC0415

    columns = "{task.description}", BarColumn(), "{task.fields[count]}", TimeRemainingColumn()
    with progress(*columns) as bar:
        counting = bar.add_task(what, total=None, visible=bool(then), count="")
        following = bar.add_task(then, total=None, visible=False, count="")

        def tell(done: int, total: int) -> None:
            follows, count = bool(then) and done >= total, f"{done} of {total} {of}".rstrip()
            bar.update(following, visible=follows)
            bar.update(counting, completed=done, total=total, visible=not follows, count=count)

        yield tell


def progress(*columns: str | ProgressColumn, per_second: float = 2) -> Progress:
    """Return a display of how far something is, where `shows_progress`.

    It is drawn so many times `per_second`.
    """
    from rich.progress import Progress  # noqa: PLC0415 - recorders and services show none

    return Progress(
        *columns,
        console=notices(),
        refresh_per_second=per_second,
        transient=True,
        disable=not shows_progress(),
        speed_estimate_period=_SPEED_PERIOD,
    )


def for_people(json_file: str | None, csv_file: str | None = None) -> Console:
    """Return where to print tables: standard error, if a program reads standard output."""
    return notices() if STANDARD_OUTPUT in {json_file, csv_file} else console()


def check_places(*files: str | None) -> None:
    """Refuse, before anything is measured, files that could not be written.

    Raises
    ------
    typer.BadParameter
        If one has no folder or is one, or two results are to go to standard output.
    """
    if files.count(STANDARD_OUTPUT) > 1:
        raise typer.BadParameter("- is standard output, which takes one result; name a file")
    for file in files:
        if file in {None, STANDARD_OUTPUT}:
            continue
        folder = Path(str(file)).absolute().parent
        if not folder.is_dir():
            raise typer.BadParameter(f"{file}: there is no folder {folder}; make it first")
        if Path(str(file)).is_dir():
            raise typer.BadParameter(f"{file}: a folder; expected the name of a file")


def write_text(file: str, text: str, *, append: bool = False) -> None:
    """Write to a file, or to standard output if it is called ``-``.

    Raises
    ------
    OSError
        With the name of the file, which the error of a full disk lacks.
    """
    with growing(file, append=append) as write:
        write(text)


@contextmanager
def growing(file: str | None, *, append: bool = False) -> Iterator[Callable[[str], object]]:
    """Return what adds text to a file, or to standard output; to nothing without a file.

    The file is complete when it has its name, and an earlier one stays until then, unless the text
    is to `append`.

    Raises
    ------
    OSError
        With the name of the file, which the error of a full disk lacks.
    """
    if file is None:
        yield lambda text: None  # noqa: ARG005 - it goes nowhere
        return
    path = Path(file)
    try:
        if file == STANDARD_OUTPUT:
            yield sys.stdout.write
            sys.stdout.flush()
        elif append or (path.exists() and not path.is_file()):
            with path.open("a", encoding="utf-8") as out:
                yield out.write
        else:
            with written(path) as write:
                yield lambda text: write(text.encode())
    except OSError as error:
        if error.filename is None:
            error.filename = "standard output" if file == STANDARD_OUTPUT else file
        raise


def write_json(file: str | None, document: Mapping[str, Any]) -> None:
    """Write a document as one line of JSON, if a file is given; infinite numbers become null."""
    if file is None:
        return
    from tui.output.json_values import json_text  # noqa: PLC0415 - loads numpy

    with growing(file) as write:
        write(json_text(document))
        write("\n")
