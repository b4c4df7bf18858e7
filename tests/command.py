"""The command, run in the process of a test, and code in a process of its own."""

from __future__ import annotations

import subprocess
import sys
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


def words_of(*arguments: object, code: int = 0) -> str:
    """Return all words that the command writes, to either output, in one line."""
    return " ".join(huddle(*arguments, code=code).output.split())


def modules_after(code: str) -> set[str]:
    """Return the names of the modules that are loaded after code ran in a new interpreter."""
    run = [sys.executable, "-c", f"import sys; {code}\nprint(*sys.modules)"]
    return set(subprocess.run(run, capture_output=True, text=True, check=True).stdout.split())
