"""The command, run in the process of a test."""

from __future__ import annotations

from typing import Any

from typer.testing import CliRunner, Result

from tui.commands.main import app


def huddle(*arguments: object, code: int = 0, **options: Any) -> Result:  # noqa: ANN401
    """Run the command with `options` of its runner, and see that it ends with a code."""
    result = CliRunner().invoke(app, [str(each) for each in arguments], **options)
    assert result.exit_code == code, result.output
    return result


def printed(*arguments: object, code: int = 0) -> str:
    """Return what the command writes to a terminal of 200 columns."""
    return huddle(*arguments, code=code, terminal_width=200).stdout
