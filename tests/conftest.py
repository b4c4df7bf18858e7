"""What every test lives under: nothing may be left behind, and where the real recordings are."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import importlib
import inspect
import os
import signal
import sys
import threading
from collections.abc import Awaitable, Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from daq.recording import repair
from daq.recording.storage import trial
from tests import devices
from tests.devices import device_loop
from tests.virtual_time import VirtualTimeLoop
from tests.waiting import limit

USGS_RECORDING = "usgs-tst-huddle"
FIRST = (
    "tests/acceptance/",
    "tests/benchmarks/",
    "tests/tui/commands/test_run.py",
    "tests/daq/devices/test_conformance",
    "tests/tui/",
    "tests/examples/",
    "tests/torture/",
    "tests/test_",
)
"""Modules that take longest: with the others behind them, all workers end at the same time."""

GARBAGE = (20_000, 20, 20)
"""Objects, and collections of younger ones, between two collections."""


def _open_descriptors() -> dict[str, str]:
    """Descriptors of sockets, pseudo-terminals and regular files of this process, by number."""
    links: dict[str, str] = {}
    with contextlib.suppress(FileNotFoundError):  # not Linux: threads and children are watched
        for number in os.listdir("/proc/self/fd"):  # noqa: PTH208 - for every test: as fast as can
            try:
                target = os.readlink(f"/proc/self/fd/{number}")  # noqa: PTH115
            except OSError:  # closed between listing and looking
                continue
            if target.startswith(("socket:", "/dev/pt")) or target.endswith(".h5"):
                links[number] = target
    return links


def _children() -> set[str]:
    """Process numbers of this process's children, ended but unreaped ones included."""
    found: set[str] = set()
    with contextlib.suppress(FileNotFoundError):  # not Linux
        for thread in os.listdir("/proc/self/task"):  # noqa: PTH208
            # A thread may end between listing and looking.
            with contextlib.suppress(OSError), open(f"/proc/self/task/{thread}/children") as of:  # noqa: PTH123
                found.update(of.read().split())
    return found


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    """Fail a test that leaves a thread, task, child, socket, terminal or recording open."""
    threads = set(threading.enumerate())
    children = _children()
    descriptors = _open_descriptors()
    yield
    for thread in set(threading.enumerate()) - threads:
        thread.join(timeout=limit(2.0))  # one that is ending may end
    left = [
        t.name for t in set(threading.enumerate()) - threads if not t.name.startswith("asyncio_")
    ]
    if left:
        pytest.fail(f"threads left behind: {left}")
    born = _children() - children - devices.server_pids()
    for pid in born:  # a child of ours that nobody waited for: it takes no time from other tests
        os.kill(int(pid), signal.SIGKILL)
    if born:
        pytest.fail(f"processes left behind: {sorted(born)}")
    opened = {n: t for n, t in _open_descriptors().items() if descriptors.get(n) != t}
    if opened:
        pytest.fail(f"descriptors left open: {opened}")


@pytest.fixture(autouse=True)
def files_read_at_once(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Open and verify files in this process alone: a child before takes longer than most tests.

    Tests of this child are marked ``trial``, and children of tests have theirs. What a test makes
    of a file does not hold HDF5 up; if it did, the time limit would end the test.
    """
    if not request.node.get_closest_marker("trial"):
        monkeypatch.setattr(trial, "tried", lambda _: None)
        monkeypatch.setattr(trial, "_trials", _trials_here)
        monkeypatch.setattr(repair, "_print_progress", lambda: None)


def _trials_here(paths: Sequence[Path], task: str) -> Iterator[dict[str, Any]]:
    for path in paths:
        yield repair.found_in(path, task)


def _leaving_no_task(test: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
    """Return the asynchronous test, failing where a task it started outlives it."""

    @functools.wraps(test)
    async def checked(*args: object, **kwargs: object) -> None:
        before = asyncio.all_tasks()
        await test(*args, **kwargs)
        left = {task.get_name() for task in asyncio.all_tasks() - before if not task.done()}
        if left:
            pytest.fail(f"tasks left behind: {sorted(left)}")

    return checked


def pytest_configure() -> None:
    """Make tests the same whatever the environment, and however busy the computer.

    Commands can be interrupted, even where the tests run in a shell's background. Examples that
    hypothesis finds are not timed, and are those of every run, unless HUDDLE_TEST_EXPLORE is set:
    then it looks for others. Compiled modules are kept: the tests start hundreds of
    processes, and each would compile all that it imports.
    """
    settings.register_profile(
        "untimed",
        deadline=None,
        derandomize="HUDDLE_TEST_EXPLORE" not in os.environ,
        suppress_health_check=[HealthCheck.too_slow],
    )
    settings.load_profile("untimed")
    os.environ["HUDDLE_SENSORS"] = "off"  # no test writes into the ledger of its user
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # all children inherit it
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_asyncio_loop_factories(
    item: pytest.Item,
) -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    """Run a test by the clock that its marker names."""
    if item.get_closest_marker("virtual_time"):
        return {"virtual_time": VirtualTimeLoop}
    if item.get_closest_marker("devices"):
        return {"devices": device_loop}
    return {"system": asyncio.new_event_loop}


def pytest_sessionfinish() -> None:
    """End what served simulated devices to all tests."""
    devices.stop()


def _import_own_part(config: pytest.Config) -> None:
    """Let each worker import other modules first, so that it finds most of them compiled.

    In a new clone each compiled all: a third of what three workers did before the first test.
    """
    own = getattr(config, "workerinput", None)
    if own is None or config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    modules = sorted(Path(__file__).parent.rglob("test_*.py"))
    for path in modules[int(own["workerid"][2:]) :: own["workercount"]]:
        with contextlib.suppress(Exception, pytest.skip.Exception):  # collection will say
            importlib.import_module(
                ".".join(path.relative_to(config.rootpath).with_suffix("").parts)
            )


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Keep what was collected out of the garbage collector, which then looks less often.

    Each took a tenth of the time of all tests.
    """
    gc.disable()
    try:
        _import_own_part(session.config)
        return (yield)
    finally:
        gc.freeze()  # with its garbage: to find some 10 MB takes most of a second of each worker
        gc.set_threshold(*GARBAGE)
        gc.enable()


def _turn(item: pytest.Item) -> int:
    """Return the place of a test's module in FIRST."""
    places = (n for n, start in enumerate(FIRST) if item.nodeid.startswith(start))
    return next(places, len(FIRST))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Sort the modules, watch the tasks of asynchronous tests, and multiply the time limits."""
    items.sort(key=_turn)
    usual = float(config.getini("timeout"))
    for item in items:
        marker = item.get_closest_marker("timeout")
        seconds = float(marker.args[0]) if marker else usual
        item.add_marker(pytest.mark.timeout(limit(seconds)), append=False)
        if isinstance(item, pytest.Function) and inspect.iscoroutinefunction(item.obj):
            item.obj = _leaving_no_task(item.obj)


@pytest.fixture
def needs_obspy() -> None:
    """Skip a test where ObsPy is not installed: it has no wheels for some machines."""
    pytest.importorskip("obspy", reason="ObsPy is an extra")


@pytest.fixture(scope="session")
def usgs_recording() -> Path:
    """Folder of the real recording; its tests are skipped, saying so, where it is absent."""
    root = Path(os.environ.get("HUDDLE_DATA", Path(__file__).parents[2] / "shared" / "data"))
    folder = root / USGS_RECORDING
    if not folder.is_dir():
        pytest.skip(f"no real recording at {folder} (set HUDDLE_DATA to the folder of data)")
    return folder
