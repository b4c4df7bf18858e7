"""``huddle completion``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Literal

import typer

from tui.commands.help import ASKED_BY_SHELL
from tui.commands.options import command


@command()
def completion(
    kind: Literal["bash", "zsh", "fish", "man"],
) -> None:
    """Print what completes commands in a shell, or the manual page.

    Load the text in the start file of the shell, or store it where the
    shell looks for completions.

    Parameters
    ----------
    kind : SHELL
        bash, zsh or fish; or man: the manual page.

    Examples
    --------
    eval "$(huddle completion bash)"
    huddle completion zsh > ~/.zfunc/_huddle
    huddle completion fish > ~/.config/fish/completions/huddle.fish
    huddle completion man > ~/.local/share/man/man1/huddle.1
    """
    if kind == "man":
        typer.echo("\n".join(manual()))
        return
    script = import_module("typer.completion").get_completion_script
    text = script(prog_name="huddle", complete_var=ASKED_BY_SHELL, shell=kind)
    # zsh loads the text from its folder at the first Tab, which it must then complete.
    ends = "compdef _huddle_completion huddle"
    first = f"if [ $funcstack[1] = _huddle ]; then _huddle_completion; else {ends}; fi"
    typer.echo(text.replace(ends, first))


def manual() -> Iterator[str]:
    """Yield the lines of the manual page, in man's macros: a section for each command."""
    import re
    from datetime import UTC, datetime

    from tui import __version__
    from tui.commands.help import PANELS, subcommand

    def plain(text: str) -> str:
        text = text.replace("\\", "\\e").replace("-", "\\-")
        return re.sub(r"^(?=[.'])", "\\\\&", text, flags=re.MULTILINE)

    made = f"{datetime.now(UTC):%Y-%m-%d}"  # the page is that of the program of today
    yield f'.TH HUDDLE 1 "{made}" "huddle {__version__}" "User Commands"'
    yield from (".SH NAME", "huddle \\- measure the self\\-noise of sensors placed side by side")
    yield from (".SH SYNOPSIS", ".B huddle", ".I COMMAND [OPTIONS]")
    for panel, commands in PANELS.items():
        yield f".SH {panel.upper()}"
        for name in commands:
            command = subcommand(name)
            context = typer.Context(command, info_name=f"huddle {name}", max_content_width=78)
            yield from (f".SS huddle {name}", ".nf", plain(command.get_help(context)), ".fi")
    yield from (".SH EXIT STATUS", "0 done; 1 a limit is not met; 2 usage; 3 device or file;")
    yield "4 not decided; 130 interrupted; 141 the output is no longer read"
