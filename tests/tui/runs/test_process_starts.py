"""Our processes run none of the Python files that lie in the working directory."""

from __future__ import annotations

import asyncio
import json
import re
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

from daq.bench.end_condition import EndCondition
from daq.bench.loading import dump
from daq.bench.model import Bench, Limit
from daq.devices.bench_file import parse
from tests.daq.archive import months
from tests.tui.demo_bench import DEMO
from tests.waiting import limit
from tui.service.processes.finish import Outcome, Request
from tui.service.processes.steps import ProcessSteps
from tui.simulation.devices import simulated

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")

ROOT = Path(__file__).parents[3]
MODULES = ("random", "cronsim", "json", "numpy", "typer", "huddle")
PACKAGES = ("tui", "daq", "estimator", "sim_devices")
FOREIGN = """
from pathlib import Path
with Path({record!r}).open("a") as record:
    print(__file__, file=record)
raise SystemExit(f"{{__file__}} was executed")
"""


@pytest.fixture
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Enter a folder full of modules of the user's; return where those that run are listed."""
    record = tmp_path / "executed"
    folder = tmp_path / "work"
    folder.mkdir()
    for name in MODULES:
        (folder / f"{name}.py").write_text(FOREIGN.format(record=str(record)), encoding="utf-8")
    for name in PACKAGES:
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(
            FOREIGN.format(record=str(record)), encoding="utf-8"
        )
    monkeypatch.chdir(folder)
    return record


def test_these_modules_would_run_in_an_unprotected_process(record: Path) -> None:
    subprocess.run([sys.executable, "-m", "tui"], check=False, capture_output=True)
    assert record.exists()


@pytest.mark.long
def test_recorders_and_estimates_of_a_service_execute_none(record: Path) -> None:
    """Nor what ends a recording at its condition."""
    with simulated(parse(DEMO), speed=8.0) as reachable:
        limits = (Limit(name="mask", frequency=(1.0, 30.0), psd=(1e-9, 1e-9)),)
        bench = reachable.model_copy(update={"limits": limits})
        Path("bench.toml").write_text(dump(bench), encoding="utf-8")
        placed = parse(dump(bench), Path("bench.toml").absolute())
        outcome, part = asyncio.run(one_run(ProcessSteps(placed, Path("bench.toml")), placed))
    assert outcome.error == ""
    assert outcome.verdict == "not-decided"  # 12 s are too short for the limit
    path = (placed.recording_directory / part).with_suffix(".json")
    result = json.loads(path.read_text(encoding="utf-8"))
    assert result["segments"] >= 5
    assert result["method"] == "three-channel"
    assert not record.exists()


async def one_run(steps: ProcessSteps, bench: Bench) -> tuple[Outcome, str]:
    part = steps.new_part(datetime.now(UTC))
    recorder = steps.start(part, 12.0, EndCondition(cov=0.01))
    while not await recorder.ends_within(60):
        pass
    assert recorder.failure() == ""
    options = {"method": "three-channel"}
    outcome = await steps.finish(Request([str(bench.recording_directory / part)], options))
    steps.release(part)
    return outcome, part


@pytest.mark.long
def test_the_installed_command_and_all_that_it_starts_run_none(record: Path) -> None:
    command = Path(sys.executable).with_name("huddle")
    done = subprocess.run(
        [command, "demo", "--duration", "14s", "--speed", "8", "--json", "-"],
        capture_output=True,
        text=True,
        check=False,
        timeout=limit(),
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["segments"] >= 6
    assert not record.exists()


@pytest.mark.long
def test_processes_of_an_archive_execute_none(record: Path, tmp_path: Path) -> None:
    begin = months.START_NS
    paths = [
        months.record(tmp_path / f"{hour}.h5", begin_ns=begin + hour * months.HOUR_NS, seed=hour)
        for hour in (0, 3)
    ]
    store = months.store_for(tmp_path / "archive", paths[0])
    with store.writing():
        assert months.fill(store, paths, jobs=2) == []
    assert not record.exists()


STARTS = re.compile(r"\b(Popen|subprocess\.(run|call|check_\w+)|create_subprocess_\w+)\(")
OTHER_STARTS = re.compile(r"\bos\.(exec|spawn|posix_spawn|system|popen)|\bmultiprocessing\b|runpy")


def test_no_process_of_python_is_started_in_any_other_way() -> None:
    sources = {
        str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
    } | {"huddle.py": (ROOT / "huddle.py").read_text(encoding="utf-8")}
    interpreters = [name for name, text in sources.items() if "sys.executable" in text]
    assert interpreters == [str(Path("daq", "python_process.py"))]
    assert not [name for name, text in sources.items() if OTHER_STARTS.search(text)]
    # A test above has each: simulated devices, recorders with what ends them, archives, services.
    starts = {name for name, text in sources.items() if STARTS.search(text)}
    users = {  # run what the bench file or --on-event says
        str(Path("tui", "commands", "tui_controls.py")),
        str(Path("tui", "service", "hooks.py")),
    }
    assert starts == users | {
        str(Path("daq", "archive", "execution.py")),
        str(Path("daq", "recording", "storage", "trial.py")),
        str(Path("sim_devices", "server", "launch.py")),
        str(Path("tui", "commands", "record.py")),
        str(Path("tui", "commands", "serve.py")),
        str(Path("tui", "runs", "recorder_process.py")),
        str(Path("tui", "service", "processes", "steps.py")),
    }
    assert all("python_command(" in sources[name] for name in starts - users)
