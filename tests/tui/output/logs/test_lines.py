"""Log lines: their formats, their level, and what becomes of a child's."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tui.output.console import notices
from tui.output.logs import lines as logs
from tui.output.logs.lines import configure
from tui.output.logs.options import LogFormat, LogLevel
from tui.runs.recorder_process import LINES_AT_ONCE, ChildLog

LOGGER = logging.getLogger("daq.recorder.recorder")
STAMP = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z"


@pytest.fixture(autouse=True)
def unconfigured() -> Iterator[None]:
    """Put logging back as it was."""
    yield
    configure()


def lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().err.splitlines()


def test_text_has_time_level_and_logger_and_is_never_wrapped(
    capsys: pytest.CaptureFixture[str],
) -> None:
    configure(LogLevel.INFO)
    LOGGER.info("word %s", "word " * 60)
    LOGGER.debug("not written")
    (line,) = lines(capsys)
    assert re.fullmatch(STAMP + r" INFO daq\.recorder\.recorder: (word ){61}", line)


def test_control_characters_of_a_device_stay_one_harmless_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    configure(LogLevel.INFO)
    LOGGER.warning("serial %s", "\x1b[2Jx\ny\x9b")
    (line,) = lines(capsys)
    assert line.endswith(r"serial \x1b[2Jx\ny\x9b")


def test_json_has_typed_fields(capsys: pytest.CaptureFixture[str]) -> None:
    configure(LogLevel.DEBUG, LogFormat.JSON)
    fields = {"sensor": "A", "missing": 3, "rate": float("nan")}
    LOGGER.warning("%s: %d missing", "A", 3, extra=fields)
    notices().print("a remark for people")
    (line,) = lines(capsys)
    entry = json.loads(line)
    assert re.fullmatch(STAMP, entry.pop("time"))
    assert entry == {
        "level": "warning",
        "logger": "daq.recorder.recorder",
        "message": "A: 3 missing",
        "sensor": "A",
        "missing": 3,
        "rate": None,
    }


def test_a_traceback_is_part_of_its_record(capsys: pytest.CaptureFixture[str]) -> None:
    configure(style=LogFormat.JSON)
    try:
        int("why")
    except ValueError:
        LOGGER.exception("failed")
    (line,) = lines(capsys)
    assert json.loads(line)["traceback"].endswith("base 10: 'why'")


def test_configuring_again_replaces_what_was_set(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    configure(LogLevel.INFO)
    configure(LogLevel.INFO, file=tmp_path / "huddle.log")
    LOGGER.info("to the file")
    configure(LogLevel.ERROR)
    LOGGER.warning("nowhere")
    LOGGER.error("to standard error")
    assert (tmp_path / "huddle.log").read_text(encoding="utf-8").endswith(": to the file\n")
    (line,) = lines(capsys)
    assert line.endswith("to standard error")


def test_other_libraries_are_heard_from_warning_on(capsys: pytest.CaptureFixture[str]) -> None:
    configure(LogLevel.DEBUG)
    logging.getLogger("matplotlib.font_manager").info("a font")
    logging.getLogger("pymodbus").error("said by our own error as well")
    logging.getLogger("h5py").warning("heard")
    (line,) = lines(capsys)
    assert "h5py: heard" in line


def test_an_application_has_the_screen_to_itself(capsys: pytest.CaptureFixture[str]) -> None:
    configure(LogLevel.INFO)
    with logs.screen_taken():
        LOGGER.error("behind the application")
    LOGGER.info("after it")
    (line,) = lines(capsys)
    assert line.endswith("after it")


@pytest.mark.parametrize("level", LogLevel)
def test_a_child_is_asked_for_what_is_written_here(level: LogLevel) -> None:
    configure(level)
    assert logs.arguments_for_child() == ("--log-format", "json", "--log-level", level)


def test_records_of_a_child_keep_time_and_fields(capsys: pytest.CaptureFixture[str]) -> None:
    configure(LogLevel.INFO, LogFormat.JSON)
    entry = {
        "time": "2026-11-21T03:00:00.125Z",
        "level": "warning",
        "logger": "daq.recorder.block_writer",
        "message": "A stalled: 100 %",
        "sensor": "A",
        "name": "not a field",
    }
    content = f"{json.dumps(entry)}\n".encode()
    child = ChildLog("the recorder")
    for number in range(len(content)):
        child.feed(content[number : number + 1])
    (line,) = lines(capsys)
    assert json.loads(line) == {key: value for key, value in entry.items() if key != "name"}
    assert child.errors == []


def test_records_of_a_child_below_the_level_are_left_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    configure(LogLevel.ERROR)
    entry = {"time": "2026-11-21T03:00:00Z", "level": "info", "logger": "daq", "message": "x"}
    ChildLog("the recorder").feed(f"{json.dumps(entry)}\n".encode())
    assert lines(capsys) == []


def test_why_a_child_failed_is_returned_and_not_logged_twice(
    capsys: pytest.CaptureFixture[str],
) -> None:
    configure(style=LogFormat.JSON)
    logs.report_failure(["port a: no answer", "port b: no answer"], exit_code=3)
    (line,) = lines(capsys)
    assert json.loads(line)["exit_code"] == 3
    child = ChildLog("the recorder")
    child.feed(b"Fatal Python error: Aborted\n" + line.encode() + b"\n")
    assert child.errors == ["port a: no answer", "port b: no answer"]
    (other,) = lines(capsys)
    assert json.loads(other)["message"] == "the recorder wrote: Fatal Python error: Aborted"


def test_why_a_command_failed_does_not_act_on_a_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    configure()
    logs.report_failure(["C\x1b[31m: not\x9b\ta name\nhint"], exit_code=3)
    assert capsys.readouterr().err == "huddle: C\\x1b[31m: not\\x9b\ta name\nhint\n"


@pytest.mark.parametrize("line", ["", "[]", "{}", "1", '{"time": 1, "level": "info"}', "\x00"])
def test_other_lines_are_no_records(line: str) -> None:
    assert logs.record_of(line) is None


def test_a_child_that_writes_without_end_does_not_fill_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    now = [0.0]
    child = ChildLog("the pages", now=lambda: now[0])
    child.feed(b"socket.accept() out of system resource\n" * 100_000)
    assert len(caplog.records) == LINES_AT_ONCE
    now[0] = 10.0
    child.feed(b"x\n")
    assert "the pages wrote 99800 further lines" in caplog.text
    child.feed(b"x" * 10_000_000)
    child.feed(b"\n")
    assert max(len(each.getMessage()) for each in caplog.records) < 100_000
