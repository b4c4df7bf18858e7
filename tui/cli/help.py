"""Commands whose help is plain text: usage, description, and a section for each panel.

The help pages of typer need Rich and its Markdown, which take as long to load as all the rest.
"""

# ruff: noqa: ANN401, PLC0415 - contexts and formatters are typer's own; logging is for commands

from __future__ import annotations

from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup

from tui.cli.examples import EXAMPLES
from tui.cli.subcommands import MODULES, PANELS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    Rows = Iterable[tuple[str, tuple[str, str]]]
    """Panel, and a form with its help."""

_HYPHEN = "\N{NON-BREAKING HYPHEN}"
"""In place of a hyphen while lines are broken: --no-reject stays whole."""


class HelpfulCommand(TyperCommand):
    """A subcommand."""

    def __init__(self, *args: Any, **declared: Any) -> None:
        super().__init__(*args, **declared)
        parameters: list[Any] = list(self.params)
        for parameter in parameters:
            converter = _Converter(parameter.type_descriptor, parameter.get_runtime_param)
            parameter.get_runtime_param = converter.itself

    def get_help(self, ctx: Any) -> str:
        """Return the page."""
        return super().get_help(ctx).replace(_HYPHEN, "-")

    def get_help_option(self, ctx: Any) -> Any:
        """Return ``--help``, off by default."""
        return _off_by_default(super().get_help_option(ctx))

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each panel of options."""
        _write_sections(formatter, _options(self.get_params(ctx), ctx))

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples, each on a line of its own."""
        del ctx
        with formatter.section(_heading("Examples")):
            formatter.write_text(f"\b\n{self.epilog}")

    def invoke(self, ctx: Any) -> Any:
        """Run the command. Its own options of log lines are applied later."""
        from tui.output.logs.lines import configure

        configure()
        return super().invoke(ctx)


class _Converter:
    """Converts the value of a parameter as typer does, if one is given.

    Typer makes a converter with Pydantic for every parameter: those of thirty options take longer
    than all the rest of reading a command line, and Pydantic as long as HDF5. Texts, and paths of
    which nothing is asked, need none.
    """

    def __init__(self, declared: Any, of_typer: Callable[[], Any]) -> None:
        self._plain = _plain_type(declared)
        self._of_typer = of_typer

    def itself(self) -> _Converter:
        """Return the converter: in place of typer's ``get_runtime_param``."""
        return self

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return what typer makes of a value; without one None, or () if several may be given."""
        several = param.multiple or param.nargs == -1
        if value is None:
            return () if several else None
        if self._plain is not None and isinstance(value, str):
            return self._plain(value)
        if self._plain is not None and several and isinstance(value, (list, tuple)):
            return [self._plain(each) for each in value]
        return self._of_typer().coerce(value, param=param, ctx=ctx)


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
            for name, (_, summary) in entries.items():
                self.add_command(TyperCommand(name, help=summary, rich_help_panel=panel))

    def get_help_option(self, ctx: Any) -> Any:
        """Return ``--help``, off by default."""
        return _off_by_default(super().get_help_option(ctx))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a subcommand with its options; None if there is none of this name."""
        del ctx
        return subcommand(cmd_name) if cmd_name in MODULES else None

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write a section for the options, and one for each panel of commands."""
        _write_sections(formatter, _options(self.get_params(ctx), ctx))
        for panel, entries in PANELS.items():
            rows = ((panel, (name, summary)) for name, (_, summary) in entries.items())
            _write_sections(formatter, rows)


@cache
def subcommand(name: str) -> Any:
    """Return a subcommand with its options, as a command of typer."""
    module = import_module(f"tui.cli.{MODULES[name]}")
    function = getattr(module, name if hasattr(module, name) else f"{name}_")  # import_
    alone = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    epilog = "\n".join(EXAMPLES[function.__name__])
    alone.command(name, cls=HelpfulCommand, epilog=epilog)(function)
    return typer.main.get_command(alone)


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
