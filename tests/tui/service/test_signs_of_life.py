"""What systemd and Prometheus receive."""

from __future__ import annotations

import asyncio
import json
import logging
import platform
import re
import socket
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest

from daq.bench.tables.unattended import Metrics
from daq.caveats import Caveat, Caveats
from estimator.decision.verdict import Verdict
from tests.tui.service.bench_files import HOURLY, Place
from tests.waiting import limit
from tui import __version__
from tui.commands.serve import is_alive, signs_of_life
from tui.output.logs.lines import JournalHandler
from tui.service.hooks import HookRunner
from tui.service.metrics import MetricsError, ServiceMetrics
from tui.service.notify import Notifier, watchdog_interval
from tui.service.records.run_state import RecordedNoise
from tui.service.window import STALL

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="sockets with names")


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
