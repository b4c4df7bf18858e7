"""What a service tells others: its hooks, systemd and Prometheus."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import platform
import re
import socket
import sqlite3
import sys
import urllib.request
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from daq.bench.tables.unattended import Hooks, Metrics
from daq.caveats import Caveat, Caveats
from estimator.decision.verdict import Verdict
from tests.tui.service.bench_files import HOURLY, START, Place, VirtualClock
from tests.waiting import limit
from tui import __version__
from tui.commands.serve import is_alive, signs_of_life
from tui.output.logs.lines import JournalHandler
from tui.service.hooks import HookRunner, events_of, run_hook
from tui.service.metrics import MetricsError, ServiceMetrics
from tui.service.notify import Notifier, watchdog_interval
from tui.service.records.run_state import RecordedNoise, Run, RunState
from tui.service.records.store import RunStore
from tui.service.window import STALL

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a shell, sockets with names")
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


# --- signs of life: systemd and Prometheus ---------------------------------------------------


ROOT = Path(__file__).parents[3]


@pytest.mark.virtual_time
async def test_the_watchdog_is_fed_by_the_progress_of_the_recorder(tmp_path: Path) -> None:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(address)
        systemd.setblocking(False)
        place = Place(tmp_path, HOURLY + 'duration = "40min"\n')
        service = place.service()
        tasks = [
            asyncio.create_task(service.run()),
            asyncio.create_task(signs_of_life(service, Notifier(address))),
        ]

        def received() -> list[str]:
            found = []
            while True:
                try:
                    found.append(systemd.recv(4096).decode())
                except BlockingIOError:
                    return found

        for _ in range(4):
            await asyncio.sleep(20.0)
        assert received()[0] == "READY=1"
        for _ in range(180):
            await asyncio.sleep(20.0)
            last = received()[-1]
        assert last.startswith("STATUS=recording run hourly")
        assert "WATCHDOG=1" in last
        loop = asyncio.get_running_loop()
        assert is_alive(service, loop.time())
        assert not is_alive(service, loop.time() + 3 * STALL.total_seconds())
        service.request_stop()
        tasks[1].cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def test_the_interval_is_half_of_what_systemd_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WATCHDOG_USEC", raising=False)
    assert watchdog_interval() is None
    monkeypatch.setenv("WATCHDOG_USEC", "6000000")
    assert watchdog_interval() == 3.0
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert watchdog_interval() is None


@pytest.mark.virtual_time
async def test_metrics_show_runs_sensors_and_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tui.service.metrics.PATIENCE", 0.5)
    place = Place(tmp_path, HOURLY)
    service = place.service()
    hook_runner = HookRunner(lambda: service.bench.hooks, place.store, tmp_path, place.clock)
    metrics = ServiceMetrics(service, hook_runner)
    task = asyncio.create_task(service.run())
    await asyncio.sleep(2 * 3600.0)  # 14:00:30
    noise = RecordedNoise("a", "", "7", "X", "m/s²", "three-sensor", 1.0, 10.0, 4e-12, 3e-12, 5e-12)
    for run in place.changes:
        metrics.note(
            replace(run, noise=(noise,), verdict="not-decided", caveats=Caveats([Caveat.SIMULATED]))
        )
    with metrics.served(Metrics(port=0)) as port:
        with pytest.raises(MetricsError, match=f"port {port}: Address already in use"):
            metrics.served(Metrics(port=port)).__enter__()
        address = f"http://127.0.0.1:{port}/metrics"
        with monkeypatch.context() as patched:
            patched.setattr("tui.service.metrics.MAX_THREADS", 0)
            assert await asyncio.to_thread(_silent, port) == b""  # not taken
        assert await asyncio.to_thread(_silent, port) == b""  # its time is over
        text = await asyncio.to_thread(_read, address)
    service.request_stop()
    await task
    lines = dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    assert lines['huddle_runs_total{state="done"}'] == "1.0"
    assert lines['huddle_runs_total{state="missed"}'] == "0.0"
    assert lines["huddle_recording"] == "1.0"
    assert lines['huddle_sensor_samples{sensor="a"}'] == "7.0"
    assert lines['huddle_sensor_state{sensor="a",state="live"}'] == "1.0"
    assert float(lines["huddle_disk_free_bytes"]) > 0
    of = '{channel="X",high_hz="10.0",low_hz="1.0",sensor="a",serial_number="7",unit="m/s²"}'
    found = {name: lines[f"huddle_noise_{name}{of}"] for name in ("psd", "low", "high")}
    assert found == {"psd": "4e-12", "low": "3e-12", "high": "5e-12"}
    verdicts = {name: lines[f'huddle_verdict{{verdict="{name}"}}'] for name in Verdict}
    assert verdicts == {"pass": "0.0", "fail": "0.0", "not-decided": "1.0"}
    assert lines["huddle_simulated"] == "1.0"
    build = f'huddle_build_info{{python="{platform.python_version()}",version="{__version__}"}}'
    assert lines[build] == "1.0"
    _check_dashboard(set(lines))


def _check_dashboard(scraped: set[str]) -> None:
    """Check that the dashboard of Grafana shows all metrics, by names and labels they have."""
    labels = {line.partition("{")[0]: {*re.findall(r'(\w+)="', line)} for line in scraped}
    dashboard = json.loads((ROOT / "deploy" / "grafana.json").read_text(encoding="utf-8"))
    shown = set()
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            (name,) = re.findall(r"huddle_\w+", target["expr"])
            assert name in labels, target["expr"]
            assert {*re.findall(r"{{(\w+)}}", target["legendFormat"])} <= labels[name]
            shown.add(name)
    assert shown == {name for name in labels if name.startswith("huddle_")}
    variables = {each["name"]: each["query"] for each in dashboard["templating"]["list"]}
    assert variables["instance"] == "label_values(huddle_build_info, instance)"
    assert {panel["datasource"]["uid"] for panel in dashboard["panels"]} == {"${datasource}"}
    assert "datasource" in variables
    cells = [
        (column, row)
        for panel in dashboard["panels"]
        for place in [panel["gridPos"]]
        for column in range(place["x"], place["x"] + place["w"])
        for row in range(place["y"], place["y"] + place["h"])
    ]
    assert len(cells) == len(set(cells)), "panels overlap"
    assert max(column for column, _ in cells) < 24


def _silent(port: int) -> bytes:
    """Connect and say nothing; return what comes before the end."""
    with socket.create_connection(("127.0.0.1", port), timeout=limit(60)) as silent:
        return silent.recv(1)


def _read(address: str) -> str:
    with urllib.request.urlopen(address) as answer:  # noqa: S310 - our own
        return str(answer.read().decode())


def test_metrics_stay_on_this_computer_unless_the_bench_file_says_otherwise() -> None:
    assert Metrics(port=9310).address == "127.0.0.1"
    with pytest.raises(ValueError, match="expected an IP address"):
        Metrics(port=9310, address="everywhere")


def test_the_journal_gets_typed_fields(tmp_path: Path) -> None:
    address = str(tmp_path / "journal")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
        journal.bind(address)
        handler = JournalHandler(address)
        record = logging.makeLogRecord(
            {"name": "tui", "levelno": logging.ERROR, "msg": "two\nlines", "run": "failed", "n": 3}
        )
        handler.emit(record)
        handler.close()
        entry = journal.recv(4096)
    assert b"MESSAGE\n\x09\0\0\0\0\0\0\0two\nlines\n" in entry
    assert b"PRIORITY=3\n" in entry
    assert b"HUDDLE_RUN=failed\n" in entry
    assert b"HUDDLE_N=3\n" in entry
