"""Hooks: what they read, how often they are tried, and which the next service carries out."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sqlite3
import sys
from datetime import timedelta
from pathlib import Path

import pytest

from daq.bench.tables.unattended import Hooks
from tests.tui.service.bench_files import HOURLY, START, Place, VirtualClock
from tests.waiting import limit
from tui.service.hooks import HookRunner, events_of, run_hook
from tui.service.records.run_state import RecordedNoise, Run, RunState
from tui.service.records.store import RunStore

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a shell")
NOISE = RecordedNoise(
    "a", "M", "S1", "x", "m/s²", "three-sensor", 1.0, 10.0, 1e-12, 9e-13, float("nan")
)


def done(verdict: str = "") -> Run:
    run = Run("lab", "hourly", START, 60.0).to(RunState.RECORDING, parts=("a.h5",))
    return run.to(RunState.ESTIMATING).to(RunState.DONE, verdict=verdict, noise=(NOISE,))


def test_each_outcome_has_its_hooks() -> None:
    every = Hooks(on_finished=("f",), on_limit=("l",), on_failed=("x",), on_missed=("m",))
    assert events_of(done("pass"), every) == ("on_finished",)
    assert events_of(done("not-decided"), every) == ("on_finished",)
    assert events_of(done("fail"), every) == ("on_finished", "on_limit")
    assert events_of(done("fail"), Hooks(on_limit=("l",))) == ("on_limit",)
    planned = Run("lab", "hourly", START, 60.0)
    assert events_of(planned, every) == ()
    assert events_of(planned.to(RunState.MISSED), every) == ("on_missed",)
    recorded = planned.to(RunState.RECORDING)
    assert events_of(recorded.to(RunState.FAILED), every) == ("on_failed",)


async def test_a_hook_names_its_secrets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    (tmp_path / "token").write_text("s3cret", encoding="utf-8")
    out = tmp_path / "out"
    program = "import sys, shutil; shutil.copy(sys.argv[1], sys.argv[2])"
    command = [sys.executable, "-c", program, "${CREDENTIALS_DIRECTORY}/token", str(out)]
    assert await run_hook(command, b"{}", limit()) == ""
    assert out.read_text(encoding="utf-8") == "s3cret"
    problem = await run_hook(["${NO_SUCH_VARIABLE}"], b"{}", limit())
    assert problem.startswith("${NO_SUCH_VARIABLE}: cannot be started")


async def test_what_a_hook_says_holds_no_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HUDDLE_TEST_TOKEN", "s3cret")
    command = ("sh", "-c", 'echo "no host $0" >&2; exit 6', "http://a:${HUDDLE_TEST_TOKEN}@b")
    said = await run_hook(command, b"", limit())
    assert said == "sh: exit code 6: no host http://a:${HUDDLE_TEST_TOKEN}@b"


async def test_a_hook_that_fails_is_tried_again_and_reads_the_run(tmp_path: Path) -> None:
    script = (
        f"echo x >> {tmp_path}/tries; test $(wc -l < {tmp_path}/tries) -ge 2 && cat > {tmp_path}/in"
    )
    hooks = Hooks(on_limit=("sh", "-c", script), retries=2, retry_after=0.001)
    store = RunStore(tmp_path)
    run = done("fail")
    run = Run(
        **{name: getattr(run, name) for name in Run.__slots__} | {"pending_hooks": ("on_limit",)}
    )
    store.save(run)
    (tmp_path / "a.json").write_text("{}", encoding="utf-8")
    runner = HookRunner(lambda: hooks, store, tmp_path, VirtualClock())
    task = asyncio.create_task(runner.work())
    runner.submit(run)
    async with asyncio.timeout(limit()):
        while True:
            if not store.runs()[0].pending_hooks:
                break
            await asyncio.sleep(0.01)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    document = json.loads((tmp_path / "in").read_text(encoding="utf-8"))
    assert document["event"] == "on_limit"
    assert document["verdict"] == "fail"
    assert document["recordings"] == [str(tmp_path / "a.h5")]
    assert document["result"] == str(tmp_path / "a.json")
    assert document["noise"][0]["serial_number"] == "S1"
    assert document["noise"][0]["high"] is None
    assert (tmp_path / "tries").read_text(encoding="utf-8").count("x") == 2
    assert runner.n_failed == 0


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        (("sh", "-c", "echo no mail >&2; exit 4"), "sh: exit code 4: no mail"),
        (("sh", "-c", "sleep 600 & wait"), "sh: took longer than 0.2 s and was ended"),
        (("/no/such/program",), "/no/such/program: cannot be started"),
        (("true",), ""),
    ],
)
async def test_what_goes_wrong_is_said(command: tuple[str, ...], problem: str) -> None:
    said = await run_hook(command, b"{}\n" * 100_000, 0.2 if "sleep" in str(command) else limit())
    assert said.startswith(problem)
    assert bool(said) == bool(problem)


@pytest.mark.virtual_time
async def test_what_was_not_told_is_told_by_the_next_service(tmp_path: Path) -> None:
    place = Place(tmp_path, HOURLY + '[hooks]\non_finished = ["true"]\non_missed = ["true"]\n')
    await place.serve(4600.0)
    (run, _) = place.store.runs()
    assert run.pending_hooks == ("on_finished",)
    place.changes.clear()
    place.clock.set_by += timedelta(hours=1)
    await place.serve(60.0)
    assert [(run.state, run.pending_hooks) for run in place.changes] == [
        (RunState.DONE, ("on_finished",)),
        (RunState.MISSED, ("on_missed",)),
    ]


def test_hooks_that_an_earlier_version_left_are_pending(tmp_path: Path) -> None:
    """Its databases have the column `untold`."""
    store = RunStore(tmp_path)
    store.save(done())
    with contextlib.closing(sqlite3.connect(store.path)) as database, database:
        database.execute("UPDATE runs SET untold = ?", ('["on_finished"]',))
    (run,) = store.runs()
    assert run.pending_hooks == ("on_finished",)
