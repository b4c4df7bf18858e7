"""Commands that run when a run ends, with its JSON on standard input.

A hook that fails or takes too long is tried again. Hooks that were pending when the service ended
are in the database; the next service carries them out: each at least once.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import re
import signal
import sys
from typing import TYPE_CHECKING, Any

from tui.output.json_values import json_text
from tui.service.records.run_state import Run, RunState
from tui.service.records.store import RunStore, StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from daq.bench.tables.unattended import Hooks
    from tui.service.clock import SystemTime

_SHORTEST_SECRET = 4
_VARIABLE = re.compile(r"\$\{(\w+)\}")
_LOGGER = logging.getLogger(__name__)
_MOST_OUTPUT = 400
"""Characters of what a failed hook wrote that are logged."""


def events_of(run: Run, hooks: Hooks) -> tuple[str, ...]:
    """Return the hooks that are for a run in its present state, and that the bench file has."""
    events = {
        RunState.DONE: ["on_finished", *(["on_limit"] if run.verdict == "fail" else [])],
        RunState.FAILED: ["on_failed"],
        RunState.MISSED: ["on_missed"],
    }.get(run.state, [])
    return tuple(event for event in events if getattr(hooks, event) is not None)


def hook_document(run: Run, event: str, folder: Path) -> dict[str, Any]:
    """Return what a hook reads: the run, the event, its files, and its noise."""
    document = run.document()
    document["event"] = event
    folder = folder.resolve()
    document["recordings"] = [str(folder / part) for part in run.parts]
    result = (folder / run.parts[-1]).with_suffix(".json") if run.parts else None
    document["result"] = str(result) if result is not None and result.exists() else None
    document["noise"] = run.noise
    return document


class HookRunner:
    """Carries out hooks, one after another, while the service goes on.

    Parameters
    ----------
    hooks : callable
        Returns those of the bench file as it is now.
    store : RunStore
    folder : Path
        Of the recordings.
    clock : SystemTime
    """

    def __init__(
        self, hooks: Callable[[], Hooks], store: RunStore, folder: Path, clock: SystemTime
    ) -> None:
        self._hooks, self._store, self._folder, self._clock = hooks, store, folder, clock
        self._queue: asyncio.Queue[Run] = asyncio.Queue()
        self._never = asyncio.Event()
        self.n_failed = 0
        """Hooks that were given up."""

    def submit(self, run: Run) -> None:
        """Have the hooks of a run carried out."""
        if run.pending_hooks:
            self._queue.put_nowait(run)

    async def work(self) -> None:
        """Carry out hooks until cancelled."""
        while True:
            run = await self._queue.get()
            left = list(run.pending_hooks)
            for event in run.pending_hooks:
                await self._carry_out(run, event)
                left.remove(event)
                try:
                    self._store.set_pending_hooks(run, left)
                except StoreError as error:
                    _LOGGER.error("%s", error)  # noqa: TRY400 - its message says all

    async def _carry_out(self, run: Run, event: str) -> None:
        hooks = self._hooks()
        command: tuple[str, ...] | None = getattr(hooks, event, None)
        if command is None:  # no longer in the bench file
            return
        document = json_text(hook_document(run, event, self._folder)).encode() + b"\n"
        for attempt in range(hooks.retries + 1):
            problem = await run_hook(command, document, hooks.timeout)
            if not problem:
                _LOGGER.info("%s of run %s carried out", event, run.name)
                return
            _LOGGER.error("%s of run %s: %s", event, run.name, problem)
            if attempt < hooks.retries:
                await self._clock.sleep(hooks.retry_after * 2**attempt, self._never)
        self.n_failed += 1
        _LOGGER.error("%s of run %s is given up", event, run.name)


async def run_hook(command: Sequence[str], document: bytes, timeout: float) -> str:  # noqa: ASYNC109
    """Run a command with a document on its standard input; return what went wrong, or nothing.

    ``${NAME}`` in its words is replaced by the variable of the environment, if there is one: so a
    bench file names secrets and does not hold them. What is returned does not hold them either.
    """
    problem = await _problem_of_hook(command, document, timeout)
    used = {name: os.environ.get(name, "") for word in command for name in _VARIABLE.findall(word)}
    for name, value in sorted(used.items(), key=lambda item: -len(item[1])):
        if len(value) >= _SHORTEST_SECRET:
            problem = problem.replace(value, f"${{{name}}}")
    return problem


async def _problem_of_hook(
    command: Sequence[str],
    document: bytes,
    timeout: float,  # noqa: ASYNC109
) -> str:
    command = [_VARIABLE.sub(lambda m: os.environ.get(m[1], m[0]), word) for word in command]
    try:
        process = await asyncio.create_subprocess_exec(
            *command,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            start_new_session=sys.platform != "win32",
        )
    except (OSError, ValueError) as error:
        return f"{command[0]}: cannot be started: {error}"
    try:
        async with asyncio.timeout(timeout):
            _, errors = await process.communicate(document)
    except TimeoutError:
        return f"{command[0]}: took longer than {timeout:g} s and was ended"
    finally:
        if process.returncode is None:
            _kill_all(process.pid)
            await process.wait()
    if process.returncode == 0:
        return ""
    text = " ".join(errors.decode(errors="replace").split())[-_MOST_OUTPUT:]
    return f"{command[0]}: exit code {process.returncode}" + (f": {text}" if text else "")


def _kill_all(pid: int) -> None:
    """Kill a process with all that it has started in its session."""
    with contextlib.suppress(OSError):
        if sys.platform == "win32":
            os.kill(pid, signal.SIGTERM)
        else:
            os.killpg(pid, signal.SIGKILL)
