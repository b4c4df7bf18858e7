"""``--log-level`` and ``--log-format``: what commands write to standard error."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daq.python_process import python_command
from tests.command import huddle
from tui.commands.main import app

LONG = ("run", "record", "watch", "serve", "devices", "demo", "import", "simulate", "reproduce")
pseudo_terminals = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")


def run(bench: Path, folder: Path, duration: str = "6s") -> list[str]:
    """Return the command for a run: by default as short as it may be."""
    out = str(folder / "r.h5")
    return python_command(
        "tui", "run", str(bench), "--duration", duration, "--segment", "0.5s", "--out", out
    )


@pytest.mark.parametrize("command", LONG)
def test_commands_that_run_for_long_have_both_options(command: str) -> None:
    said = CliRunner().invoke(app, [command, "--help-all"]).output
    assert "--log-level" in said
    assert "--log-format" in said


def test_the_application_logs_to_a_file_only() -> None:
    assert "--log-file" in CliRunner().invoke(app, ["tui", "--help-all"]).output


@pseudo_terminals
def test_json_is_all_there_is_on_standard_error(bench: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [*run(bench, tmp_path), "--log-format", "json"],
        capture_output=True,
        text=True,
        check=True,
    )
    entries = [json.loads(line) for line in done.stderr.splitlines()]
    loggers = {entry["logger"] for entry in entries}
    assert {"daq.recorder.recorder", "tui.commands.record"} <= loggers  # the recorder's process
    connected = {entry["sensor"] for entry in entries if entry.get("kind") == "connected"}
    assert connected == {"A", "B", "C"}
    assert all(entry["time"].endswith("Z") for entry in entries)


@pytest.mark.long
@pseudo_terminals
def test_the_level_holds_for_the_recorder_too(bench: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [*run(bench, tmp_path), "--log-level", "error", "--log-format", "json"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""


@pytest.mark.long
@pseudo_terminals
def test_on_a_terminal_log_lines_stay_whole_beside_the_progress_bar(
    bench: Path, tmp_path: Path
) -> None:
    import pty  # noqa: PLC0415 - not on Windows

    ours, theirs = pty.openpty()
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": "60"}
    try:
        with subprocess.Popen(
            run(bench, tmp_path, "20s"),  # simulated time runs fast
            stdout=subprocess.DEVNULL,
            stderr=theirs,
            env=environment,
        ) as process:
            os.close(theirs)
            shown = b""
            try:
                while part := os.read(ours, 1 << 16):
                    shown += part
            except OSError:  # Linux: the other side is closed
                pass
        assert process.returncode == 0
    finally:
        os.close(ours)
    text = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", shown.decode())
    rows = [row.strip() for row in re.split(r"[\r\n]+", text)]
    logged = [row for row in rows if " INFO " in row]
    assert sum("connected: on " in row for row in logged) == 3
    assert all(re.match(r"\d{4}-\d\d-\d\dT[\d:.]+Z INFO [a-z.]+[a-z_]*: ", row) for row in logged)
    assert any("segments" in row and row not in logged for row in rows)  # the progress bar


@pytest.mark.parametrize(
    "command", [("run", "--bad"), ("--bad",), ("estimate", "x.h5", "--json", "nowhere/x")]
)
def test_wrong_usage_is_said_in_plain_lines_without_boxes(command: tuple[str, ...]) -> None:
    result = huddle(*command, code=2)
    assert result.stderr
    assert all(line.startswith("huddle: ") for line in result.stderr.splitlines())


def test_an_error_is_a_record_where_json_is_wanted(tmp_path: Path) -> None:
    missing = str(tmp_path / "missing.toml")
    result = huddle("record", missing, "--log-format", "json", code=2)
    (line,) = result.stderr.splitlines()
    entry = json.loads(line)
    assert (entry["level"], entry["exit_code"]) == ("error", 2)
    assert missing in entry["errors"][0]
