"""Commands whose help is plain text: usage, description, and a section for each panel.

The help pages of typer need Rich and its Markdown, which take as long to load as all the rest. The
module of a command is imported when the command is used, or asked for its help.
"""

# ruff: noqa: ANN401, PLC0415 - contexts and formatters are typer's own; logging is for commands

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from enum import Enum
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup

from tui.commands.options import ESSENTIAL, ESTIMATE_PANEL, LOG_PANEL, Guide, declared

Rows = Iterable[tuple[str, tuple[str, str]]]
"""Panel, and a form with its help."""

PANELS: dict[str, dict[str, str]] = {
    "Bench": {
        "init": "Write a commented bench file to fill in.",
        "check": "Validate a bench file, then identify every device and make the check list.",
        "plan": "Compute the duration of recording for a target precision, by method.",
        "tui": "Open the application: start, watch and stop a huddle test.",
        "run": "Run one huddle test: record, estimate live, print the result.",
        "record": "Record without estimating, until the duration has passed or Ctrl-C.",
        "watch": "Show the live estimate of a recording that another process writes.",
    },
    "Unattended": {
        "serve": "Run huddle tests on the schedule of the bench file, until Ctrl-C.",
        "web": "Show a bench in the browser, until Ctrl-C.",
        "status": "Show the state of the service of a bench: runs, sensors, disk, clock.",
        "runs": "List the runs of a service: state, verdict, recordings, reason.",
        "history": "Show the noise of every channel from run to run, and whether it has changed.",
        "pin": "Protect runs from removal by the storage limits of the bench file.",
        "verify": (
            "Verify the checksums and signatures of recordings, or of all recordings of a service."
        ),
        "sign": "Sign recordings with a private key, or make one.",
    },
    "Recordings": {
        "estimate": "Estimate the self-noise of every channel from recordings.",
        "calibrate": "Calibrate sensors against one of them by their common motion.",
        "archive": "Keep the spectra of months of recordings, and show the noise over time.",
        "report": "Write the calibration report of a huddle test as HTML or PDF.",
        "issue": "Issue a numbered certificate of a huddle test as PDF.",
        "issues": "List the certificates of a ledger, with revisions and void numbers.",
        "plot": "Draw the self-noise of every channel as a figure for publication.",
        "import": "Convert files of other programs into a recording.",
        "export": "Write samples or noise curves for other programs.",
        "repair": "Verify the checksums of a recording, and close it if a crash left it open.",
    },
    "Without hardware": {
        "demo": "Run a complete huddle test on simulated sensors.",
        "devices": "List ports, or serve simulated devices of a bench file.",
        "simulate": "Simulate a recording without devices.",
        "reproduce": "Reproduce the figures of the paper and compare them with theory.",
    },
    "Shell": {
        "completion": "Print what completes commands in a shell, or the manual page.",
    },
}
"""By panel of the help: the commands, and the first line of the help of each."""

ASKED_BY_SHELL = "_HUDDLE_COMPLETE"
"""Environment variable by which a shell asks for completions."""
COMMANDS = [name for panel in PANELS.values() for name in panel]
_MODULES = {"import": "import_", "issues": "issue", "pin": "runs"}
"""The module of a command that is not in one of its name."""

_FIRST = "huddle.first"
"""Key of a context that shows the options that people need first."""
_HYPHEN = "\N{NON-BREAKING HYPHEN}"
"""In place of a hyphen while lines are broken: --no-reject stays whole."""


class HelpfulCommand(TyperCommand):
    """A subcommand.

    ``--help`` shows the options that people need first, ``--help-all`` all of them, as the manual
    page and the documents do.
    """

    guide = Guide()

    def __init__(self, *args: Any, **declared: Any) -> None:
        super().__init__(*args, **declared)
        parameters: list[Any] = list(self.params)
        for parameter in parameters:
            converter = _Converter(parameter.type_descriptor, parameter.get_runtime_param)
            parameter.get_runtime_param = converter.itself

    def get_help(self, ctx: Any) -> str:
        """Return the page with all options."""
        return super().get_help(ctx).replace(_HYPHEN, "-")

    def get_help_option(self, ctx: Any) -> Any:
        """Return ``--help``, off by default; it shows what is needed first."""
        switch = _off_by_default(super().get_help_option(ctx))
        switch.callback = _show_first
        return switch

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, with ``--help-all``; it is listed where ``--help`` is shorter."""
        found = super().get_params(ctx)
        n_more = sum(not self._is_first(each) for each in self.params)
        whole: Any = copy(found[-1])
        whole.opts, whole.name, whole.callback = ["--help-all"], "help_all", _show_all
        whole.help, whole.hidden = f"Show all options, {n_more} more, and exit.", not n_more
        return [*found, whole]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each panel of options."""
        shown = self.get_params(ctx)
        if _FIRST in ctx.meta:
            shown = [each for each in shown if self._is_first(each)]
        _write_sections(formatter, _options(shown, ctx))

    def _is_first(self, parameter: Any) -> bool:
        """Whether ``--help`` shows a parameter."""
        if isinstance(parameter, TyperArgument) or parameter.name in {"help", "help_all"}:
            return True
        if self.guide.first:
            return parameter.name in self.guide.first
        panel = parameter.rich_help_panel
        return panel not in {ESTIMATE_PANEL, LOG_PANEL} or parameter.name in ESSENTIAL

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples, each on a line of its own, and one with its output."""
        del ctx
        with formatter.section(_heading("Examples")):
            formatter.write_text("\b\n" + self.guide.lines)
        if self.guide.worked:
            with formatter.section(_heading("Worked example")):
                formatter.write_text("\b\n" + self.guide.worked.replace("\n\n", "\n\n\b\n"))

    def invoke(self, ctx: Any) -> Any:
        """Run the command. Its own options of log lines are applied later."""
        from tui.output.logs.lines import configure

        configure()
        return super().invoke(ctx)


def _show_first(ctx: Any, param: Any, value: bool) -> None:
    if value:
        ctx.meta[_FIRST] = True
    _show_all(ctx, param, value)


def _show_all(ctx: Any, param: Any, value: bool) -> None:
    del param
    if value and not ctx.resilient_parsing:
        typer.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()


class _Converter:
    """Converts the value of a parameter as typer does, if one is given.

    Typer makes a converter with Pydantic for every parameter: those of thirty options take longer
    than all the rest of reading a command line, and Pydantic as long as HDF5. Texts, and paths of
    which nothing is asked, need none.
    """

    def __init__(self, declared: Any, of_typer: Callable[[], Any]) -> None:
        self._plain = _plain_type(declared)
        self._type = declared.annotation if _has_no_text(declared) else None
        self._of_typer = of_typer

    def itself(self) -> _Converter:
        """Return the converter: in place of typer's ``get_runtime_param``."""
        return self

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return what typer makes of a value; without one None, or () if several may be given."""
        several = param.multiple or param.nargs == -1
        if value is None:
            return () if several else None
        for each in (value,) if isinstance(value, str) else value if several else ():
            if any(each in other.opts for other in ctx.command.params):
                raise typer.BadParameter(f"{each} is an option; a value is missing", ctx, param)
        if self._type is not None and type(value) is self._type:
            return value  # a default, or whether a flag is there
        if self._plain is not None and isinstance(value, str):
            return self._plain(value)
        if self._plain is not None and several and isinstance(value, (list, tuple)):
            return [self._plain(each) for each in value]
        return self._of_typer().coerce(value, param=param, ctx=ctx)


def _has_no_text(declared: Any) -> bool:
    """Whether no value from the command line has the type of a parameter: that is a text."""
    kind = declared.annotation
    return not declared.is_list and (
        kind in {bool, int, float} or (isinstance(kind, type) and issubclass(kind, Enum))
    )


def _plain_type(declared: Any) -> type[str] | type[Path] | None:
    """Return `str` or `Path` where that is all there is to the conversion of a parameter."""
    about = declared.parameter_info
    kind = get_args(declared.annotation)[0] if declared.is_list else declared.annotation
    if about.parser is not None or declared.is_file:
        return None
    if kind is Path:
        asked = about.exists or about.writable or about.resolve_path or about.path_type
        return None if asked or not (about.file_okay and about.dir_okay) else Path
    return str if kind is str else None


class LazyGroup(TyperGroup):
    """The subcommands of `PANELS`; one is built when it is used."""

    def __init__(self, **declared: Any) -> None:
        super().__init__(**declared)
        for panel, entries in PANELS.items():
            for name, summary in entries.items():
                self.add_command(TyperCommand(name, help=summary, rich_help_panel=panel))

    def get_help_option(self, ctx: Any) -> Any:
        """Return ``--help``, off by default."""
        return _off_by_default(super().get_help_option(ctx))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a subcommand with its options; None if there is none of this name."""
        del ctx
        return subcommand(cmd_name) if cmd_name in COMMANDS else None

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write a section for the options, and one for each panel of commands."""
        _write_sections(formatter, _options(self.get_params(ctx), ctx))
        for panel, entries in PANELS.items():
            _write_sections(formatter, ((panel, entry) for entry in entries.items()))


@cache
def subcommand(name: str) -> Any:
    """Return a subcommand with its options, as a command of typer."""
    module = import_module(f"tui.commands.{_MODULES.get(name, name)}")
    function = getattr(module, name if hasattr(module, name) else f"{name}_")  # import_
    alone = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    callback, text, guide = declared(function)
    alone.command(name, cls=HelpfulCommand, help=text)(callback)
    command: Any = typer.main.get_command(alone)
    command.guide = guide
    return command


def _off_by_default(switch: Any) -> Any:
    """Return a switch that is off if it is not given: Pydantic is not needed to read nothing."""
    if switch is not None:
        switch.default = False
    return switch


def _options(parameters: Iterable[Any], ctx: Any) -> Rows:
    for each in parameters:
        record = each.get_help_record(ctx)
        if record is None:  # a hidden option
            continue
        form, text = record
        if isinstance(each, TyperArgument):
            yield "Arguments", (" ".join(each.get_usage_pieces(ctx)), text)
        else:
            yield each.rich_help_panel or "Options", (form, text.replace("-", _HYPHEN))


def _write_sections(formatter: Any, rows: Rows) -> None:
    sections: dict[str, list[tuple[str, str]]] = {}
    for panel, row in rows:
        sections.setdefault(panel, []).append(row)
    for panel, members in sections.items():
        with formatter.section(_heading(panel)):
            formatter.write_dl(members)


def _heading(text: str) -> str:
    return typer.style(text, bold=True)  # bold on terminals only: typer.echo removes it elsewhere
