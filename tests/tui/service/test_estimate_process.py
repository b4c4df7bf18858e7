"""Processes that estimate: ended without progress, however long they take with progress."""

from __future__ import annotations

import asyncio
import sys

import pytest

from tests.waiting import limit, python
from tui.service.processes.finish import OOM_SCORE
from tui.service.processes.steps import FinishFailedError, outcome_of

OUTCOME = (
    '{"verdict": "pass", "notes": [], "noise": [], "error": "", "parts": [], "refused": false,'
    ' "identities": []}'
)


async def child(program: str) -> asyncio.subprocess.Process:
    pipe = asyncio.subprocess.PIPE
    return await asyncio.create_subprocess_exec(
        sys.executable, "-S", "-c", program, stdin=pipe, stdout=pipe, stderr=pipe
    )


async def test_an_estimate_without_progress_is_ended() -> None:
    process = await child("import sys; print('.', flush=True); sys.stdin.read()")
    with pytest.raises(FinishFailedError, match="made no progress for"):
        await outcome_of(process, silence=limit(0.3))
    assert process.returncode != 0


@pytest.mark.skipif(sys.platform != "linux", reason="of the Linux kernel")
def test_an_estimate_dies_before_a_recorder() -> None:
    program = (
        "from tui.service.processes.finish import die_first; die_first();"
        " print(open('/proc/self/oom_score_adj').read())"
    )
    assert int(python(program).stdout) == OOM_SCORE


@pytest.mark.skipif(sys.platform != "linux", reason="of the Linux kernel")
def test_an_estimate_has_a_share_of_the_memory() -> None:
    program = (
        "import os; from tui.service.processes.finish import limit_memory;"
        " size = os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE');"
        " limit_memory(0.1); bytearray(size // 5)"
    )
    ended = python(program)
    assert ended.returncode == 1
    assert ended.stderr.rstrip().endswith("MemoryError")


async def test_points_are_no_outcome() -> None:
    process = await child(f"print('.\\n.'); print('.'); print({OUTCOME!r}, end='')")
    assert (await outcome_of(process)).verdict == "pass"


async def test_an_estimate_that_crashes_has_its_last_line_as_reason() -> None:
    process = await child("print('.'); raise SystemExit('no memory')")
    with pytest.raises(FinishFailedError, match="ended with exit code 1"):
        await outcome_of(process)
